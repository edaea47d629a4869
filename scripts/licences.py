"""Write docs/licences.md: the licences of all packages that are installed with this one.

Run it by hand (python scripts/licences.py) when tests/project/test_licences.py fails after a
dependency was added.
"""

import re
import tomllib
from importlib.metadata import Distribution, PackageNotFoundError, distribution
from pathlib import Path
from typing import Any

from packaging.requirements import Requirement

ROOT = Path(__file__).parent.parent
PAGE = ROOT / "docs" / "licences.md"
EXTRAS = (
    "detect",
    "export",
    "view",
    "archive",
    "photos",
    "cluster",
    "ros",
    "hdf5",
    "frames",
    "train",
)
HEAD = """# Licences of the installed packages

With this page you can check the licences of all packages that are installed. `pip install
shapepose-fg` installs the first list, and its extras the second. The names of the licences are
those in the metadata of the packages.

None of them requires that programs which use it have the same licence. opencv-python-headless
contains the libraries of FFmpeg (LGPL-2.1); they are separate files that may be exchanged.

Our code is under the MIT licence. The sources of the body and the priors are in the
[README](../README.md#licence-and-credits).
"""
_SHORT = {
    "apache software license": "Apache-2.0",
    "bsd license": "BSD",
    "mit license": "MIT",
    "mozilla public license 2.0 (mpl 2.0)": "MPL-2.0",
    "python software foundation license": "PSF-2.0",
}


def needed(extras: tuple[str, ...]) -> dict[str, Distribution]:
    """All distributions that are installed with this one and these extras, by name."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    own = list(project["dependencies"])
    for extra in extras:
        own += project["optional-dependencies"][extra]
    found: dict[str, Distribution] = {}
    waiting = [(each.name, frozenset(each.extras)) for each in map(Requirement, own)]
    while waiting:
        name, wanted = waiting.pop()
        try:
            here = distribution(name)
        except PackageNotFoundError:  # a dependency of other operating systems
            continue
        key = re.sub(r"[-_.]+", "-", here.metadata["Name"]).lower()
        if key in found:
            continue
        found[key] = here
        for text in here.requires or ():
            requirement = Requirement(text)
            marker = requirement.marker
            if marker is None or any(marker.evaluate({"extra": extra}) for extra in ("", *wanted)):
                waiting.append((requirement.name, frozenset(requirement.extras)))
    return dict(sorted(found.items()))


def licence(of: Distribution) -> str:
    """The licence in the metadata of a distribution, as the short name given there."""
    metadata: Any = of.metadata
    if metadata.get("License-Expression"):
        return metadata.get("License-Expression")
    text = (metadata.get("License") or "").strip()
    if text and len(text) < 40 and "\n" not in text:
        return text
    classifiers = [
        each.split(" :: ")[-1]
        for each in metadata.get_all("Classifier", [])
        if each[:7] == "License"
    ]
    named: list[str] = [
        str(_SHORT.get(each.lower(), each)) for each in classifiers if each != "OSI Approved"
    ]
    return " or ".join(named) or "see its own files"


def page() -> str:
    """The text of the whole page."""
    always, text = needed(()), HEAD
    more = {name: each for name, each in needed(EXTRAS).items() if name not in always}
    for title, rows in (("## Always", always), (f"## With the extras {', '.join(EXTRAS)}", more)):
        under: dict[str, list[str]] = {}
        for name, each in rows.items():
            under.setdefault(licence(each), []).append(name)
        text += f"\n{title}\n\n" + "".join(
            f"- {each}: {', '.join(under[each])}\n" for each in sorted(under)
        )
    return text


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
