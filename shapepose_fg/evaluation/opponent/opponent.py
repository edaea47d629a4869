"""People in 3D without a body: every frame by itself, or over time."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.camera import Rig
from shapepose_fg.core.detections import Detections, DetectionSequence
from shapepose_fg.core.skeleton import BODY_25, Skeleton
from shapepose_fg.evaluation.opponent.cross_view import consistent_matches, geometric_affinity, people_of
from shapepose_fg.evaluation.opponent.giving_out import grown, nearest_given
from shapepose_fg.evaluation.opponent.people_2d import people_in_views, sure_enough
from shapepose_fg.evaluation.opponent.triangulation import triangulate_robustly

Array = NDArray[np.float64]


@dataclass(frozen=True)
class OpponentConfig:
    """Settings, chosen on the split `tune`: see docs/evaluation.md."""

    min_confidence: float = 0.1
    """Candidates less sure are left out."""
    min_affinity: float = 0.05
    """Pairs of candidates of less affinity join nobody in a picture."""
    min_joints_2d: int = 5
    """A group of fewer joints is nobody in a picture."""
    largest_m: float = 0.08
    """Two whose rays miss each other by so much in the mean are not one person."""
    rank_weight: float = 2.0
    """How much matches that agree over all views are preferred."""
    least_match: float = 0.3
    """Less of a match is none."""
    gate_m: float = 0.1
    """A view agrees with a joint within this distance at its depth."""
    min_views: int = 2
    """A joint on which fewer views agree is missing."""
    rounds: int = 2
    """How often candidates are given out again, to the nearest projected joint."""
    min_joints: int = 8
    """A person with fewer of the core joints is nobody."""
    double_m: float = 0.25
    """Of two people so near to each other, in the mean over joints, the one with fewer agreeing views goes."""


@dataclass(frozen=True)
class FoundPeople:
    """N rows, one per person and frame; what `evaluation` scores."""

    frame: NDArray[np.int64]
    """(N,) frame."""
    person: NDArray[np.int64]
    """(N,) identity; the number within the frame where there is no time."""
    joints: Array
    """(N, J, 3) metres; NaN where missing."""
    views: NDArray[np.intp]
    """(N, J) views that agree on each joint."""
    joint_names: tuple[str, ...] = BODY_25.joints
    """(J,) names."""

    def __len__(self) -> int:
        return len(self.frame)


def find_everybody(detections: DetectionSequence, rig: Rig, config: OpponentConfig | None = None) -> FoundPeople:
    """Every frame by itself."""
    config = OpponentConfig() if config is None else config
    frames, persons, joints, views = [], [], [], []
    for frame in range(len(detections)):
        placed, agree = people_in_frame(detections[frame], rig, detections.skeleton, config)
        frames.append(np.full(len(placed), frame))
        persons.append(np.arange(len(placed)))
        joints.append(placed)
        views.append(agree.sum(axis=-1))
    frame, person, xyz, seen = (np.concatenate(each) for each in (frames, persons, joints, views))
    return FoundPeople(frame, person, xyz, seen, detections.skeleton.joints)


def people_in_frame(
    found: Detections, rig: Rig, skeleton: Skeleton, config: OpponentConfig
) -> tuple[Array, NDArray[np.bool_]]:
    """Joints (P, J, 3) of the people of one frame, and which views agree on each (P, J, V)."""
    sure = sure_enough(found, config.min_confidence, config.min_affinity)
    people = people_in_views(sure, len(skeleton), config.min_joints_2d)
    J, V = len(skeleton), len(rig)
    if len(people) < 2:
        return np.zeros((0, J, 3)), np.zeros((0, J, V), dtype=bool)
    affinity = geometric_affinity(people, rig, config.largest_m)
    matches = consistent_matches(affinity, people.view, rank_weight=config.rank_weight)
    groups = people_of(matches, people.view, config.least_match)
    held = np.full((len(groups), J, V), -1, dtype=np.intp)
    for person, members in enumerate(groups):
        held[person][:, people.view[members]] = people.held[members].T
    joints, agree = _placed(sure, held, rig, config)
    for _ in range(config.rounds):
        held = nearest_given(sure, joints, held, rig, config.gate_m)
        joints, agree = _placed(sure, grown(sure, joints, held), rig, config)
    core = np.isfinite(joints[:, skeleton.core]).all(axis=-1).sum(axis=-1)
    kept = np.flatnonzero(core >= min(config.min_joints, len(skeleton.core)))
    kept = kept[_not_doubles(joints[kept], agree[kept], config.double_m)]
    return joints[kept], agree[kept]


def _placed(
    found: Detections, held: NDArray[np.intp], rig: Rig, config: OpponentConfig
) -> tuple[Array, NDArray[np.bool_]]:
    """Joints (P, J, 3) of what people hold (P, J, V), and which views agree (P, J, V)."""
    confidence = np.where(held >= 0, found.confidence[held], 0.0)
    xy = np.where((held >= 0)[..., None], found.xy[held], 0.0)
    return triangulate_robustly(xy, confidence, rig, config.gate_m, config.min_views)


def _not_doubles(joints: Array, agree: NDArray[np.bool_], double_m: float) -> NDArray[np.intp]:
    """The people who are nobody else, with more agreeing views, once more."""
    order, kept = np.argsort(-agree.sum(axis=(1, 2)), kind="stable"), list[int]()
    for one in order.tolist():
        both = [np.isfinite(joints[one] - joints[other]).all(axis=-1) for other in kept]
        near = [
            each.any() and np.linalg.norm(joints[one] - joints[other], axis=-1)[each].mean() < double_m
            for each, other in zip(both, kept, strict=True)
        ]
        if not any(near):
            kept.append(one)
    return np.array(sorted(kept), dtype=np.intp)
