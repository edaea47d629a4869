"""Hours of frames in one run, memory and time a frame by the minute: python scripts/soak.py --frames 20000.

A minute of the built-in scene is simulated and played forwards and backwards, over and over, on a time axis that
goes on. `shapepose-fg reconstruct` is run on it and looked at from outside: memory of all its processes, and their
processor time, for each round of the minute. Neither may grow by more than 5 % to the last; the first has the
loading in it and is left out, as many as there are processes that solve. Then come bodies over time, check, report
and the files, of which the peak is printed. Linux only (it reads /proc). Exit code 1 where memory or time grows.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from shapepose_fg.evaluation.speed import BackAndForth
from shapepose_fg.io.write_detections import write_association
from shapepose_fg.pipeline.runs.manifest import PARTS
from shapepose_fg.simulation import built_in_scene, simulate

_FPS = 25.0
_EVERY_S = 0.2
_LOOKING = 0.02
"""Share of the time in which a run is looked at: the system walks through all its pages for that."""
_MEGABYTE = 1e6


@dataclass(frozen=True)
class Sample:
    """A look at a run."""

    parts: int
    """Windows that it has kept."""
    memory_bytes: int
    """Of all its processes together; what several have in common counts once, pages of files do not."""
    whole_bytes: int
    """With the pages of files, programs and libraries mostly."""
    cpu_s: float
    """Their processor time so far."""


@dataclass(frozen=True)
class Round:
    """Some frames of a run."""

    stop: int
    """The frame behind them."""
    memory_mb: float
    """Mean over them."""
    frame_ms: float
    """Processor time of one."""


def main(words: Sequence[str] | None = None) -> int:
    """Run it."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--frames", type=int, default=20_000, help="frames in all; a day has 2,160,000")
    parser.add_argument("--loop", type=int, default=1500, help="frames that are simulated, and repeated")
    parser.add_argument("--people", type=int, default=2)
    parser.add_argument("--cameras", type=int, default=4)
    parser.add_argument("--workers", type=int, default=1, help="processes that solve")
    parser.add_argument("--batch-frames", type=int, default=96, help="frames of a window")
    parser.add_argument("--tolerance", type=float, default=0.05, help="change that is let pass, as a share")
    parser.add_argument("--folder", type=Path, help="where the files go, and stay; by default they are removed")
    given = parser.parse_args(words)
    with tempfile.TemporaryDirectory(prefix="soak-") as name:
        folder = Path(name) if given.folder is None else given.folder
        scene = built_in_scene(0, people=given.people, cameras=given.cameras, frames=given.loop, fps=_FPS)
        recording = folder / "recording"
        write_association(BackAndForth(simulate(scene, seed=0), given.frames), scene.rig, recording)
        size = sum(file.stat().st_size for file in recording.rglob("*.txt"))
        print(f"{given.frames} frames of {given.people} people and {given.cameras} cameras, {size / 1e6:.0f} MB")
        samples = _watched(_command(folder, given.workers, given.batch_frames), folder / "out" / PARTS)
    rounds = rounds_of(samples, given.batch_frames, 2 * given.loop, given.frames)
    most = max(each.parts for each in samples)
    _print([each for each in samples if each.parts == 0], rounds, [each for each in samples if each.parts == most])
    return judged(rounds[given.workers :], given.tolerance)


def rounds_of(samples: Sequence[Sample], batch_frames: int, length: int, frames: int) -> list[Round]:
    """The looks at a run of so many `frames` by rounds of `length` frames in which windows were solved."""
    done = np.array([min(each.parts * batch_frames, frames) for each in samples])
    memory, cpu = (np.array([getattr(each, name) for each in samples]) for name in ("memory_bytes", "cpu_s"))
    rounds = []
    for start in range(0, frames - length + 1, length):
        inside = np.flatnonzero((done > start) & (done <= start + length))
        if len(inside) == 0 or inside[0] == 0:
            continue
        before, last = inside[0] - 1, inside[-1]
        spent = (cpu[last] - cpu[before]) / (done[last] - done[before])
        rounds.append(Round(start + length, float(memory[inside].mean()) / _MEGABYTE, 1e3 * float(spent)))
    return rounds


def judged(rounds: Sequence[Round], tolerance: float) -> int:
    """Say how memory and time change from the first round to the last; 1 where it is by more than `tolerance`."""
    if len(rounds) < 3:
        print("too few rounds to judge: give more --frames, or a shorter --loop")
        return 1
    code = 0
    for name, unit in (("memory_mb", "MB"), ("frame_ms", "ms a frame")):
        values = np.array([getattr(each, name) for each in rounds])
        # A line through all: single rounds differ by what else the machine does.
        slope, first = np.polyfit(np.arange(len(values)), values, 1)
        change = slope * (len(values) - 1) / first
        verdict = "flat" if change <= tolerance else "GROWS"
        print(f"{verdict}: {first:.4g} {unit}, changes by {100 * change:+.1f} % to the end")
        code = code or int(change > tolerance)
    return code


def _print(reading: Sequence[Sample], rounds: Sequence[Round], ending: Sequence[Sample]) -> None:
    """A line per round, and the peaks before and after them."""
    for each in rounds:
        print(f"to frame {each.stop:8d}: {each.memory_mb:7.1f} MB, {each.frame_ms:6.1f} ms a frame")
    for what, some in (("reading", reading), ("ending", ending)):
        memory, whole = (max(getattr(each, name) for each in some) for name in ("memory_bytes", "whole_bytes"))
        spent = some[-1].cpu_s - some[0].cpu_s
        print(
            f"{what}: up to {memory / _MEGABYTE:.0f} MB, with pages of files {whole / _MEGABYTE:.0f};"
            f" {spent:.0f} s of processor time"
        )


def _command(folder: Path, workers: int, batch_frames: int) -> list[str]:
    """The run, without anything that it could be told to leave out."""
    settings = folder / "settings.toml"
    settings.write_text(f"batch_frames = {batch_frames}\n")
    recording = folder / "recording"
    options: dict[str, object] = {
        "--calibration": recording / "calibration.json",
        "--detections": recording,
        "--output": folder / "out",
        "--config": settings,
        "--fps": _FPS,
        "--workers": workers,
    }
    words = [str(word) for option in options.items() for word in option]
    return [sys.executable, "-m", "shapepose_fg", "reconstruct", *words]


def _watched(command: Sequence[str], parts: Path) -> list[Sample]:
    """Looks at a run until it ends; RuntimeError where it fails."""
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, env=os.environ | {"OMP_NUM_THREADS": "1"})
    samples: list[Sample] = []
    while process.poll() is None:
        kept = samples[-1].parts if samples else 0  # at its end they are removed
        while (parts / f"part-{kept:06d}.safetensors").exists():
            kept += 1
        start = time.perf_counter()
        memory, whole, cpu = (sum(column) for column in zip(*map(_process, _tree(process.pid)), strict=True))
        samples.append(Sample(kept, int(memory), int(whole), cpu))
        time.sleep(max(_EVERY_S, (time.perf_counter() - start) / _LOOKING))
    if process.returncode != 0:
        raise RuntimeError(f"the run ended with exit code {process.returncode}")
    return [each for each in samples if each.memory_bytes > 0]


def _tree(number: int) -> list[int]:
    """A process and all that it began."""
    try:
        children = Path(f"/proc/{number}/task/{number}/children").read_text().split()
    except OSError:
        children = []
    return [number, *(each for child in children for each in _tree(int(child)))]


def _process(number: int) -> tuple[int, int, float]:
    """Memory without and with pages of files, bytes, and processor time, seconds; zeros where it is gone."""
    folder = Path(f"/proc/{number}")
    try:
        rollup = dict(line.split(":", 1) for line in (folder / "smaps_rollup").read_text().splitlines()[1:])
        ticks = (folder / "stat").read_text().rpartition(")")[2].split()[11:15]  # with those that ended
    except OSError:
        return 0, 0, 0.0
    # Of a page that processes forked off one have in common each has its share.
    memory, whole = (1024 * int(rollup.get(name, "0").split()[0]) for name in ("Pss_Anon", "Pss"))
    return memory, whole, sum(map(int, ticks)) / os.sysconf("SC_CLK_TCK")


if __name__ == "__main__":
    sys.exit(main())
