"""Try the oldest and the newest versions of what this package needs: python scripts/check_versions.py

Other interpreters: --python python3.11 python3.13.

For each interpreter two environments are made: one with the oldest versions that pyproject.toml allows (the newest
patch of each, as far as wheels for this interpreter exist), one with the newest, without constraints.txt. In each
the demo runs, then the fast tests. Prints a line for each; ends with exit code 1 where something fails.
"""

import argparse
import os
import re
import subprocess
import sys
import tempfile
import time
import tomllib
from pathlib import Path

from packaging.requirements import Requirement

ROOT = Path(__file__).parents[1]


def main() -> None:
    """Make the environments one after the other, and use them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--python", nargs="*", default=[sys.executable], help="interpreters; by default this one")
    parser.add_argument("--only", choices=("oldest", "newest"), help="one of both")
    parser.add_argument("--tests", nargs="*", default=["tests"], help="files of tests; none: only the demo")
    parser.add_argument("--folder", type=Path, help="folder in which environments stay, for the next time")
    arguments = parser.parse_args()
    failed = False
    with tempfile.TemporaryDirectory() as temporary:
        for python in arguments.python:
            for which in (arguments.only,) if arguments.only else ("oldest", "newest"):
                begin = time.monotonic()
                place = (arguments.folder or Path(temporary)) / f"{Path(python).name}-{which}"
                what = tried(python, which, place.absolute(), arguments.tests)
                failed |= not what.startswith("passed")
                print(f"{python}, {which}: {what} ({(time.monotonic() - begin) / 60:.0f} min)", flush=True)
    sys.exit(failed)


def tried(python: str, which: str, place: Path, tests: list[str]) -> str:
    """Install, run the demo and the tests in an environment at `place`; what came of it."""
    place.mkdir(parents=True, exist_ok=True)
    constraints = place / "constraints.txt"
    constraints.write_text("\n".join(oldest()) if which == "oldest" else "", encoding="utf-8")
    own = place / "bin" / "python"
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    environment |= {"OMP_NUM_THREADS": "1"}

    def run(*command: object, cwd: Path = place) -> str:
        words = [str(each) for each in command]
        done = subprocess.run(words, cwd=cwd, env=environment, capture_output=True, text=True, check=False)
        lines = (done.stdout + done.stderr).strip().splitlines()
        last = [each for each in lines if not each.startswith("WARNING")][-25:]
        if done.returncode != 0:
            raise RuntimeError("\n".join([f"failed: {' '.join(words[:8])}", *last]))
        return last[-1] if last else ""

    try:
        if not own.exists():
            run(python, "-m", "venv", place)
        wheels = ("--only-binary", ":all:", "--no-binary", "shapepose-fg")
        run(own, "-m", "pip", "install", "--quiet", *wheels, "-c", constraints, f"{ROOT}[dev]")
        version = run(own, "-c", "import platform; print(platform.python_version())")
        listed = run(own, "-c", VERSIONS)
        run(place / "bin" / "shapepose-fg", "demo", "--output", place / "demo")
        summary = "demo only"
        if tests:
            run(own, "-m", "pip", "install", "--quiet", "--no-deps", "-e", ROOT)
            summary = run(own, "-m", "pytest", "-m", "not slow", "-n", "2", "--dist", "loadfile", *tests, cwd=ROOT)
    except RuntimeError as error:
        return str(error)
    return f"passed: Python {version}, {listed}: {summary}"


VERSIONS = """
from importlib.metadata import version
names = "numpy scipy numba gtsam opencv-python-headless pydantic typer rich".split()
print(", ".join(f"{name} {version(name)}" for name in names))
"""


def oldest() -> list[str]:
    """Constraints to the lower bounds of pyproject.toml: `numpy>=2` becomes numpy==2.0.*."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    asked = [*project["dependencies"], *project["optional-dependencies"]["dev"]]
    found = []
    for requirement in map(Requirement, asked):
        for each in requirement.specifier:
            if each.operator == ">=":
                parts = [*re.findall(r"\d+", each.version), "0"][: max(2, each.version.count(".") + 1)]
                exact = ".".join(parts) + ("" if len(parts) > 2 else ".*")
                found.append(f"{requirement.name}=={exact}")
    return found


if __name__ == "__main__":
    main()
