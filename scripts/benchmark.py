"""Milliseconds a frame, with time and frame by frame: python scripts/benchmark.py [--data FOLDER].

Reconstructs the Shelf recording (or another one, or the built-in scene where there is no recording) both ways,
alternately in one run, and prints the time of every stage, the processor's time and the clock's, and their
ratios; then the clock with worker processes. Then a cheap recording (two people, four cameras) of rising
`--lengths`: time a frame must not grow, nor memory beyond the rows of the result. On a machine that does nothing
else.
"""

import argparse
import os
import platform
import resource
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from rich.console import Console
from rich.table import Table

from shapepose_fg.core.camera import Rig
from shapepose_fg.core.detections import Detections, DetectionSequence
from shapepose_fg.core.provenance import versions
from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.core.skeleton import Skeleton
from shapepose_fg.io.calibration import read_rig
from shapepose_fg.io.detections import read_detections
from shapepose_fg.pipeline.execution import Execution
from shapepose_fg.pipeline.pipeline import PipelineConfig, reconstruct
from shapepose_fg.simulation import built_in_scene, simulate


@dataclass(frozen=True)
class Spent:
    """What a run took."""

    people: Reconstruction
    """What came out."""
    cpu_ms: float
    """Milliseconds a frame of all processors, of processes that it started too."""
    wall_ms: float
    """Milliseconds a frame of the clock."""
    stages_ms: dict[str, float]
    """The clock's milliseconds a frame of each stage, without those of stages inside it."""


@dataclass(frozen=True)
class BackAndForth:
    """A long recording made of a short one, played forwards and backwards in turn, so that no person jumps."""

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


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    data = os.environ.get("SHAPEPOSE_DATA", Path(__file__).parents[2] / "shared")
    parser.add_argument("--data", type=Path, default=data, help="folder with calibration.json, or with data/shelf")
    parser.add_argument("--scene", action="store_true", help="the built-in scene, even where there is a recording")
    parser.add_argument("--frames", type=int, help="the first frames only (default: all)")
    parser.add_argument("--rounds", type=int, default=2, help="runs of each mode, the best counts; 0: none")
    parser.add_argument("--workers", type=int, nargs="*", default=[2], help="processes, beside one")
    parser.add_argument("--lengths", type=int, nargs="*", default=[300, 3000], help="of the cheap recording")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    console, config = Console(), PipelineConfig()
    console.print(_machine(), highlight=False)
    if arguments.rounds > 0:
        name, detections, rig = _recording(arguments.data, arguments.scene)
        frames = min(len(detections), arguments.frames or len(detections))
        best = compare(detections, rig, config, frames, arguments.rounds)
        console.print(_stage_table(f"{name}: {frames} frames, {len(rig)} cameras", best, frames))
        for line in side_by_side(detections, rig, config, frames, arguments.workers):
            console.print(line, highlight=False)
    for line in linearity(config, sorted(arguments.lengths)):
        console.print(line, highlight=False)


def compare(
    detections: DetectionSequence, rig: Rig, config: PipelineConfig, frames: int, rounds: int
) -> dict[bool, Spent]:
    """With time (True) and frame by frame, alternately; the best of `rounds` of each, by the processor's time."""
    spend(detections, rig, config, min(frames, 8))  # warm-up
    best: dict[bool, Spent] = {}
    for _ in range(rounds):
        for temporal in (False, True):
            now = spend(detections, rig, replace(config, temporal=temporal), frames)
            if temporal not in best or now.cpu_ms < best[temporal].cpu_ms:
                best[temporal] = now
    return best


def side_by_side(
    detections: DetectionSequence, rig: Rig, config: PipelineConfig, count: int, workers: list[int]
) -> Iterator[str]:
    """Lines about the clock with more processes: the recording as it is, and played four times over.

    Starting the processes is in the time; of a longer recording it is less.
    """
    for length in (count, 4 * count) if len(workers) > 0 else ():
        played = BackAndForth(detections, length)
        one = spend(played, rig, config, length).wall_ms
        for number in workers:
            now = spend(played, rig, config, length, number).wall_ms
            yield (
                f"{length} frames, {number} workers: clock {now:.1f} ms a frame,"
                f" {one:.1f} with one, ratio {one / now:.2f}"
            )


def linearity(config: PipelineConfig, lengths: list[int]) -> Iterator[str]:
    """Lines about one recording, longer and longer: time a frame, peak memory."""
    if len(lengths) == 0:
        return
    scene = built_in_scene(people=2, cameras=4, frames=100)
    short = simulate(scene)
    spend(short, scene.rig, config, len(short))  # warm-up: what is loaded once counts for none
    for length in lengths:
        now = spend(BackAndForth(short, length), scene.rig, config, length)
        yield (
            f"{length} frames: processor {now.cpu_ms:.2f} ms a frame, peak memory {peak_mib():.0f} MiB,"
            f" {rows_mib(now.people):.1f} MiB of it rows of the result"
        )


def spend(recording: DetectionSequence, rig: Rig, config: PipelineConfig, frames: int, workers: int = 1) -> Spent:
    """Reconstruct the first so many frames, and look at the clocks before and after."""
    before, start = os.times(), time.perf_counter()
    people = reconstruct(recording, rig, config, frames=range(frames), execution=Execution(workers=workers))
    wall_s, after = time.perf_counter() - start, os.times()
    stages = {name: 1e3 * seconds / frames for name, seconds in people.run["seconds"].items()}
    return Spent(people, 1e3 * (sum(after[:4]) - sum(before[:4])) / frames, 1e3 * wall_s / frames, stages)


def peak_mib() -> float:
    """The most memory that this process has had so far, MiB; it never falls."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 2**20 if sys.platform == "darwin" else peak / 2**10


def rows_mib(people: Reconstruction) -> float:
    """Memory of a result's rows and of their observations, MiB."""
    tables = [people] if people.observations is None else [people, people.observations]
    return sum(getattr(table, name).nbytes for table in tables for name in table.ROWS) / 2**20


def _recording(data: Path, built_in: bool) -> tuple[str, DetectionSequence, Rig]:
    """Name, frames and cameras of what was asked for."""
    inner = data / "data" / "shelf"
    folder = inner if inner.is_dir() else data
    if built_in or not (folder / "calibration.json").is_file():
        scene = built_in_scene()
        return "the built-in scene", simulate(scene), scene.rig
    rig = read_rig(folder / "calibration.json")
    return folder.resolve().name, read_detections(folder, rig), rig


def _machine() -> str:
    """Processor, cores, how busy it was, versions."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    load = f", load {os.getloadavg()[0]:.1f} before the start" if hasattr(os, "getloadavg") else ""
    info = Path("/proc/cpuinfo")
    lines = info.read_text(encoding="utf-8").splitlines() if info.is_file() else []
    named = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    numbers = versions()
    packages = ", ".join(f"{name} {numbers[name]}" for name in ("python", "numpy", "gtsam", "torch"))
    return f"{[*named, platform.processor() or platform.machine()][0]}, {cores} cores{load}\n{packages}"


def _stage_table(title: str, best: dict[bool, Spent], frames: int) -> Table:
    """Time by stage of both modes."""
    over_time, single = best[True], best[False]
    title += f", {len(over_time.people) / frames:.1f} people a frame"
    table = Table(title=title, title_justify="left")
    table.add_column("milliseconds a frame")
    for heading in ("with time", "frame by frame", "ratio"):
        table.add_column(heading, justify="right")
    for stage in over_time.stages_ms | single.stages_ms:
        table.add_row(stage, *(f"{each.stages_ms.get(stage, 0.0):.1f}" for each in (over_time, single)))
    table.add_section()
    for name, of in (("all, processor", "cpu_ms"), ("all, clock", "wall_ms")):
        both = getattr(over_time, of), getattr(single, of)
        cells = (*(f"{each:.1f}" for each in both), f"{both[0] / both[1]:.2f}")
        table.add_row(name, *cells, style="bold")
    return table


if __name__ == "__main__":
    main()
