"""Build sdist and wheel, install the wheel into an empty environment, and use it: python scripts/check_package.py

The wheel is built from the sdist, so that what the sdist lacks is noticed. The environment takes the dependencies
from the one that runs this (torch is a large download), but nothing of this folder.
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
from shapepose_fg.cli.main import main

def run(words):
    try:
        main(words.split())
    except SystemExit as ended:
        assert not ended.code, ended.code

run("simulate demo --people 1 --cameras 3 --frames :6 --output in")
run("reconstruct --calibration in/calibration.json --detections in --fps 25 --output results")
assert len(shapepose_fg.Reconstruction.load("results")) == 6 and Path("results/report.html").is_file()
"""


def main() -> None:
    """Build, install, use; an error ends with exit code 1 and what the failing step said."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)

        def run(*command: object) -> None:
            words = [str(each) for each in command]
            done = subprocess.run(words, cwd=place, env=environment, capture_output=True, text=True, check=False)
            if done.returncode != 0:
                sys.exit(f"{' '.join(words[:6])} failed:\n{done.stdout[-3000:]}{done.stderr[-3000:]}")

        run(sys.executable, "-m", "build", "--outdir", place / "dist", ROOT)
        wheel = next((place / "dist").glob("*.whl"))
        venv.create(place / "empty", with_pip=False)
        python = place / "empty" / "bin" / "python"
        run(sys.executable, "-m", "pip", "--python", python, "install", "--quiet", "--no-deps", wheel)
        # After the environment's own packages, and without what `pip install -e` left there.
        site = Path(sysconfig.get_path("purelib", vars={"base": str(place / "empty")}))
        paths = [each for each in sys.path if each.endswith("site-packages")]
        (site / "dependencies.pth").write_text("\n".join(paths) + "\n", encoding="utf-8")
        run(python, "-I", "-c", USE)
        run(place / "empty" / "bin" / "shapepose-fg", "--help")
        print(f"{wheel.name} ({wheel.stat().st_size / 1e6:.1f} MB) and its sdist install and run")


if __name__ == "__main__":
    main()
