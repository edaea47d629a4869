"""What time costs: python scripts/benchmark_time.py [--rounds N] [--lengths 300 3000 ...].

Reconstructs Shelf, a stretch of salsa (where the recordings are: `--data FOLDER`, or SHAPEPOSE_DATA) and the
built-in scene with time and frame by frame, alternately in one run, and prints processor milliseconds a frame,
their ratio and the clock's. Then a cheap recording (two people, four cameras) of rising lengths: time a frame must
not grow, nor memory beyond the rows of the result. Run it on a machine that does nothing else.
"""

import argparse
import os
import resource
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from shapepose_fg.camera import Rig
from shapepose_fg.detections import Detections, DetectionSequence
from shapepose_fg.io.calibration import read_rig
from shapepose_fg.io.detections import read_detections
from shapepose_fg.pipeline import PipelineConfig, reconstruct
from shapepose_fg.reconstruction import Reconstruction
from shapepose_fg.simulation import built_in_scene, simulate
from shapepose_fg.simulation.files import cut, named_scene
from shapepose_fg.skeleton import Skeleton

ROOT = Path(__file__).parents[1]
SALSA = range(108, 408)
"""A stretch without a cut."""


@dataclass(frozen=True)
class BackAndForth:
    """A long recording made of a short one, played forwards and backwards in turn: nobody jumps."""

    sequence: DetectionSequence
    """The short recording."""
    frames: int
    """Frames of the long one."""

    @property
    def skeleton(self) -> Skeleton:
        """The detector's joints."""
        return self.sequence.skeleton

    def __len__(self) -> int:
        return self.frames

    def __getitem__(self, frame: int, /) -> Detections:
        count = len(self.sequence)
        turn, place = divmod(frame, count)
        return self.sequence[place if turn % 2 == 0 else count - 1 - place]


@dataclass(frozen=True)
class Spent:
    """What a run took."""

    cpu_s: float
    """Seconds of all processors, of processes that it started too."""
    wall_s: float
    """Seconds of the clock."""
    people: Reconstruction
    """What came out."""


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--data", type=Path, default=Path(os.environ.get("SHAPEPOSE_DATA", ROOT.parent / "shared"))
    )
    parser.add_argument("--rounds", type=int, default=2, help="runs of each, the best counts; 0: none")
    parser.add_argument("--frames", type=int, help="the first frames of each recording only")
    parser.add_argument("--lengths", type=int, nargs="*", default=[300, 3000], help="of the cheap recording")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    if arguments.rounds > 0:
        for name, make in recordings(arguments.data).items():
            recording, rig = make()
            count = len(recording) if arguments.frames is None else min(arguments.frames, len(recording))
            ratio(name, recording, rig, range(count), arguments.rounds)
    linearity(sorted(arguments.lengths))


def recordings(data: Path) -> dict[str, Callable[[], tuple[DetectionSequence, Rig]]]:
    """What there is to reconstruct."""
    shelf, motions = data / "data" / "shelf", data / "data" / "cmu_mocap" / "cmu_smpl24.npz"
    found: dict[str, Callable[[], tuple[DetectionSequence, Rig]]] = {}
    if shelf.is_dir():
        rig = read_rig(shelf / "calibration.json")
        found["Shelf"] = lambda: (read_detections(shelf, rig), rig)
    if motions.is_file():
        found["salsa"] = lambda: simulated(
            cut(named_scene("salsa", split="report", frames=SALSA.stop, mocap=motions), SALSA)
        )
    return found | {"built-in scene": lambda: simulated(built_in_scene())}


def simulated(scene) -> tuple[DetectionSequence, Rig]:
    """What the simulated detector sees of a scene."""
    return simulate(scene), scene.rig


def ratio(name: str, recording: DetectionSequence, rig: Rig, frames: range, rounds: int) -> None:
    """With time against frame by frame, alternately; the best of `rounds` of each."""
    best: dict[bool, Spent] = {}
    for _ in range(rounds):
        for temporal in (False, True):
            now = spend(recording, rig, replace(PipelineConfig(), temporal=temporal), frames)
            if temporal not in best or now.cpu_s < best[temporal].cpu_s:
                best[temporal] = now
    cpu, wall = (
        {mode: 1e3 * getattr(s, which) / len(frames) for mode, s in best.items()} for which in ("cpu_s", "wall_s")
    )
    print(
        f"{name}: {len(frames)} frames; processor {cpu[False]:.1f} ms a frame without time, {cpu[True]:.1f} with,"
        f" ratio {cpu[True] / cpu[False]:.2f}; by the clock {wall[False]:.1f} and {wall[True]:.1f}",
        flush=True,
    )


def linearity(lengths: list[int]) -> None:
    """Time a frame and peak memory of one recording, longer and longer."""
    recording, rig = simulated(built_in_scene(people=2, cameras=4, frames=100))
    config = PipelineConfig()
    spend(recording, rig, config, range(64))  # warm-up: what is loaded once counts for none
    for length in lengths:
        now = spend(BackAndForth(recording, length), rig, config, range(length))
        print(
            f"{length} frames: processor {1e3 * now.cpu_s / length:.2f} ms a frame, peak memory"
            f" {peak_mib():.0f} MiB, {rows_mib(now.people):.1f} MiB of it rows of the result",
            flush=True,
        )


def spend(recording: DetectionSequence, rig: Rig, config: PipelineConfig, frames: range) -> Spent:
    """Reconstruct, and look at the clocks before and after."""
    before, start = os.times(), time.perf_counter()
    people = reconstruct(recording, rig, config, frames=frames)
    wall_s, after = time.perf_counter() - start, os.times()
    return Spent(sum(after[:4]) - sum(before[:4]), wall_s, people)


def peak_mib() -> float:
    """The most memory that this process has had so far; it never falls."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 2**20 if sys.platform == "darwin" else peak / 2**10


def rows_mib(people: Reconstruction) -> float:
    """Memory of a result's rows and of their observations."""
    tables = [people] if people.observations is None else [people, people.observations]
    return sum(getattr(table, name).nbytes for table in tables for name in table.ROWS) / 2**20


if __name__ == "__main__":
    main()
