"""Measure the effect of a number in the code: results with other values, on the same recordings.

    python scripts/vary_number.py tracking.track_selection._COST 0.2 x2 --mocap cmu_smpl24.npz
    python scripts/vary_number.py estimation.draft.DISAGREE inf --real rig.json detections truth 25

The number is a module-level constant of `shapepose_fg`; `x2` is twice the present value. Each value
is measured in a copy of the package in which only this assignment differs: recordings of `CASES`
(without `--mocap` only those of the built-in scene), and `--real` ones: calibration, detections,
truth (what `shapepose-fg evaluate` reads) and frames a second, 0 if frames are separate.

For each value prints the means over the recordings, and their differences from those of the present
value with twice the standard error, from the spread of paired differences over the recordings; `*`
marks differences beyond that. Choose numbers on these recordings only, and report others. A value
takes about five minutes on one core.
"""

import argparse
import ast
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.detections import DetectionSequence
from shapepose_fg.core.frame_times import FrameTimes
from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.evaluation.metrics import PlainPeople
from shapepose_fg.evaluation.score import score
from shapepose_fg.evaluation.truth import people_of, read_people
from shapepose_fg.io.calibration import read_rig
from shapepose_fg.io.detections import read_detections
from shapepose_fg.pipeline.config import PipelineConfig
from shapepose_fg.pipeline.pipeline import reconstruct
from shapepose_fg.simulation import Scene, built_in_scene, simulate
from shapepose_fg.simulation.files import truth_of
from shapepose_fg.simulation.mocap import Mocap
from shapepose_fg.simulation.sequences import SEQUENCES, sequence

HERE = Path(__file__).parent.parent
FIGURES = ("F1", "IDF1", "MPJPE", "in 50 %", "in 95 %", "seconds")
"""Per cent, mm, per cent, and processor time."""


class Case(NamedTuple):
    """A simulated recording of 4 s, split `tune`."""

    scene: str
    """Name of a sequence; "two" is the built-in scene."""
    layout: int
    """Seed of people and cameras, and of the detector's errors."""
    cameras: int
    fps: int = 30


CASES = (
    Case("two", 7101, 2), Case("two", 7102, 3), Case("crowd", 7103, 3), Case("crowd", 7104, 3),
    Case("crowd", 7105, 3), Case("crowd", 7106, 4), Case("crossing", 7107, 3),
    Case("crossing", 7108, 4), Case("salsa", 7109, 4), Case("salsa", 7110, 4, 10),
)  # fmt: skip
"""Simulated recordings; in the last one people move three times as far between frames."""


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("constant", help="module and name, e.g. tracking.track_selection._COST")
    parser.add_argument("values", nargs="+", help="other values, or factors such as x0.5")
    parser.add_argument("--mocap", type=Path, help="file of recorded motions")
    parser.add_argument("--real", nargs=4, action="append", default=[],
                        metavar=("RIG", "DETECTIONS", "TRUTH", "FPS"))  # fmt: skip
    parser.add_argument("--seconds", type=float, default=4.0, help="length of simulated recordings")
    parser.add_argument("--here", action="store_true", help="measure this copy: prints JSON")
    arguments = parser.parse_args()
    if arguments.here:
        return print(json.dumps([*measured(arguments.mocap, arguments.seconds, arguments.real)]))
    options, usual = sys.argv[2 + len(arguments.values) :], np.zeros(0)
    print(f"{'':12}", *(f"{name:>16}" for name in FIGURES))
    for value in ("x1", *arguments.values):
        with tempfile.TemporaryDirectory() as folder:
            copied(Path(folder), arguments.constant, value)
            figures = np.array(_run(Path(folder), [arguments.constant, value, *options]))
        usual = figures if value == "x1" else usual
        print("\n".join(lines(value, figures, usual)), flush=True)


def lines(value: str, figures: NDArray, usual: NDArray) -> Iterator[str]:
    """The lines of the table for the `figures` (R, 6) of recordings; `usual` (R, 6) are those of
    the present value.
    """
    known, difference = np.ma.masked_invalid(figures), np.ma.masked_invalid(figures - usual)
    means = known.mean(axis=0).filled(np.nan)
    yield " ".join([f"{value:12}", *(f"{mean:16.2f}" for mean in means)])
    if not difference[:, :-1].any():
        return
    mean, count = difference.mean(axis=0).filled(np.nan), difference.count(axis=0)
    error = 2 * difference.std(axis=0).filled(np.nan) / np.sqrt(np.maximum(count - 1, 1))
    beyond = (np.abs(mean) > error) & (count > 1)
    cells = [
        f"{m:+.2f} ±{e:.2f}{' *' if b else ''}" for m, e, b in zip(mean, error, beyond, strict=True)
    ]
    yield " ".join([f"{'':12}", *(f"{cell:>16}" for cell in cells)])
    if not beyond[:-1].any():
        yield f"{'':12} nothing differs by more than the spread over recordings"


def copied(folder: Path, constant: str, value: str) -> None:
    """Copy the packages to a folder, with another value of a constant."""
    for name in ("shapepose_fg", "factors"):
        ignored = shutil.ignore_patterns("__pycache__")
        shutil.copytree(HERE / name, folder / name, ignore=ignored)
    module, _, name = constant.rpartition(".")
    path = folder / "shapepose_fg" / f"{module.replace('.', '/')}.py"
    if not path.is_file():
        raise SystemExit(f"{constant}: there is no module shapepose_fg.{module}")
    path.write_text(changed(path.read_text("utf-8"), name, value), "utf-8")


def changed(source: str, name: str, value: str) -> str:
    """The `source` of a module in which the constant `name` has another value: a factor such as
    `x2`, or an expression.
    """
    for present in _values(ast.parse(source), name):
        text = ast.get_source_segment(source, present)
        number = value if value[:1] != "x" else f"({text}) * {value[1:]}"
        number = f'float("{number}")' if number in ("inf", "-inf") else number
        rows = source.encode().splitlines(keepends=True)
        first, last = present.lineno - 1, (present.end_lineno or 0) - 1
        before, after = rows[first][: present.col_offset], rows[last][present.end_col_offset :]
        rows[first : last + 1] = [before + number.encode() + after]
        return b"".join(rows).decode()
    raise SystemExit(f"the module has no constant {name}")


def _values(module: ast.Module, name: str) -> Iterator[ast.expr]:
    """The expressions assigned to a name at module level, also as part of a tuple."""
    for statement in module.body:
        if not isinstance(statement, ast.Assign | ast.AnnAssign) or statement.value is None:
            continue
        single = isinstance(statement, ast.AnnAssign)
        target = statement.target if single else statement.targets[0]
        pairs = [(target, statement.value)]
        if isinstance(target, ast.Tuple) and isinstance(statement.value, ast.Tuple):
            pairs = [*zip(target.elts, statement.value.elts, strict=True)]
        yield from (to for of, to in pairs if isinstance(of, ast.Name) and of.id == name)


def _run(folder: Path, options: list[str]) -> list[list[float]]:
    """The figures of all recordings with the packages in a folder."""
    command = [sys.executable, __file__, *options, "--here"]
    environment = os.environ | {"PYTHONPATH": str(folder), "OMP_NUM_THREADS": "1"}
    found = subprocess.run(command, env=environment, stdout=subprocess.PIPE, check=True)
    return json.loads(found.stdout)


def measured(mocap: Path | None, seconds: float, real: list[list[str]]) -> Iterator[list[float]]:
    """The `FIGURES` of each recording."""
    motions = None if mocap is None else Mocap.load(mocap)
    for case in CASES:
        if motions is not None or case.scene == "two":
            scene = scene_of(case, motions, round(seconds * case.fps))
            config, times = PipelineConfig(), FrameTimes.from_fps(scene.fps, len(scene))
            given = simulate(scene, seed=case.layout), scene.rig, config
            solve = partial(reconstruct, *given, times=times, cuts=scene.cuts)
            yield _figures(solve, people_of(truth_of(scene)))
    for rig, detections, truth, fps in real:
        solve = partial(_real, Path(rig), Path(detections), float(fps))
        yield _figures(solve, read_people(truth))


def scene_of(case: Case, mocap: Mocap | None, frames: int) -> Scene:
    """The people and cameras of a case."""
    if mocap is None or case.scene == "two":
        return built_in_scene(
            case.layout, people=2, cameras=case.cameras, frames=frames, fps=case.fps
        )
    config = replace(SEQUENCES[case.scene], seed=case.layout)
    whole = sequence(
        case.scene, "tune", mocap, cameras=case.cameras, until=frames, fps=case.fps, config=config
    )
    return whole.part(range(frames))


def _real(calibration: Path, folder: Path, fps: float) -> Reconstruction:
    """A recorded sequence, reconstructed."""
    rig, config = read_rig(calibration), replace(PipelineConfig(), temporal=fps > 0)
    detections: DetectionSequence = read_detections(folder, rig)
    times = FrameTimes.from_fps(fps, len(detections)) if fps > 0 else None
    return reconstruct(detections, rig, config, times=times)


def _figures(solve: Callable[[], Reconstruction], truth: PlainPeople) -> list[float]:
    """The `FIGURES` of a recording; NaN where there is nothing to measure."""
    began = time.process_time()
    people = people_of(solve())
    seconds = time.process_time() - began
    found = score(people, truth)
    f1, tracks = float("nan"), found.tracks
    if tracks is not None:
        f1 = 200 * (tracks.true - tracks.misses) / max(tracks.true + tracks.predicted, 1)
    names = ("idf1", "mpjpe_mm", "inside_50", "inside_95")
    return [f1, *(found.figures[name] for name in names), seconds]


if __name__ == "__main__":
    main()
