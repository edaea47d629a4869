"""The paper's comparison: what each method makes of the same detections of people in close contact."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.evaluation.alternation import before_refinement
from shapepose_fg.evaluation.baseline.over_time import over_time
from shapepose_fg.evaluation.baseline.people import FoundPeople, find_everybody
from shapepose_fg.evaluation.experiments.experiment import Case, Column, Experiment, Figures
from shapepose_fg.evaluation.experiments.scenes import FRAME_BY_FRAME, OVER_TIME
from shapepose_fg.evaluation.experiments.stretches import Scale, Stretch, shorter
from shapepose_fg.evaluation.matching import People
from shapepose_fg.evaluation.metrics import joint_metrics
from shapepose_fg.evaluation.smplify import SmplOnly, smpl_only
from shapepose_fg.pipeline.pipeline import PipelineConfig

Found = TypeVar("Found", bound=People)
FRAMES = 100
"""Of each stretch."""
THRESHOLDS_M = (0.2, 0.1, 0.05)
"""A joint is correct if it is at most so far from the true one."""
COLUMNS = (
    *(
        Column(f"{heading} at {limit:g} m", f"{figure}_{limit:g}")
        for limit in THRESHOLDS_M
        for heading, figure in (("P", "precision"), ("R", "recall"), ("F1", "f1"))
    ),
    *(Column("MPJPE, mm", "mpjpe_mm"), Column("least F1", "f1_0.2", 1, "least")),
    *(Column(f"{heading} of mid-hips", f"{name}_hip") for heading, name in (("P", "precision"), ("R", "recall"))),
    *(Column("missed", "missed", 0), Column("false positives", "false_positives", 0)),
    *(Column("ms a frame", "cpu_ms", 0), Column("body fit or stage II, ms a person", "fit_ms")),
)


@dataclass(frozen=True)
class PlainPeople:
    """Joints and nothing else; implements `People`."""

    frame: NDArray[np.integer]
    """(N,) frame of each row."""
    joints: NDArray[np.floating]
    """(N, J, 3) metres; NaN where unknown."""


def interactions(scale: Scale) -> Experiment:
    """All methods on all stretches."""
    rows = {
        label: [Case(f"{label} {each.label}", partial(make, shorter(each, FRAMES))) for each in scale.stretches]
        for label, make in METHODS.items()
    }
    return Experiment("interactions", rows, COLUMNS)


def scored(people: People, truth: NDArray[np.float64]) -> Figures:
    """Precision, recall and F1 at each threshold, per cent, and MPJPE; `truth` (T, P, J, 3), metres.

    `_hip` is of the mid-hip alone at 0.2 m, with people matched by it: the paper's measure of human proposals.
    """
    found = {f"{limit:g}": joint_metrics(people, truth, correct_m=limit) for limit in THRESHOLDS_M}
    first, hip = found["0.2"], [BODY_25.index("MidHip")]
    found["hip"] = joint_metrics(PlainPeople(people.frame, np.asarray(people.joints)[:, hip]), truth[:, :, hip])
    shares = {
        f"{name}_{limit}": 100 * getattr(each, name)
        for limit, each in found.items()
        for name in ("precision", "recall", "f1")
    }
    figures = shares | {"mpjpe_mm": first.mpjpe_mm}
    return {name: value if np.isfinite(value) else None for name, value in figures.items()} | {
        "missed": first.people_missed,
        "false_positives": first.false_positives,
    }


def _timed(stretch: Stretch, make: Callable[[], Found]) -> tuple[Found, float]:
    """What is made, and the processor's milliseconds a frame."""
    _ = stretch.detections
    began = time.process_time()
    made = make()
    return made, 1e3 * (time.process_time() - began) / len(stretch.span)


def _baseline(stretch: Stretch, timed: bool) -> Figures:
    people, cpu_ms = _timed_baseline(stretch)
    followed = over_time(people, stretch.scene.fps) if timed else people
    return scored(followed, stretch.scene.keypoints) | {"cpu_ms": cpu_ms}


@lru_cache(maxsize=8)
def _timed_baseline(stretch: Stretch) -> tuple[FoundPeople, float]:
    return _timed(stretch, lambda: find_everybody(stretch.detections, stretch.scene.rig))


def _proposals(stretch: Stretch, config: PipelineConfig) -> Figures:
    """Stage I of every frame, triangulated."""
    scene = stretch.scene
    before, cpu_ms = _timed(stretch, lambda: before_refinement(stretch.detections, scene.rig, config))
    return scored(before, scene.keypoints) | {"cpu_ms": cpu_ms}


def _method(stretch: Stretch, config: PipelineConfig) -> Figures:
    people, cpu_ms = _timed(stretch, lambda: stretch.reconstruct(config))
    return scored(people, stretch.scene.keypoints) | {"cpu_ms": cpu_ms}


@lru_cache(maxsize=8)
def _alone(stretch: Stretch) -> tuple[Reconstruction, float, SmplOnly]:
    """Ours frame by frame with its time, and SMPL-only on the same people and detections."""
    people, cpu_ms = _timed(stretch, lambda: stretch.reconstruct(FRAME_BY_FRAME))
    return people, cpu_ms, smpl_only(people, stretch.scene.rig, FRAME_BY_FRAME.observations)


def _triangulated(stretch: Stretch) -> Figures:
    people, _, same = _alone(stretch)
    return scored(PlainPeople(people.frame, same.triangulated), stretch.scene.keypoints)


def _smpl_only(stretch: Stretch) -> Figures:
    people, _, same = _alone(stretch)
    fit_ms = 1e3 * same.cpu_s / max(len(people), 1)
    return scored(same.people, stretch.scene.keypoints) | {"fit_ms": fit_ms}


def _ours_alone(stretch: Stretch) -> Figures:
    people, cpu_ms, _ = _alone(stretch)
    fit_ms = 1e3 * people.run["seconds"]["solve"] / max(len(people), 1)
    return scored(people, stretch.scene.keypoints) | {"cpu_ms": cpu_ms, "fit_ms": fit_ms}


METHODS: dict[str, Callable[[Stretch], Figures]] = {
    "baseline, frame by frame (Dong et al. 2019: 71.0 / 80.2 / 75.3)": partial(_baseline, timed=False),
    "baseline, over time": partial(_baseline, timed=True),
    "paper's settings (90.1 / 89.0 / 89.2)": partial(_method, config=PipelineConfig.paper()),
    "initial proposals, paper's settings (83.7 / 82.8 / 83.4)": partial(_proposals, config=PipelineConfig.paper()),
    "initial proposals": partial(_proposals, config=FRAME_BY_FRAME),
    "ours, triangulated before stage II": _triangulated,
    "SMPL-only, of the same people and detections (78.3 / 77.4 / 77.8)": _smpl_only,
    "**ours, frame by frame**": _ours_alone,
    "**ours, over time**": partial(_method, config=OVER_TIME),
}
"""The methods, and precision, recall and F1 at 0.2 m that the paper has for them on its own recording."""
