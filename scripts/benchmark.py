"""Milliseconds a frame, with time and frame by frame: python scripts/benchmark.py [--data FOLDER].

Reconstructs the Shelf recording (or another one, or the built-in scene where there is no recording) both ways,
alternately in one run, and prints the time of every stage, the processor's time and the clock's, and their
ratios; then the clock with worker processes. Then a cheap recording (two people, four cameras) of rising
`--lengths`: time a frame must not grow, nor memory beyond the rows of the result. `--stretch NAME:A:B` takes
frames of a simulated recording instead. On a machine that does nothing else.
"""

import argparse
import os
import platform
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from rich.console import Console
from rich.table import Table

from shapepose_fg.core.camera import Rig
from shapepose_fg.core.detections import DetectionSequence
from shapepose_fg.core.provenance import versions
from shapepose_fg.evaluation.speed import STAGES, BackAndForth, Spent, peak_mib, rows_mib, spend
from shapepose_fg.io.calibration import read_rig
from shapepose_fg.io.detections import read_detections
from shapepose_fg.pipeline.pipeline import PipelineConfig
from shapepose_fg.simulation import Scene, built_in_scene, simulate
from shapepose_fg.simulation.files import named_scene


@dataclass(frozen=True)
class Timed:
    """What is reconstructed."""

    name: str
    """For the title."""
    detections: DetectionSequence
    """Its frames."""
    rig: Rig
    """Its cameras."""


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    data = os.environ.get("SHAPEPOSE_DATA", Path(__file__).parents[2] / "shared")
    parser.add_argument("--data", type=Path, default=data, help="folder with calibration.json, or with data/shelf")
    parser.add_argument(
        "--scene", action="store_true", help="use the built-in scene, even where there is a recording"
    )
    parser.add_argument("--stretch", metavar="NAME:A:B", help="frames of a sequence, report split: salsa:108:408")
    parser.add_argument("--frames", type=int, help="the first frames only (default: all)")
    parser.add_argument("--threads", type=int, default=PipelineConfig().threads, help="threads of torch")
    parser.add_argument("--rounds", type=int, default=2, help="runs of each mode, the best counts; 0: none")
    parser.add_argument("--workers", type=int, nargs="*", default=[2], help="processes, beside one")
    parser.add_argument("--lengths", type=int, nargs="*", default=[300, 3000], help="of the cheap recording")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    console = Console()
    config = replace(PipelineConfig(), threads=arguments.threads)
    console.print(_machine(config), highlight=False)
    if arguments.rounds > 0:
        recording = _recording(arguments)
        frames = range(len(recording.detections))[: arguments.frames]
        console.print(_stage_table(recording, compare(recording, config, frames, arguments.rounds)))
        for line in side_by_side(recording, config, len(frames), arguments.workers):
            console.print(line, highlight=False)
    for line in linearity(config, sorted(arguments.lengths)):
        console.print(line, highlight=False)


def compare(recording: Timed, config: PipelineConfig, frames: range, rounds: int) -> dict[bool, Spent]:
    """With time (True) and frame by frame, alternately; the best of `rounds` of each, by the processor's time."""
    spend(recording.detections, recording.rig, config, frames[:8])  # warm-up
    best: dict[bool, Spent] = {}
    for _ in range(rounds):
        for temporal in (False, True):
            now = spend(recording.detections, recording.rig, replace(config, temporal=temporal), frames)
            if temporal not in best or now.cpu_s < best[temporal].cpu_s:
                best[temporal] = now
    return best


def side_by_side(recording: Timed, config: PipelineConfig, count: int, workers: list[int]) -> Iterator[str]:
    """Lines about the clock with more processes: the recording as it is, and played four times over.

    Starting the processes is in the time; of a longer recording it is less.
    """
    for length in (count, 4 * count) if len(workers) > 0 else ():
        played = BackAndForth(recording.detections, length)
        alone = spend(played, recording.rig, config, range(length))
        for number in workers:
            now = spend(played, recording.rig, config, range(length), number)
            yield (
                f"{length} frames, {number} workers: clock {now.wall_ms:.1f} ms a frame,"
                f" {alone.wall_ms:.1f} with one, ratio {alone.wall_ms / now.wall_ms:.2f}"
            )


def linearity(config: PipelineConfig, lengths: list[int]) -> Iterator[str]:
    """Lines about one recording, longer and longer: time a frame, peak memory."""
    if len(lengths) == 0:
        return
    scene = built_in_scene(people=2, cameras=4, frames=100)
    short = simulate(scene)
    spend(short, scene.rig, config, range(len(short)))  # warm-up: what is loaded once counts for none
    for length in lengths:
        now = spend(BackAndForth(short, length), scene.rig, config, range(length))
        yield (
            f"{length} frames: processor {now.cpu_ms:.2f} ms a frame, peak memory {peak_mib():.0f} MiB,"
            f" {rows_mib(now.people):.1f} MiB of it rows of the result"
        )


def _recording(arguments: argparse.Namespace) -> Timed:
    """What was asked for."""
    if arguments.stretch is not None:
        name, first, last = arguments.stretch.split(":")
        scene = named_scene(name, split="report", frames=int(last))
        return _simulated(arguments.stretch, scene.part(range(int(first), int(last))))
    inner = arguments.data / "data" / "shelf"
    folder = inner if inner.is_dir() else arguments.data
    if arguments.scene or not (folder / "calibration.json").is_file():
        return _simulated("the built-in scene", built_in_scene())
    rig = read_rig(folder / "calibration.json")
    return Timed(folder.resolve().name, read_detections(folder, rig), rig)


def _simulated(name: str, scene: Scene) -> Timed:
    return Timed(name, simulate(scene), scene.rig)


def _machine(config: PipelineConfig) -> str:
    """Processor, cores, threads, how busy it was, versions."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    load = f"load {os.getloadavg()[0]:.1f} before the start" if hasattr(os, "getloadavg") else ""
    numbers = versions()
    packages = ", ".join(f"{name} {numbers[name]}" for name in ("python", "numpy", "gtsam", "torch"))
    threads = f"{config.threads} thread{'s' if config.threads > 1 else ''} of torch"
    return f"{_processor()}, {cores} cores, {threads}, {load}\n{packages}"


def _processor() -> str:
    """Its name, as the system gives it."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    named = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return named[0] if named else platform.processor() or platform.machine()


def _stage_table(recording: Timed, best: dict[bool, Spent]) -> Table:
    """Time by stage of both modes."""
    alone, over_time = best[False], best[True]
    people = len(over_time.people) / over_time.frames
    seen = f"{len(recording.rig)} cameras, {people:.1f} people a frame"
    table = Table(title=f"{recording.name}: {over_time.frames} frames, {seen}", title_justify="left")
    table.add_column("milliseconds a frame")
    for heading in ("with time", "frame by frame", "ratio"):
        table.add_column(heading, justify="right")
    for stage in STAGES:
        table.add_row(stage, f"{over_time.ms(stage):.1f}", f"{alone.ms(stage):.1f}")
    table.add_section()
    for name, of in (("all, processor", "cpu_ms"), ("all, clock", "wall_ms")):
        with_time, without = getattr(over_time, of), getattr(alone, of)
        table.add_row(name, f"{with_time:.1f}", f"{without:.1f}", f"{with_time / without:.2f}", style="bold")
    return table


if __name__ == "__main__":
    main()
