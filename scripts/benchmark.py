"""Milliseconds a frame, with time and frame by frame: python scripts/benchmark.py [--data FOLDER].

Reconstructs the Shelf recording (or another one, or the built-in scene where there is no recording) both ways,
alternately in one run, and prints the time of every stage, the processor's time and the clock's, their ratios, and
where stage II's time goes; then the clock with worker processes. Then a cheap recording (two people, four cameras)
of rising `--lengths`: time a frame must not grow, nor memory beyond the rows of the result. `--stretch NAME:A:B`
takes frames of a simulated recording instead, `--simulate NAME` times the simulator, with one worker and two.
`--chunks FRAMES` compares chunks of so many frames on `--workers` processes with one process and no chunks: ratio
of the clocks, how far joints are apart at the seams and elsewhere, and who loses the identity. On a machine
that does nothing else.
"""

import argparse
import os
import platform
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from rich.console import Console
from rich.table import Table

from shapepose_fg.core.camera import Rig
from shapepose_fg.core.detections import DetectionSequence
from shapepose_fg.core.frame_times import FrameTimes
from shapepose_fg.core.provenance import versions
from shapepose_fg.evaluation.seams import compare_seams
from shapepose_fg.evaluation.speed import STAGES, BackAndForth, Spent, peak_mib, rows_mib, spend, stage_two
from shapepose_fg.io.calibration import read_rig
from shapepose_fg.io.detections import read_detections
from shapepose_fg.pipeline.pipeline import PipelineConfig
from shapepose_fg.pipeline.runs.chunks import cut_in_chunks
from shapepose_fg.simulation import Scene, built_in_scene, simulate
from shapepose_fg.simulation.files import NAMES, cut, named_scene


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
    parser.add_argument(
        "--data", type=Path, default=_default_data(), help="folder with calibration.json, or with data/shelf"
    )
    parser.add_argument(
        "--scene", action="store_true", help="use the built-in scene, even where there is a recording"
    )
    parser.add_argument("--stretch", metavar="NAME:A:B", help="frames of a sequence, report split: salsa:108:408")
    parser.add_argument("--frames", type=int, help="the first frames only (default: all)")
    parser.add_argument("--threads", type=int, default=PipelineConfig().threads, help="threads of torch")
    parser.add_argument("--rounds", type=int, default=2, help="runs of each mode, the best counts; 0: none")
    parser.add_argument("--workers", type=int, nargs="*", default=[2], help="processes, beside one")
    parser.add_argument("--lengths", type=int, nargs="*", default=[300, 3000], help="of the cheap recording")
    parser.add_argument(
        "--simulate", metavar="NAME", choices=NAMES, help="time the simulator on this scene instead"
    )
    parser.add_argument("--chunks", type=int, metavar="FRAMES", help="compare chunks of so many frames instead")
    parser.add_argument("--times", type=int, default=8, help="with --chunks, how often the recording is played")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    console = Console()
    config = replace(PipelineConfig(), threads=arguments.threads)
    console.print(_machine(config), highlight=False)
    if arguments.simulate is not None:
        console.print(_simulation_table(arguments.simulate, arguments.frames or 600))
        return
    if arguments.chunks is not None:
        recording = _recording(arguments)
        count = arguments.times * min(arguments.frames or len(recording.detections), len(recording.detections))
        for line in chunked(recording, config, count, arguments.chunks, arguments.workers):
            console.print(line, highlight=False)
        return
    if arguments.rounds > 0:
        recording = _recording(arguments)
        count = len(recording.detections)
        frames = range(count if arguments.frames is None else min(arguments.frames, count))
        best = compare(recording, config, frames, arguments.rounds)
        shares = stage_two(recording.detections, recording.rig, config, frames[:96])
        console.print(_stage_table(recording, best, shares))
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


def side_by_side(recording: Timed, config: PipelineConfig, count: int, workers: list[int]):
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


def chunked(recording: Timed, config: PipelineConfig, count: int, chunk_frames: int, workers: list[int]):
    """Lines about chunks on several processes against one process and no chunks.

    The recording is played up to `count` frames, back and forth: seams are at other places of it each time.
    """
    played = BackAndForth(recording.detections, count)
    span, times = range(count), FrameTimes.assumed(count)
    chunks = cut_in_chunks(span, (), times.frame_s, config, chunk_frames)
    borders = [chunk.own.start for chunk in chunks[1:]]
    overlap = int(np.searchsorted(times.frame_s, config.windows.overlap_s, side="right"))
    spend(played, recording.rig, config, range(8))  # warm-up
    alone = spend(played, recording.rig, config, span)
    for number in workers:
        now = spend(played, recording.rig, config, span, number, chunk_frames)
        found = compare_seams(alone.people, now.people, borders, overlap)
        yield (
            f"{count} frames in {len(chunks)} chunks, {number} workers: clock {now.wall_ms:.1f} ms a frame,"
            f" {alone.wall_ms:.1f} in one process uncut, ratio {alone.wall_ms / now.wall_ms:.2f};"
            f" processor {now.cpu_ms:.1f} and {alone.cpu_ms:.1f}"
        )
        yield (
            f"joints at most {found.at_seams_mm:.3f} mm apart within an overlap ({overlap} frames) of"
            f" {found.seams} seams, {found.away_mm:.3f} mm elsewhere; {found.lost} of {found.crossings} people"
            f" lose their identity at a seam; {found.unmatched} rows are in one result only"
        )


def linearity(config: PipelineConfig, lengths: list[int]):
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


def simulation_speed(scene: Scene, workers: int) -> tuple[float, float]:
    """Frames a second, and CPU milliseconds a frame of all processes together (where the system counts them)."""
    before, start = os.times(), time.perf_counter()
    simulate(scene, workers=workers)
    seconds, after = time.perf_counter() - start, os.times()
    return len(scene) / seconds, 1e3 * (sum(after[:4]) - sum(before[:4])) / len(scene)


def _simulation_table(name: str, frames: int) -> Table:
    """The first frames of a scene, with one worker and with two."""
    whole = named_scene(name, frames=frames)
    scene = cut(whole, range(min(frames, len(whole))))
    title = f"simulate {name}: {len(scene)} frames, {len(scene.rig)} cameras, {scene.people} people"
    table = Table(title=title, title_justify="left")
    for column in ("workers", "frames a second", "CPU ms a frame", "ratio"):
        table.add_column(column, justify="right")
    alone = simulation_speed(scene, 1)
    for workers, (speed, cpu_ms) in ((1, alone), (2, simulation_speed(scene, 2))):
        table.add_row(str(workers), f"{speed:.1f}", f"{cpu_ms:.1f}", f"{speed / alone[0]:.2f}")
    return table


def _default_data() -> Path | None:
    """The folder of real recordings: SHAPEPOSE_DATA, else the folder `shared` beside the checkout, if there."""
    root = Path(os.environ.get("SHAPEPOSE_DATA", Path(__file__).parents[2] / "shared"))
    return root if (root / "data" / "shelf").is_dir() else None


def _recording(arguments: argparse.Namespace) -> Timed:
    """What was asked for."""
    if arguments.stretch is not None:
        name, first, last = arguments.stretch.split(":")
        scene = named_scene(name, split="report", frames=int(last))
        return _simulated(arguments.stretch, cut(scene, range(int(first), int(last))))
    if arguments.scene or arguments.data is None:
        return _simulated("the built-in scene", built_in_scene())
    inner = arguments.data / "data" / "shelf"
    folder = inner if inner.is_dir() else arguments.data
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


def _stage_table(recording: Timed, best: dict[bool, Spent], shares: dict[str, float]) -> Table:
    """Time by stage of both modes, stage II of the one with time taken apart."""
    alone, over_time = best[False], best[True]
    people = len(over_time.people) / over_time.frames
    seen = f"{len(recording.rig)} cameras, {people:.1f} people a frame"
    table = Table(title=f"{recording.name}: {over_time.frames} frames, {seen}", title_justify="left")
    for heading in ("milliseconds a frame", "with time", "frame by frame", "ratio"):
        table.add_column(heading, justify="left" if heading == "milliseconds a frame" else "right")
    for stage in STAGES:
        table.add_row(stage, f"{over_time.ms(stage):.1f}", f"{alone.ms(stage):.1f}")
        if stage == "solve":
            table.add_row("  bodies fitted", f"{over_time.ms('bodies'):.1f}", f"{alone.ms('bodies'):.1f}")
            rest = over_time.ms("solve") - over_time.ms("bodies")
            for part, share in shares.items():
                table.add_row(f"  {part}", f"{share * rest:.1f}", style="dim")
    table.add_section()
    for name, of in (("all, processor", "cpu_ms"), ("all, clock", "wall_ms")):
        with_time, without = getattr(over_time, of), getattr(alone, of)
        table.add_row(name, f"{with_time:.1f}", f"{without:.1f}", f"{with_time / without:.2f}", style="bold")
    return table


if __name__ == "__main__":
    main()
