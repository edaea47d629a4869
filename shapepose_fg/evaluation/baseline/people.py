"""People in 3D without a body, frame by frame: grouped in each picture, matched between views, triangulated."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.camera import Rig
from shapepose_fg.core.detections import Detections, DetectionSequence
from shapepose_fg.core.skeleton import BODY_25, Skeleton
from shapepose_fg.evaluation.baseline.cross_view import consistent_matches, geometric_affinity, people_of
from shapepose_fg.evaluation.baseline.people_2d import people_in_views, sure_enough
from shapepose_fg.evaluation.baseline.reassociation import grown, nearest_given
from shapepose_fg.evaluation.baseline.triangulation import triangulate_robustly

Array = NDArray[np.float64]

# Chosen on the split `tune`: see docs/evaluation.md.
MIN_CONFIDENCE, MIN_AFFINITY, MIN_JOINTS_2D = 0.1, 0.05, 5
"""Candidates less sure, pairs of less affinity and groups of fewer joints are left out of a picture."""
LARGEST_M = 0.08
"""Two whose rays miss each other by so much in the mean are not one person."""
RANK_WEIGHT, LEAST_MATCH = 2.0, 0.3
"""How much matches that agree over all views are preferred; less of a match is none."""
GATE_M, MIN_VIEWS = 0.1, 2
"""A view agrees with a joint within this distance at its depth; a joint on which fewer views agree is missing."""
ROUNDS = 2
"""How often candidates are associated again, with the nearest projected joint."""
MIN_JOINTS = 8
"""A person with fewer of the core joints is a false positive."""
DUPLICATE_M = 0.25
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
    joint_names: tuple[str, ...] = BODY_25.joints
    """(J,) names."""

    def __len__(self) -> int:
        return len(self.frame)


def find_everybody(detections: DetectionSequence, rig: Rig) -> FoundPeople:
    """Every frame by itself."""
    placed = [people_in_frame(detections[t], rig, detections.skeleton)[0] for t in range(len(detections))]
    count = [len(each) for each in placed]
    person = np.concatenate([np.arange(each) for each in count])
    frame = np.repeat(np.arange(len(placed)), count)
    return FoundPeople(frame, person, np.concatenate(placed), detections.skeleton.joints)


def people_in_frame(found: Detections, rig: Rig, skeleton: Skeleton) -> tuple[Array, NDArray[np.bool_]]:
    """Joints (P, J, 3) of the people of one frame, and which views agree on each (P, J, V)."""
    sure = sure_enough(found, MIN_CONFIDENCE, MIN_AFFINITY)
    people = people_in_views(sure, len(skeleton), MIN_JOINTS_2D)
    J, V = len(skeleton), len(rig)
    if len(people) < 2:
        return np.zeros((0, J, 3)), np.zeros((0, J, V), dtype=bool)
    matches = consistent_matches(geometric_affinity(people, rig, LARGEST_M), people.view, rank_weight=RANK_WEIGHT)
    groups = people_of(matches, people.view, LEAST_MATCH)
    held = np.full((len(groups), J, V), -1, dtype=np.intp)
    for person, members in enumerate(groups):
        held[person][:, people.view[members]] = people.held[members].T
    joints, agree = _placed(sure, held, rig)
    for _ in range(ROUNDS):
        held = nearest_given(sure, joints, held, rig, GATE_M)
        joints, agree = _placed(sure, grown(sure, joints, held), rig)
    core = np.isfinite(joints[:, skeleton.core]).all(axis=-1).sum(axis=-1)
    kept = np.flatnonzero(core >= min(MIN_JOINTS, len(skeleton.core)))
    kept = kept[_without_duplicates(joints[kept], agree[kept])]
    return joints[kept], agree[kept]


def _placed(found: Detections, held: NDArray[np.intp], rig: Rig) -> tuple[Array, NDArray[np.bool_]]:
    """Joints (P, J, 3) of what people hold (P, J, V), and which views agree (P, J, V)."""
    confidence = np.where(held >= 0, found.confidence[held], 0.0)
    xy = np.where((held >= 0)[..., None], found.xy[held], 0.0)
    return triangulate_robustly(xy, confidence, rig, GATE_M, MIN_VIEWS)


def _without_duplicates(joints: Array, agree: NDArray[np.bool_]) -> NDArray[np.intp]:
    """The people who are not somebody else, with more agreeing views, once more."""
    kept = list[int]()
    for one in np.argsort(-agree.sum(axis=(1, 2)), kind="stable").tolist():
        distance = np.linalg.norm(joints[kept] - joints[one], axis=-1)
        both = np.isfinite(distance)
        mean = np.where(both, distance, 0.0).sum(axis=1) / np.maximum(both.sum(axis=1), 1)
        if not (both.any(axis=1) & (mean < DUPLICATE_M)).any():
            kept.append(one)
    return np.array(sorted(kept), dtype=np.intp)
