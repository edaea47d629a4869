"""The paper's comparison: what each method makes of the same detections of people in close contact."""

import time
from collections.abc import Callable
from functools import lru_cache, partial

import numpy as np

from shapepose_fg.core.arrays import Array, Real
from shapepose_fg.core.camera import Rig, Views
from shapepose_fg.core.detections import DetectionSequence
from shapepose_fg.core.observations import Observations
from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.estimation.linearisation import triangulate
from shapepose_fg.evaluation.experiments.experiment import Case, Experiment, Figures, columns
from shapepose_fg.evaluation.experiments.scenes import FRAME_BY_FRAME, OVER_TIME, Scale, Segment
from shapepose_fg.evaluation.metrics import People, PlainPeople, joint_metrics
from shapepose_fg.evaluation.smplify import SmplOnly, smpl_only
from shapepose_fg.pipeline.pipeline import PipelineConfig, find_people

FRAMES = 100
"""Of each segment."""
THRESHOLDS_M = (0.2, 0.1, 0.05)
"""A joint is correct if it is at most so far from the true one."""
_SHARES = {"P": "precision", "R": "recall", "F1": "f1"}
COLUMNS = columns(
    *(
        (f"{words} at {limit:g} m", f"{name}_{limit:g}")
        for limit in THRESHOLDS_M
        for words, name in _SHARES.items()
    ),
    *(("MPJPE, mm", "mpjpe_mm"), ("least F1", "f1_0.2", 1, "least"), ("P of mid-hips", "precision_hip")),
    *(("R of mid-hips", "recall_hip"), ("missed", "missed", 0), ("FP", "false_positives", 0)),
    *(("ms a frame", "cpu_ms", 0), ("body fit or stage II, ms a person", "fit_ms")),
)


def interactions(scale: Scale) -> Experiment:
    """All methods on all segments."""
    rows = {
        label: [
            Case(f"{label} {each.label}", partial(_measure, each.shorter(FRAMES), make)) for each in scale.segments
        ]
        for label, make in METHODS.items()
    }
    return Experiment("interactions", rows, COLUMNS)


def initial_proposals(detections: DetectionSequence, rig: Rig, config: PipelineConfig) -> PlainPeople:
    """What stage I by itself makes of every frame: X_0 of Algorithm 1; NaN where no two views agree."""
    found = [find_people(detections[t], rig, detections.skeleton, config) for t in range(len(detections))]
    frame = np.repeat(np.arange(len(found)), [len(people) for people in found])
    return PlainPeople(frame, triangulate(Observations.concatenate(found), Views.of(rig), config.observations))


def _measure(segment: Segment, make: Callable[[Segment], tuple[People, Figures]]) -> Figures:
    """A method's people scored, its time beside them."""
    _ = segment.detections
    began = time.process_time()
    people, more = make(segment)
    cpu_ms = 1e3 * (time.process_time() - began) / len(segment.span)
    return scored(people, segment.scene.keypoints) | {"cpu_ms": cpu_ms} | more


def scored(people: People, truth: Array) -> Figures:
    """Precision, recall and F1 at each threshold, per cent, and MPJPE; `truth` (T, P, J, 3), metres.

    `_hip` is of the mid-hip alone at 0.2 m, with people matched by it: the paper's measure of human proposals.
    """
    found = {f"{limit:g}": joint_metrics(people, truth, correct_m=limit) for limit in THRESHOLDS_M}
    first, hip = found["0.2"], [BODY_25.index("MidHip")]
    found["hip"] = joint_metrics(_with_joints(people, people.joints[:, hip]), truth[:, :, hip])
    figures = {
        f"{name}_{at}": 100 * getattr(each, name) for at, each in found.items() for name in _SHARES.values()
    }
    figures["mpjpe_mm"] = first.mpjpe_mm
    counts = {"missed": first.people_missed, "false_positives": first.false_positives}
    return {name: value if np.isfinite(value) else None for name, value in figures.items()} | counts


def _with_joints(people: People, joints: Real) -> PlainPeople:
    return PlainPeople(people.frame.astype(np.int64), joints.astype(np.float64))


def _proposals(segment: Segment, config: PipelineConfig) -> tuple[People, Figures]:
    return initial_proposals(segment.detections, segment.scene.rig, config), {}


def _method(segment: Segment, config: PipelineConfig) -> tuple[People, Figures]:
    return segment.reconstruct(config), {}


@lru_cache(maxsize=8)
def _frame_by_frame(segment: Segment) -> tuple[Reconstruction, float, SmplOnly]:
    """Ours frame by frame, its milliseconds a frame, and SMPL-only on the same people and detections."""
    began = time.process_time()
    people = segment.reconstruct(FRAME_BY_FRAME)
    cpu_ms = 1e3 * (time.process_time() - began) / len(segment.span)
    return people, cpu_ms, smpl_only(people, segment.scene.rig, FRAME_BY_FRAME.observations)


def _triangulated(segment: Segment) -> tuple[People, Figures]:
    people, _, same = _frame_by_frame(segment)
    return _with_joints(people, same.triangulated), {"cpu_ms": None}


def _smpl_only(segment: Segment) -> tuple[People, Figures]:
    people, _, same = _frame_by_frame(segment)
    return same.people, {"cpu_ms": None, "fit_ms": 1e3 * same.cpu_s / max(len(people), 1)}


def _ours(segment: Segment) -> tuple[People, Figures]:
    people, cpu_ms, _ = _frame_by_frame(segment)
    return people, {"cpu_ms": cpu_ms, "fit_ms": 1e3 * people.run["seconds"]["solve"] / max(len(people), 1)}


METHODS: dict[str, Callable[[Segment], tuple[People, Figures]]] = {
    "paper's settings (90.1 / 89.0 / 89.2)": partial(_method, config=PipelineConfig.paper()),
    "initial proposals, paper's settings (83.7 / 82.8 / 83.4)": partial(_proposals, config=PipelineConfig.paper()),
    "initial proposals": partial(_proposals, config=FRAME_BY_FRAME),
    "ours, triangulated before stage II": _triangulated,
    "SMPL-only, of the same people and detections (78.3 / 77.4 / 77.8)": _smpl_only,
    "**ours, frame by frame**": _ours,
    "**ours, over time**": partial(_method, config=OVER_TIME),
}
"""The methods, and precision, recall and F1 at 0.2 m that the paper has for them on its own recording."""
