"""Real footage: Shelf by its annotation, and by cameras that are left out; Pose2Sim's recording of one man."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from pathlib import Path

from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.evaluation.alternation import before_refinement
from shapepose_fg.evaluation.annotated_arms import ANNOTATION, measure_arms, read_annotated_arms
from shapepose_fg.evaluation.baseline.over_time import over_time
from shapepose_fg.evaluation.baseline.people import FoundPeople, find_everybody
from shapepose_fg.evaluation.bodies import body_joints
from shapepose_fg.evaluation.experiments.experiment import Case, Column, Experiment, Figures
from shapepose_fg.evaluation.experiments.scenes import FRAME_BY_FRAME, MODES, OVER_TIME
from shapepose_fg.evaluation.experiments.stretches import Scale
from shapepose_fg.evaluation.footage import SHELF_FPS, Footage, shelf_footage, single_footage
from shapepose_fg.evaluation.held_out_view import held_out
from shapepose_fg.evaluation.matching import People
from shapepose_fg.evaluation.shelf import ACTORS, LIMB_NAMES, ShelfScore, evaluate_shelf, read_shelf_ground_truth
from shapepose_fg.evaluation.single_person import man_of, measure_single_person
from shapepose_fg.evaluation.smplify import smpl_only
from shapepose_fg.pipeline.pipeline import PipelineConfig, reconstruct

QUICK = range(20)
"""Frames of a recording that a quick run takes."""
SHELF_COLUMNS = (
    *(Column(f"actor {actor + 1}", f"actor_{actor + 1}", 2) for actor in ACTORS),
    *(Column("Avg", "average", 2), Column("all limbs", "pooled", 2)),
    *(
        Column("MPJPE, mm", "mpjpe_mm"),
        Column("recall at 0.2 m, %", "recall", 2),
        Column("people found", "found", 0),
    ),
)
LIMB_COLUMNS = tuple(Column(heading, heading, 0) for heading in ("actor 1", "actor 2", "actor 3", "lost"))
ZHANG = {
    "Zhang et al. 2020, with time": (99.47, 99.47, 96.45, 98.46),
    "Zhang et al. 2020, without time": (96.34, 92.11, 96.13, 94.86),
}
"""The strongest other method: what its results on these frames and detections score, actors 1 to 3 and Avg."""
SINGLE_COLUMNS = (
    *(Column("frames with the man", "man_found", 0), Column("of", "frames", 0)),
    Column("limbs over 1.25 times their own median", "torn_limbs", 0),
    Column("forearm, standard deviation over mean, %", "forearm_spread", 2),
    *(
        Column("wrists, mean acceleration, m/s²", "wrist_acceleration"),
        Column("largest", "largest_acceleration", 0),
    ),
    Column("raised wrist under the shoulder, at the most, m", "lowest_wrist_m", 3),
    Column("arms to the nearest detection, median, px", "residual_px", 2),
    Column("bystander found, %", "bystander_found", 0),
    *(
        Column(f"{side} {joint}, median error, mm", f"{side[0].upper()}{joint.capitalize()}_mm", 0)
        for side in ("right", "left")
        for joint in ("elbow", "wrist")
    ),
    Column("further than 20 cm, %", "arms_wrong"),
    *(Column("inside 50 %, %", "arms_inside_50"), Column("inside 95 %, %", "arms_inside_95")),
)
"""The last seven are of elbows and wrists that were annotated by hand."""


def shelf(scale: Scale) -> Experiment:
    """PCP of ours, of steps of it, and of others on the whole recording."""
    rows = dict[str, list[Case]]()
    if scale.shelf is not None and not scale.quick:
        rows = {name: [Case(name, partial(_scores, scale.shelf, name))] for name in _SHELF}
        for name, (*actors, average) in ZHANG.items():
            figures = {f"actor_{n}": value for n, value in enumerate(actors, 1)} | {"average": average}
            rows[name] = [Case(name, partial(dict, figures))]
    return Experiment("shelf", rows, SHELF_COLUMNS)


def shelf_limbs(scale: Scale) -> Experiment:
    """How many of each actor's limbs are right, over time."""
    folder = None if scale.quick else scale.shelf
    rows = {
        name: [Case(name, partial(_limb, folder, n))] for n, name in enumerate(LIMB_NAMES) if folder is not None
    }
    return Experiment("shelf limbs", rows, LIMB_COLUMNS)


def views(scale: Scale) -> Experiment:
    """Shelf solved without each of its cameras: what it saw against the 95 % regions of the rest."""
    rows = {}
    if scale.shelf is not None:
        cameras = shelf_footage(scale.shelf).rig.names
        rows = {name: [Case(name, partial(_view, scale, view))] for view, name in enumerate(cameras)}
    columns = (
        *(Column("inside the 95 % region, %", "inside"), Column("of its candidates", "of", 0)),
        Column("joints that the others do not place", "unmatched", 0),
    )
    return Experiment("views", rows, columns)


def single(scale: Scale) -> Experiment:
    """Pose2Sim's demo recording, whose truth is a few joints that were annotated by hand."""
    there = scale.pose2sim_single is not None
    rows = {name: [Case(name, partial(_single, scale, config))] for name, config in MODES.items() if there}
    return Experiment("single", rows, SINGLE_COLUMNS)


@cache
def _ours(folder: Path, mode: str) -> Reconstruction:
    return shelf_footage(folder).reconstruct(MODES[mode])


@cache
def _baseline(folder: Path) -> FoundPeople:
    recording = shelf_footage(folder)
    return find_everybody(recording.detections, recording.rig)


def _without_graph(folder: Path) -> People:
    """SMPL-only of the people and detections of ours frame by frame."""
    people = _ours(folder, "frame by frame")
    return smpl_only(people, shelf_footage(folder).rig, FRAME_BY_FRAME.observations).people


def _stage_one(folder: Path) -> People:
    recording = shelf_footage(folder)
    return before_refinement(recording.detections, recording.rig, FRAME_BY_FRAME)


def _bodies(folder: Path) -> People:
    """The joints of the bodies in place of those of the graphs."""
    people = _ours(folder, "frame by frame")
    return replace(people, joints=body_joints(people))


_SHELF: dict[str, Callable[[Path], People]] = {
    "**shapepose-fg, with time**": lambda folder: _ours(folder, "over time"),
    "**shapepose-fg, without time**": lambda folder: _ours(folder, "frame by frame"),
    "(ours) stage I alone": _stage_one,
    "(ours) bodies' joints": _bodies,
    "SMPL-only, of the same people and detections": _without_graph,
    "baseline, with time": lambda folder: over_time(_baseline(folder), SHELF_FPS),
    "baseline, without time": _baseline,
}
"""What is measured on Shelf."""


@cache
def _score(folder: Path, name: str) -> ShelfScore:
    return evaluate_shelf(_SHELF[name](folder), read_shelf_ground_truth(folder / "gt_dev.txt"))


def _scores(folder: Path, name: str) -> Figures:
    score = _score(folder, name)
    actors = {f"actor_{actor + 1}": float(score.pcp[actor]) for actor in ACTORS}
    return actors | {
        "average": score.pcp_average,
        "pooled": score.pcp_pooled,
        "mpjpe_mm": score.mpjpe_mm,
        "recall": 100 * score.recall,
        "found": score.people_found,
    }


def _limb(folder: Path, limb: int) -> Figures:
    score = _score(folder, next(iter(_SHELF)))
    right, count = score.limbs_right[:, limb], score.limbs_all[:, limb]
    words = {f"actor {actor + 1}": f"{right[actor]} of {count[actor]}" for actor in ACTORS}
    return words | {"lost": int(count.sum() - right.sum())}


def _view(scale: Scale, view: int) -> Figures:
    assert scale.shelf is not None
    recording, people = shelf_footage(scale.shelf), _whole(scale)
    solve = partial(reconstruct, frames=_frames(scale, recording), times=recording.times)
    found = held_out(recording.detections, recording.rig, view, people, solve, OVER_TIME.observations)
    return {"inside": 100 * found.inside, "of": len(found.squared), "unmatched": found.unmatched}


@cache
def _whole(scale: Scale) -> Reconstruction:
    assert scale.shelf is not None
    recording = shelf_footage(scale.shelf)
    return recording.reconstruct(frames=_frames(scale, recording))


def _single(scale: Scale, config: PipelineConfig) -> Figures:
    assert scale.pose2sim_single is not None
    recording = single_footage(scale.pose2sim_single)
    frames = _frames(scale, recording)
    people = recording.reconstruct(config, frames)
    figures = measure_single_person(people, recording.detections, recording.rig)
    if not ANNOTATION.is_file():  # it is not installed
        return figures
    arms = read_annotated_arms(ANNOTATION, recording.rig).only(frames)
    return figures | measure_arms(people.rows(man_of(people, recording.rig)), arms).as_dict()


def _frames(scale: Scale, footage: Footage) -> range:
    return range(len(footage.detections))[: len(QUICK) if scale.quick else None]
