"""Measure the cost of complete commands, now and at an earlier commit: python scripts/benchmark.py
[--against COMMIT].

Runs `shapepose-fg reconstruct` as a separate process on each recording, alternately from this
checkout and from that of the commit, `--rounds` times each after a short warm-up run (which
compiles and is not counted). Prints medians and spread of processor time, wall time and peak
memory, the median ratio of runs that followed each other, and the wall time of each stage.
`--growth` runs this checkout on simulated recordings that differ in one size, and prints the
exponent with which processor time, beyond that of a single frame, grows. Processes use one thread;
the machine should be idle otherwise.

The recording is Shelf if it is available (`--data`), otherwise the built-in scene. `crowd` is salsa
of eight people and six cameras, from recorded motions if these are available. Longer recordings are
made by playing it forwards and backwards.
"""

import json
import math
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Annotated

from rich.console import Console
from rich.table import Table
from typer import BadParameter, Option, Typer

from shapepose_fg.core.camera import Rig
from shapepose_fg.core.compiling import cores
from shapepose_fg.core.detections import DetectionSequence, Recording
from shapepose_fg.core.provenance import versions
from shapepose_fg.io.calibration import read_rig
from shapepose_fg.io.detections import read_detections
from shapepose_fg.io.write_detections import write_association
from shapepose_fg.simulation import built_in_scene, simulate
from shapepose_fg.simulation.detector import DetectorConfig
from shapepose_fg.simulation.mocap import Mocap
from shapepose_fg.simulation.sequences import sequence

HERE = Path(__file__).parent.parent
CASES = {
    "recording": ("short", ()),
    "frame by frame": ("short", ("--no-temporal",)),
    "one frame": ("short", ("--frames", "0:1")),
    "crowd": ("crowd", ()),
    "long": ("long", ()),
    "long, two processes": ("long", ("--workers", "2")),
    "recording, fast": ("short", ("--preset", "fast")),
    "crowd, fast": ("crowd", ("--preset", "fast")),
    "recording, paper": ("short", ("--preset", "paper")),
}
"""For each case, the recording and additional options."""
_USUAL = {"frames": 300, "people": 4, "cameras": 6, "false_candidates": 1}
_GROWTH = {
    "frames": (300, 3000),
    "people": (2, 4, 8, 16),
    "cameras": (3, 6, 12, 24),
    "false_candidates": (1, 10),
}
"""Sizes of simulated recordings; all others are `_USUAL`. Every camera stands elsewhere."""
_ENVIRONMENT = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
_ENVIRONMENT |= {"PYTHONDONTWRITEBYTECODE": ""}


@dataclass(frozen=True)
class Spent:
    """Resources used by a run of a command."""

    cpu_s: float
    """Processor time, seconds; NaN with worker processes, whose times are not included."""
    wall_s: float
    """Wall time, seconds."""
    peak_mib: float
    """Peak memory of the process, MiB."""
    stages_s: dict[str, float]
    """Wall time of each stage, seconds, without that of stages inside it."""


app = Typer(add_completion=False)


@app.command(help=__doc__)
def main(
    against: Annotated[str | None, Option(help="Commit to be compared with.")] = None,
    case: Annotated[list[str] | None, Option(help=f"Some of {[*CASES]}; default: all.")] = None,
    rounds: Annotated[int, Option(help="Counted runs of each.")] = 5,
    data: Annotated[
        Path,
        Option(help="Folder with data/shelf, or with calibration.json.", envvar="SHAPEPOSE_DATA"),
    ] = HERE.parent / "shared",
    frames: Annotated[int | None, Option(help="Only the first frames of each recording.")] = None,
    grow: Annotated[bool, Option("--growth", help="How time and memory grow.")] = False,
) -> None:
    """Run the measurements and print the tables."""
    for unknown in set(case or ()) - CASES.keys():
        raise BadParameter(f"{unknown}: must be one of {', '.join(CASES)}")
    console = Console()
    console.print(_machine(), highlight=False)
    if grow:
        with tempfile.TemporaryDirectory() as work:
            return console.print(growth(Path(work)))
    with tempfile.TemporaryDirectory() as work, _checkouts(against, Path(work)) as trees:
        made: dict[str, tuple[list[str], int]] = {}
        for name in case or CASES:
            kind, more = CASES[name]
            if kind not in made:
                made[kind] = _written(kind, data, Path(work) / kind, frames)
            options, count = made[kind]
            spent = compare(trees, [*options, *more], Path(work), rounds)
            console.print(_table(name if "--frames" in more else f"{name}: {count} frames", spent))


def compare(
    trees: dict[str, Path], options: Sequence[str], work: Path, rounds: int
) -> dict[str, list[Spent]]:
    """Run the command in each tree, alternately, `rounds` times after a warm-up."""
    spent: dict[str, list[Spent]] = {name: [] for name in trees}
    for tree in trees.values():
        short = [] if "--frames" in options else ["--frames", "0:8"]
        spend(tree, [*options, *short], work / "results")
    for _ in range(rounds):
        for name, tree in trees.items():
            spent[name].append(spend(tree, options, work / "results"))
    return spent


def spend(tree: Path, options: Sequence[str], output: Path) -> Spent:
    """Run `reconstruct` from the checkout `tree`; if it fails, raise its error message."""
    workers = [] if "--workers" in options else ["--workers", "1"]
    command = [
        sys.executable,
        "-m",
        "shapepose_fg",
        "reconstruct",
        *options,
        *workers,
        "--overwrite",
    ]
    environment = os.environ | _ENVIRONMENT | {"PYTHONPATH": str(tree)}
    with tempfile.TemporaryFile() as output_file:
        start = time.perf_counter()
        process = subprocess.Popen(
            [*command, "--output", str(output)],
            cwd=output.parent,
            env=environment,
            stdout=output_file,
            stderr=output_file,
        )
        _, status, used = os.wait4(process.pid, 0)
        wall_s = time.perf_counter() - start
        process.returncode = os.waitstatus_to_exitcode(status)
        output_file.seek(0)
        if process.returncode != 0:
            raise SystemExit(f"{tree}: {' '.join(command)} failed:\n{output_file.read().decode()}")
    peak_mib = used.ru_maxrss / (2**20 if sys.platform == "darwin" else 2**10)
    stages_s = json.loads((output / "run.json").read_text(encoding="utf-8"))["seconds"]
    cpu_s = math.nan if "--workers" in options else used.ru_utime + used.ru_stime
    return Spent(cpu_s, wall_s, peak_mib, stages_s)


def growth(work: Path) -> Table:
    """Cost of this checkout on recordings of all sizes in `_GROWTH`."""

    def cost(*more: str, **sizes: int) -> Spent:
        size = _USUAL | sizes
        scene = built_in_scene(
            people=size["people"], cameras=size["cameras"], frames=_USUAL["frames"]
        )
        seen = simulate(scene, DetectorConfig(false_candidates=size["false_candidates"]))
        options = _options(to_and_fro(seen, size["frames"]), scene.rig, scene.fps, work / "grown")
        return spend(HERE, [*options, *more], work / "results")

    cost("--frames", "0:8")  # compiles
    start_s, table = cost("--frames", "0:1").cpu_s, Table("", "processor s", "exponent", "peak MiB")
    for what, values in _GROWTH.items():
        spent = [cost(**{what: value}) for value in values]
        first = spent[0].cpu_s - start_s
        for value, each in zip(values, spent, strict=True):
            more, grown = (each.cpu_s - start_s) / first, value / values[0]
            exponent = f"{math.log(more) / math.log(grown):.2f}" if grown > 1 else ""
            table.add_row(f"{what} {value}", f"{each.cpu_s:.1f}", exponent, f"{each.peak_mib:.0f}")
    return table


def to_and_fro(recording: DetectionSequence, frames: int) -> Recording:
    """A recording of `frames` frames: `recording` played alternately forwards and backwards, so
    that people do not jump.
    """
    count = len(recording)
    turns = (divmod(frame, count) for frame in range(frames))
    return Recording(
        recording.skeleton, [recording[p if turn % 2 == 0 else count - 1 - p] for turn, p in turns]
    )


@contextmanager
def _checkouts(commit: str | None, work: Path) -> Iterator[dict[str, Path]]:
    """Checkouts by name: this one and, if requested, that of a commit."""
    if commit is None:
        yield {"here": HERE}
        return
    git = ["git", "-C", str(HERE), "worktree"]
    subprocess.run(
        [*git, "add", "--detach", str(work / "against"), commit], check=True, capture_output=True
    )
    try:
        yield {commit: work / "against", "here": HERE}
    finally:
        subprocess.run(
            [*git, "remove", "--force", str(work / "against")], check=True, capture_output=True
        )


def _written(kind: str, data: Path, folder: Path, frames: int | None) -> tuple[list[str], int]:
    """Options for a recording of a `kind`, which is written into `folder` if necessary, and its
    number of frames.
    """
    recording, rig, fps = _crowd(data) if kind == "crowd" else _short(data)
    count = 3000 if kind == "long" else len(recording)
    count = min(count, frames or count)
    return _options(to_and_fro(recording, count), rig, fps, folder), count


def _options(recording: Recording, rig: Rig, fps: float, folder: Path) -> list[str]:
    """Options of the command for a recording, which is written into `folder`."""
    write_association(recording, rig, folder)
    files = str(folder / "calibration.json"), str(folder / "detection")
    return ["--calibration", files[0], "--detections", files[1], "--fps", str(fps)]


def _short(data: Path) -> tuple[DetectionSequence, Rig, float]:
    """Shelf, or the recording in `data`, or the built-in scene."""
    inner = data / "data" / "shelf"
    folder = inner if inner.is_dir() else data
    if not (folder / "calibration.json").is_file():
        scene = built_in_scene()
        return simulate(scene), scene.rig, scene.fps
    rig = read_rig(folder / "calibration.json")
    return read_detections(folder, rig), rig, 25.0


def _crowd(data: Path) -> tuple[DetectionSequence, Rig, float]:
    """Eight people and six cameras: salsa from recorded motions, or the built-in scene."""
    motions = data / "data" / "cmu_mocap" / "cmu_smpl24.npz"
    if motions.is_file():
        scene = sequence("salsa", "report", Mocap.load(motions), cameras=6, until=408).part(
            range(108, 408)
        )
    else:
        scene = built_in_scene(people=8)
    return simulate(scene), scene.rig, scene.fps


def _machine() -> str:
    """Description of the machine: processor, cores, load, versions."""
    load = f", load {os.getloadavg()[0]:.1f} before the start" if hasattr(os, "getloadavg") else ""
    info = Path("/proc/cpuinfo")
    lines = info.read_text(encoding="utf-8").splitlines() if info.is_file() else []
    named = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    numbers = versions()
    packages = ", ".join(f"{name} {numbers[name]}" for name in ("python", "numpy", "gtsam"))
    return (
        f"{[*named, platform.processor() or platform.machine()][0]}, {cores()} "
        f"cores{load}\n{packages}"
    )


def _table(title: str, spent: dict[str, list[Spent]]) -> Table:
    """Medians with minimum and maximum, and the ratio of the last tree to the first."""
    table = Table(title=title, title_justify="left")
    table.add_column("seconds")
    for name in spent:
        table.add_column(name, justify="right")
    table.add_column("ratio", justify="right")

    def row(label: str, values: list[list[float]], digits: int, style: str | None = None) -> None:
        cells = [
            f"{median(v):.{digits}f} ({min(v):.{digits}f} to {max(v):.{digits}f})" for v in values
        ]
        ratios = [last / first for first, last in zip(values[0], values[-1], strict=True) if first]
        if not any(map(math.isnan, values[-1])):
            table.add_row(label, *cells, f"{median(ratios):.2f}" if ratios else "", style=style)

    runs = list(spent.values())
    row("processor", [[each.cpu_s for each in tree] for tree in runs], 2, "bold")
    row("clock", [[each.wall_s for each in tree] for tree in runs], 2)
    row("peak memory, MiB", [[each.peak_mib for each in tree] for tree in runs], 0)
    table.add_section()
    for stage in dict.fromkeys(stage for tree in runs for each in tree for stage in each.stages_s):
        row(stage, [[each.stages_s.get(stage, 0.0) for each in tree] for tree in runs], 2)
    return table


if __name__ == "__main__":
    app()
