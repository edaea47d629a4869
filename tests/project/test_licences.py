"""docs/licences.md names everything that is installed, and every module that is imported is asked
for.
"""

import ast
import importlib.util
import re
import sys
import tomllib
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def script():
    spec = importlib.util.spec_from_file_location("licences", ROOT / "scripts" / "licences.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_every_dependency_and_its_licence_is_listed():
    licences = script()
    lines = re.findall(r"^- (.+): (.+)$", licences.PAGE.read_text(encoding="utf-8"), re.MULTILINE)
    rows = {name: licence for licence, names in lines for name in names.split(", ")}
    installed = licences.needed(licences.EXTRAS)  # of those, what is installed here
    assert {"numpy", "gtsam"} <= installed.keys()
    # What only other systems, builds of torch, versions of onnxruntime or extras need may be
    # missing.
    others = ("nvidia", "triton", "coloredlogs", "humanfriendly")
    missing = {name for name in installed if name not in rows and not name.startswith(others)}
    assert missing == set(), "run scripts/licences.py"
    # Other versions may spell their licence otherwise.
    pins = re.findall(
        r"^(\S+)==(\S+)$", (ROOT / "constraints.txt").read_text(encoding="utf-8"), re.MULTILINE
    )
    if all(
        installed[name].version.partition("+")[0] == version
        for name, version in pins
        if name in installed
    ):
        for name in rows.keys() & installed.keys():
            assert rows[name] == licences.licence(installed[name]), "run scripts/licences.py"
    assert not any(re.search(r"\bA?GPL", text) for text in rows.values())


@pytest.mark.slow
def test_what_is_imported_is_asked_for():
    asked = [
        *PROJECT["dependencies"],
        *(each for group in PROJECT["optional-dependencies"].values() for each in group),
    ]
    asked = {re.match(r"[\w-]+", each)[0].lower() for each in asked}
    whose = packages_distributions()
    for path in [*(ROOT / "shapepose_fg").rglob("*.py"), *(ROOT / "factors").rglob("*.py")]:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = [each.name for each in node.names] if isinstance(node, ast.Import) else []
            names += [node.module] if isinstance(node, ast.ImportFrom) and node.module else []
            for name in (
                {each.split(".")[0] for each in names}
                - {"shapepose_fg", "factors"}
                - sys.stdlib_module_names
            ):
                distributions = {each.lower() for each in whose.get(name, [])}
                assert not distributions or distributions & asked, f"{path}: {name}"
