"""Build sdist and wheel, install the wheel into an empty environment, and use it: python scripts/check_package.py

The wheel is built from the sdist, so that what the sdist lacks is noticed. The environment takes the dependencies
from the one that runs this (torch is a large download), but nothing of this folder: what is used is what was
installed.
"""

import os
import subprocess
import sys
import sysconfig
import tempfile
import venv
from pathlib import Path

ROOT = Path(__file__).parents[1]
USE = """
import sys
from pathlib import Path
import factors, shapepose_fg
assert Path(shapepose_fg.__file__).is_relative_to(sys.prefix), shapepose_fg.__file__
from shapepose_fg import read_detections, read_rig, reconstruct
from shapepose_fg.cli.main import main

try:
    main(["simulate", "demo", "--people", "1", "--cameras", "3", "--frames", ":6", "--output", "simulated"])
except SystemExit as ended:
    assert not ended.code, ended.code
rig = read_rig("simulated/calibration.json")
found = reconstruct(read_detections("simulated", rig), rig)
found.save("results")
assert len(found) == 6, len(found)
from shapepose_fg.viz.report.writing import write_report
write_report(Path("results"), found, rig)
"""


def main() -> None:
    """Build, install, use; an error ends with exit code 1 and what the failing step said."""
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        run("build", sys.executable, "-m", "build", "--outdir", place / "dist", ROOT)
        wheel = next((place / "dist").glob("*.whl"))
        sdist = next((place / "dist").glob("*.tar.gz"))
        venv.create(place / "empty", with_pip=False)
        python = place / "empty" / "bin" / "python"
        site = Path(sysconfig.get_path("purelib", vars={"base": str(place / "empty")}))
        pip = (sys.executable, "-m", "pip", "--python", python, "install", "--quiet", "--no-deps", wheel)
        run("install", *pip)
        # After the environment's own packages, and without what `pip install -e` left there.
        paths = [each for each in sys.path if each.endswith("site-packages")]
        (site / "dependencies.pth").write_text("\n".join(paths) + "\n", encoding="utf-8")
        run("use", python, "-I", "-c", USE, cwd=place)
        run("command", place / "empty" / "bin" / "shapepose-fg", "--help", cwd=place)
        print(f"{wheel.name} ({wheel.stat().st_size / 1e6:.1f} MB) and {sdist.name} install and run")


def run(step: str, *command: object, cwd: Path | None = None) -> None:
    """Run one step; SystemExit with what it said where it fails."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(
        [str(each) for each in command],
        cwd=cwd,
        env=environment,
        capture_output=True,
        text=True,
        errors="replace",
        check=False,
    )
    if done.returncode != 0:
        sys.exit(f"{step} failed:\n{done.stdout[-3000:]}{done.stderr[-3000:]}")


if __name__ == "__main__":
    main()
