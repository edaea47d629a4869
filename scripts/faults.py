"""Kill `shapepose-fg reconstruct` at random moments, let it go on, compare: python scripts/faults.py --kills 200.

A run of the built-in scene is made once without a fault. Then it is made again and again: killed (SIGKILL) at a
random moment, gone on with `--resume`, killed again, and so on until one is faster than its end. All files must be
those of the first run, to the byte; of run.json all but the times. Prints a line per run and a summary; exit code
1 where one differs.
"""

import argparse
import hashlib
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from shapepose_fg.simulation import built_in_scene, simulate
from shapepose_fg.simulation.files import write_simulated

_SETTINGS = "batch_frames = 24\n"


def main() -> int:
    """Run the campaign."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--kills", type=int, default=200, help="how many kills in all")
    parser.add_argument("--frames", type=int, default=300, help="frames of the recording")
    parser.add_argument("--workers", type=int, default=1, help="processes that solve")
    parser.add_argument("--seed", type=int, default=0, help="of the moments")
    arguments = parser.parse_args()
    rng = random.Random(arguments.seed)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        command = _command(folder, arguments.frames, arguments.workers)
        began = time.monotonic()
        if _run([*command, "--output", str(folder / "whole")], None) != 0:
            print("the run without a fault failed")
            return 1
        seconds = time.monotonic() - began
        expected = _state(folder / "whole")
        kills, runs, others = 0, 0, 0
        while kills < arguments.kills:
            out, more, own = folder / f"run{runs}", [], 0
            while True:
                # Every moment of a whole run, also the last tenth of a second, with its writing.
                after = rng.uniform(0.0, 1.1 * seconds) if kills + own < arguments.kills else None
                code = _run([*command, "--output", str(out), *more], after)
                if code == 0:
                    break
                if code != -signal.SIGKILL:
                    print(f"run {runs}: exit code {code}")
                    return 1
                own, more = own + 1, ["--resume"]
            same = _state(out) == expected
            kills, runs, others = kills + own, runs + 1, others + (not same)
            print(f"run {runs}: {own} kills, {'the same' if same else 'DIFFERENT'}", flush=True)
    print(f"{kills} kills in {runs} runs of {seconds:.0f} s: {runs - others} ended the same, {others} did not")
    return 1 if others else 0


def _command(folder: Path, frames: int, workers: int) -> list[str]:
    """The command line of a run, without its output."""
    scene = built_in_scene(seed=0, people=2, cameras=4, frames=frames)
    written = write_simulated(scene, simulate(scene, seed=0), folder / "recording", "association")
    settings = folder / "settings.toml"
    settings.write_text(_SETTINGS)
    options = {"--calibration": written["cameras"], "--detections": written["detections"], "--config": settings}
    words = [str(word) for option in options.items() for word in option]
    return [sys.executable, "-m", "shapepose_fg", "reconstruct", *words, "--fps", "25", "--workers", str(workers)]


def _run(command: list[str], kill_after_s: float | None) -> int:
    """The exit code of a run that is killed after some seconds, if it takes so long."""
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env=environment)
    try:
        return process.wait(kill_after_s)
    except subprocess.TimeoutExpired:
        process.kill()
        return process.wait()


def _state(folder: Path) -> dict[str, str]:
    """What is in a folder of results: of each file a checksum; of run.json without its times."""
    found = {}
    for file in sorted(folder.rglob("*")):
        content = file.read_bytes() if file.is_file() else b""
        if file.name == "run.json":
            run = json.loads(content)
            run.pop("seconds")
            content = json.dumps(run).encode()
        if file.name != "report.html":  # it shows the times
            found[str(file.relative_to(folder))] = hashlib.sha256(content).hexdigest()
    return found


if __name__ == "__main__":
    sys.exit(main())
