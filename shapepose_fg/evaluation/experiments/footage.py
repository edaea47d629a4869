"""Experiments on real footage: Shelf, scored by its annotation and by held-out cameras."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from pathlib import Path

from shapepose_fg.core.camera import Rig
from shapepose_fg.core.frame_times import FrameTimes
from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.evaluation.experiments.experiment import Case, Experiment, Figures, columns
from shapepose_fg.evaluation.experiments.scenes import MODES, OVER_TIME, Scale
from shapepose_fg.evaluation.held_out_view import held_out
from shapepose_fg.evaluation.score import score
from shapepose_fg.evaluation.shelf import ACTORS
from shapepose_fg.evaluation.shelf_annotation import read_shelf_ground_truth
from shapepose_fg.evaluation.tracking import body_joints
from shapepose_fg.evaluation.truth import people_of
from shapepose_fg.io.calibration import read_rig
from shapepose_fg.io.detection_table import DetectionTable
from shapepose_fg.io.detections import read_detections
from shapepose_fg.pipeline.pipeline import PipelineConfig, reconstruct

QUICK = range(20)
"""Frames of a recording in a quick run."""
SHELF_FPS = 25.0
SHELF_COLUMNS = columns(
    *((f"actor {actor + 1}", f"actor_{actor + 1}", 2) for actor in ACTORS), ("Avg", "average", 2),
    ("MPJPE, mm", "mpjpe_mm"), ("recall at 0.2 m, %", "recall", 2), ("people found", "found", 0),
)  # fmt: skip
ZHANG = {
    "Zhang et al. 2020, with time": (99.47, 99.47, 96.45, 98.46),
    "Zhang et al. 2020, without time": (96.34, 92.11, 96.13, 94.86),
}
"""The best other method: scores of its published results on these frames and detections, actors 1
to 3 and average."""


def shelf_footage(folder: Path) -> tuple[Rig, DetectionTable]:
    """Shelf from its folder in the repository of Zhang et al. 2020. InputError for other
    folders.
    """
    rig = read_rig(folder / "calibration.json")
    return rig, read_detections(folder, rig)


def _reconstructed(
    folder: Path, config: PipelineConfig | None = None, frames: range | None = None
) -> Reconstruction:
    """Reconstruction of Shelf, in all frames or only in `frames`."""
    rig, detections = shelf_footage(folder)
    times = FrameTimes.from_fps(SHELF_FPS, len(detections))
    return reconstruct(detections, rig, config, frames=frames, times=times)


def shelf(scale: Scale) -> Experiment:
    """PCP on the whole recording: our method, its intermediate steps, and other methods."""
    rows = dict[str, list[Case]]()
    if (folder := scale.recording("shelf")) is not None and not scale.quick:
        rows = {name: [Case(name, partial(_scores, folder, name))] for name in _SHELF}
        for name, (*actors, average) in ZHANG.items():
            figures = {f"actor_{n}": value for n, value in enumerate(actors, 1)} | {
                "average": average
            }
            rows[name] = [Case(name, partial(dict, figures))]
    return Experiment("shelf", rows, SHELF_COLUMNS)


def views(scale: Scale) -> Experiment:
    """Shelf solved without each of its cameras in turn. The detections of the held-out camera are
    compared with the 95 % regions of the others.
    """
    rows = {}
    if (folder := scale.recording("shelf")) is not None:
        names = shelf_footage(folder)[0].names
        rows = {
            name: [Case(name, partial(_view, folder, scale.quick, n))]
            for n, name in enumerate(names)
        }
    headings = (("inside the 95 % region, %", "inside"), ("of its candidates", "of", 0))
    return Experiment(
        "views", rows, columns(*headings, ("joints that the others do not place", "unmatched", 0))
    )


@cache
def _ours(folder: Path, mode: str) -> Reconstruction:
    return _reconstructed(folder, MODES[mode])


def _bodies(folder: Path) -> Reconstruction:
    """The result with the joints of the fitted bodies instead of those of the graphs."""
    people = _ours(folder, "frame by frame")
    return replace(people, joints=body_joints(people))


_SHELF: dict[str, Callable[[Path], Reconstruction]] = {
    "**shapepose-fg, with time**": partial(_ours, mode="over time"),
    "**shapepose-fg, without time**": partial(_ours, mode="frame by frame"),
    "(ours) bodies' joints": _bodies,
}
"""Measurements on Shelf."""


def _scores(folder: Path, name: str) -> Figures:
    made = score(people_of(_SHELF[name](folder)), read_shelf_ground_truth(folder / "gt_dev.txt"))
    actors = {f"actor_{actor + 1}": value for actor, value in made.people.items()}
    kept = {name: made.figures[name] for name in ("mpjpe_mm", "recall")}
    return actors | kept | {"average": made.figures["pcp"], "found": made.found}


def _view(folder: Path, quick: bool, view: int) -> Figures:
    (rig, detections), people = shelf_footage(folder), _whole(folder, quick)
    times = FrameTimes.from_fps(SHELF_FPS, len(detections))
    solve = partial(reconstruct, frames=QUICK if quick else None, times=times)
    found = held_out(detections, rig, view, people, solve, OVER_TIME.observations)
    return {"inside": 100 * found.inside, "of": len(found.squared), "unmatched": found.unmatched}


@cache
def _whole(folder: Path, quick: bool) -> Reconstruction:
    return _reconstructed(folder, frames=QUICK if quick else None)
