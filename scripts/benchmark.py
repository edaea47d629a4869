"""Milliseconds a frame, stage by stage: python scripts/benchmark.py [--data FOLDER].

Reconstructs the Shelf recording (or another one, or the built-in scene where there is no recording) in the
batches that the pipeline makes, and prints the median over the batches, the mean over all frames, where stage
II's time goes, and ratios of settings against each other; with --simulate NAME, how fast a recording is simulated
instead, with one worker and with two. Run it on a machine that does nothing else.
"""

import argparse
import cProfile
import os
import platform
import pstats
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from shapepose_fg.body.fitting.fitter import BodyFit, BodyFitter, JointTargets
from shapepose_fg.body.fitting.fitters import make_fitter
from shapepose_fg.camera import Rig
from shapepose_fg.detections import DetectionSequence
from shapepose_fg.io.calibration import read_rig
from shapepose_fg.io.detections import read_detections
from shapepose_fg.pipeline import PipelineConfig, reconstruct
from shapepose_fg.provenance import versions
from shapepose_fg.simulation import Scene, built_in_scene, simulate
from shapepose_fg.simulation.files import NAMES, cut, named_scene

STAGES = ("read", "triangulate", "vote", "propose", "associate", "refine")
PARTS = {
    "graphs built": ("estimator.py", "_windows"),
    "graphs solved": ("alternation.py", "_solve"),
    "covariances": ("window_graph.py", "marginals"),
    "gates and weights": ("linearisation.py", "linearise"),
}
"""Parts of stage II beside the body fits, and the function whose time is taken for each."""


@dataclass(frozen=True)
class Recording:
    """What is reconstructed."""

    name: str
    """For the title."""
    detections: DetectionSequence
    """Its frames."""
    rig: Rig
    """Its cameras."""
    read_s: float
    """Seconds that reading the files took; 0 for the scene."""


@dataclass
class TimedFitter:
    """A body fitter that adds up the time it takes."""

    fitter: BodyFitter
    """Does the work."""
    seconds: float = 0.0
    """Time since the last reset."""

    def fit(
        self, targets: JointTargets, initial: BodyFit | None = None, groups: np.ndarray | None = None
    ) -> BodyFit:
        """Fit, and look at the clock before and after."""
        start = time.perf_counter()
        result = self.fitter.fit(targets, initial, groups)
        self.seconds += time.perf_counter() - start
        return result


@dataclass(frozen=True)
class Timing:
    """Time of every stage in every batch."""

    frames: np.ndarray
    """(B,) frames of each batch."""
    people: int
    """People found in all."""
    seconds: dict[str, np.ndarray]
    """Stage -> (B,) seconds; `bodies` is the part of `refine` in which bodies are fitted."""

    def median_ms(self, stage: str) -> float:
        """Median over the batches of milliseconds a frame."""
        return float(1e3 * np.median(self.seconds[stage] / self.frames))

    def mean_ms(self, stage: str) -> float:
        """All batches' time over all frames, milliseconds."""
        return float(1e3 * self.seconds[stage].sum() / self.frames.sum())


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--data", type=Path, default=_default_data(), help="folder with calibration.json, or with data/shelf"
    )
    parser.add_argument(
        "--scene", action="store_true", help="use the built-in scene, even where there is a recording"
    )
    parser.add_argument("--frames", type=int, help="the first frames only (default: all)")
    parser.add_argument("--threads", type=int, default=PipelineConfig().threads, help="threads of torch")
    parser.add_argument("--rounds", type=int, default=3, help="how often settings are compared; 0: not at all")
    parser.add_argument(
        "--simulate", metavar="NAME", choices=NAMES, help="time the simulator on this scene instead"
    )
    arguments = parser.parse_args()

    console = Console()
    config = replace(PipelineConfig(), threads=arguments.threads)
    if arguments.simulate is not None:
        console.print(_machine(config), highlight=False)
        console.print(_simulation_table(arguments.simulate, arguments.frames or 600))
        return
    recording = _scene() if arguments.scene or arguments.data is None else _read(arguments.data)
    count = len(recording.detections)
    frames = range(count if arguments.frames is None else min(arguments.frames, count))
    console.print(_machine(config), highlight=False)
    fitter = TimedFitter(make_fitter(config.body))
    reconstruct(recording.detections, recording.rig, config, frames=frames[:8], fitter=fitter)  # warm-up
    timing = measure(recording, config, frames, fitter)
    console.print(_stage_table(recording, timing, stage_two(recording, config, frames, fitter)))
    if arguments.rounds > 0:
        console.print(_ratio_table(ratios(recording, config, frames[:64], fitter, arguments.rounds), frames[:64]))


def measure(recording: Recording, config: PipelineConfig, frames: range, fitter: TimedFitter) -> Timing:
    """Time every batch of `config.batch_frames` frames by itself."""
    runs = []
    for start in range(0, len(frames), config.batch_frames):
        batch = frames[start : start + config.batch_frames]
        fitter.seconds = 0.0
        people = reconstruct(recording.detections, recording.rig, config, frames=batch, fitter=fitter)
        runs.append((len(batch), len(people), people.run["seconds"] | {"bodies": fitter.seconds}))
    lengths = np.array([length for length, _, _ in runs])
    seconds = {name: np.array([spent[name] for _, _, spent in runs]) for name in (*STAGES, "bodies")}
    seconds["read"] = seconds["read"] + recording.read_s * lengths / len(recording.detections)
    seconds["all"] = np.sum([seconds[stage] for stage in STAGES], axis=0)
    return Timing(lengths, sum(people for _, people, _ in runs), seconds)


def stage_two(
    recording: Recording, config: PipelineConfig, frames: range, fitter: TimedFitter
) -> dict[str, float]:
    """Shares of stage II without the body fits, from a pass under Python's profiler.

    The profiler slows Python down and leaves GTSAM and torch as they are: shares of a few per cent are rough.
    """
    profile = cProfile.Profile()
    profile.runcall(reconstruct, recording.detections, recording.rig, config, frames=frames, fitter=fitter)
    spent: dict[tuple[str, str], float] = {}
    for (file, _, function), row in vars(pstats.Stats(profile))["stats"].items():
        spent[Path(file).name, function] = row[3]
    whole = spent["alternation.py", "refine"] - spent[Path(__file__).name, "fit"]
    shares = {part: spent.get(where, 0.0) / whole for part, where in PARTS.items()}
    return shares | {"the rest": 1.0 - sum(shares.values())}


def ratios(
    recording: Recording, config: PipelineConfig, frames: range, fitter: BodyFitter, rounds: int
) -> dict[str, float]:
    """Time of other settings over that of `config`, alternately in one run: the best of `rounds` of each."""
    here = f"batch_frames = {config.batch_frames}, threads = {config.threads}"
    settings = {here: config}
    for size in (1, 4, 16, 64):
        settings[f"batch_frames = {size}"] = replace(config, batch_frames=size)
    for threads in (1, 2):
        settings[f"threads = {threads}"] = replace(config, threads=threads)
    settings = {name: other for name, other in settings.items() if name == here or other != config}
    best = dict.fromkeys(settings, float("inf"))
    for _ in range(rounds):
        for name, other in settings.items():
            people = reconstruct(recording.detections, recording.rig, other, frames=frames, fitter=fitter)
            best[name] = min(best[name], sum(people.run["seconds"].values()))
    return {name: spent / best[here] for name, spent in best.items()}


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


def _read(folder: Path) -> Recording:
    """A recording in 4D Association's format."""
    inner = folder / "data" / "shelf"
    folder = inner if inner.is_dir() else folder
    rig = read_rig(folder / "calibration.json")
    start = time.perf_counter()
    detections = read_detections(folder, rig)
    return Recording(folder.resolve().name, detections, rig, time.perf_counter() - start)


def _scene() -> Recording:
    scene = built_in_scene()
    return Recording("the built-in scene", simulate(scene), scene.rig, 0.0)


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


def _stage_table(recording: Recording, timing: Timing, shares: dict[str, float]) -> Table:
    """Time by stage, stage II taken apart."""
    frames = int(timing.frames.sum())
    seen = f"{len(recording.rig)} cameras, {timing.people / frames:.1f} people a frame"
    title = f"{recording.name}: {frames} frames, {seen}"
    table = Table(title=title, title_justify="left")
    table.add_column("milliseconds a frame")
    table.add_column(f"median of {len(timing.frames)} batches", justify="right")
    table.add_column("all frames", justify="right")
    for stage in STAGES:
        table.add_row(stage, f"{timing.median_ms(stage):.1f}", f"{timing.mean_ms(stage):.1f}")
    table.add_row("  bodies fitted", f"{timing.median_ms('bodies'):.1f}", f"{timing.mean_ms('bodies'):.1f}")
    rest = [figure("refine") - figure("bodies") for figure in (timing.median_ms, timing.mean_ms)]
    for part, share in shares.items():
        table.add_row(f"  {part}", *(f"{share * value:.1f}" for value in rest), style="dim")
    table.add_section()
    table.add_row("all", f"{timing.median_ms('all'):.1f}", f"{timing.mean_ms('all'):.1f}", style="bold")
    return table


def _ratio_table(found: dict[str, float], frames: range) -> Table:
    """How much longer other settings take."""
    table = Table(
        title=f"Time of other settings over that of the first ({len(frames)} frames)", title_justify="left"
    )
    table.add_column("setting")
    table.add_column("ratio", justify="right")
    for name, ratio in found.items():
        table.add_row(name, f"{ratio:.2f}")
    return table


if __name__ == "__main__":
    main()
