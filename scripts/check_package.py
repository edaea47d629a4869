"""Build sdist and wheel, install the wheel into an empty environment, and use it: python
scripts/check_package.py

The wheel is built from the sdist, so that files missing in the sdist are noticed. The environment
reuses the dependencies of the running one (torch is a large download), but nothing from this
folder.

With --versions both, one environment is made with the oldest versions that pyproject.toml allows
(as far as wheels for the interpreter exist), and one with the newest, without constraints.txt. In
each, the demo and then the fast tests are run. --python python3.11 tests another interpreter. Exit
code 1 if something fails.
"""

import os
import subprocess
import sys
import sysconfig
import tempfile
import time
import venv
from pathlib import Path
from typing import Annotated, Literal

from typer import Option, Typer

ROOT = Path(__file__).parent.parent
USE = """
import sys
from pathlib import Path
import factors, shapepose_fg
assert Path(shapepose_fg.__file__).is_relative_to(sys.prefix), shapepose_fg.__file__
from shapepose_fg.cli.main import main

def run(words):
    try:
        main(words.split())
    except SystemExit as ended:
        assert not ended.code, ended.code

run("simulate demo --people 1 --cameras 3 --frames :6 --output in")
run("reconstruct --calibration in/calibration.json --detections in --fps 25 --output results")
assert len(shapepose_fg.Reconstruction.load("results")) == 6
assert Path("results/report.html").is_file()
"""
VERSIONS = """
import platform
from importlib.metadata import version
names = "numpy scipy numba gtsam opencv-python-headless pydantic typer rich".split()
versions = (f"{name} {version(name)}" for name in names)
print(f"Python {platform.python_version()}", *versions, sep=", ")
"""


app = Typer(add_completion=False)


@app.command(help=__doc__)
def main(
    versions: Annotated[
        Literal["oldest", "newest", "both"] | None, Option(help="Versions of dependencies.")
    ] = None,
    python: Annotated[
        list[str] | None, Option(help="Interpreters; by default the one that runs this.")
    ] = None,
    tests: Annotated[str, Option(help="Files of tests; empty: only the demo.")] = "tests",
    folder: Annotated[
        Path | None, Option(help="Folder in which environments stay, for the next time.")
    ] = None,
) -> None:
    """Create and test the environments one after the other."""
    failed = False
    with tempfile.TemporaryDirectory() as temporary:
        room = (folder or Path(temporary)).absolute()
        wanted = {"both": ("oldest", "newest"), None: ()}.get(versions, (versions,))
        tries = [(each, which) for each in python or [sys.executable] for which in wanted]
        for each, which in tries or [(sys.executable, "built")]:
            begin, place = time.monotonic(), room / f"{Path(each).name}-{which}"
            place.mkdir(parents=True, exist_ok=True)
            try:
                result = tried(each, which, place, tests.split()) if tries else built(place)
            except RuntimeError as error:
                failed, result = True, f"failed: {error}"
            minutes = (time.monotonic() - begin) / 60
            print(f"{each}, {which}: {result} ({minutes:.0f} min)", flush=True)
    sys.exit(failed)


def run(place: Path, *command: object) -> str:
    """Run a command in a folder, without the packages of this checkout; returns the last line of
    its output.
    """
    words = [str(each) for each in command]
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    environment |= {"OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        words, cwd=place, env=environment, capture_output=True, text=True, check=False
    )
    lines = (done.stdout + done.stderr).strip().splitlines()
    last = [each for each in lines if not each.startswith("WARNING")][-25:]
    if done.returncode != 0:
        raise RuntimeError("\n".join([" ".join(words[:8]), *last]))
    return last[-1] if last else ""


def built(place: Path) -> str:
    """Build at `place`, install the wheel into an empty environment, and use it."""
    run(place, sys.executable, "-m", "build", "--outdir", place / "dist", ROOT)
    wheel = next((place / "dist").glob("*.whl"))
    venv.create(place / "empty", with_pip=False)
    python = place / "empty" / "bin" / "python"
    run(
        place,
        sys.executable,
        "-m",
        "pip",
        "--python",
        python,
        "install",
        "--quiet",
        "--no-deps",
        wheel,
    )
    # After the environment's own packages, and without links left by `pip install -e`.
    site = Path(sysconfig.get_path("purelib", vars={"base": str(place / "empty")}))
    paths = [each for each in sys.path if each.endswith("site-packages")]
    (site / "dependencies.pth").write_text("\n".join(paths) + "\n", encoding="utf-8")
    run(place, python, "-I", "-c", USE)
    run(place, place / "empty" / "bin" / "shapepose-fg", "--help")
    return f"{wheel.name} ({wheel.stat().st_size / 1e6:.1f} MB) and its sdist install and run"


def tried(python: str, which: str, place: Path, tests: list[str]) -> str:
    """Install the package with the oldest or newest versions of its dependencies at `place`; run
    the demo and the tests.
    """
    own = place / "bin" / "python"
    if not own.exists():
        run(place, python, "-m", "venv", place)
    run(place, own, "-m", "pip", "install", "--quiet", "uv")
    resolution = ("--resolution", "lowest-direct" if which == "oldest" else "highest")
    wheels = ("--only-binary", ":all:", "--no-binary", "shapepose-fg")
    install = (place / "bin" / "uv", "pip", "install", "--quiet", "--python", own)
    run(place, *install, *resolution, *wheels, f"{ROOT}[dev]")
    run(place, place / "bin" / "shapepose-fg", "compile")
    run(place, place / "bin" / "shapepose-fg", "demo", "--output", place / "demo")
    summary, versions = "demo only", run(place, own, "-c", VERSIONS)
    if tests:
        run(place, *install, "--no-deps", "-e", ROOT)
        summary = run(
            ROOT, own, "-m", "pytest", "-m", "not slow", "-n", "2", "--dist", "loadfile", *tests
        )
    return f"passed: {versions}: {summary}"


if __name__ == "__main__":
    app()
