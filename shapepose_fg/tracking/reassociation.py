"""Reassociation of detections with people, given estimates of their joints."""

from collections.abc import Sequence

import numpy as np

from shapepose_fg.body.fitting.priors import longest_bones
from shapepose_fg.core.arrays import Array, Index, Mask
from shapepose_fg.core.detections import Input
from shapepose_fg.core.observations import Observations
from shapepose_fg.core.skeleton import Skeleton
from shapepose_fg.proposal.nearby import FrameArrays
from shapepose_fg.proposal.pairs_of_people import SAME_M
from shapepose_fg.proposal.possible_people import Frame, PossiblePeople, gaps
from shapepose_fg.proposal.selection import PRIOR_WITH_BODY, existence
from shapepose_fg.tracking.identities import core_distance
from shapepose_fg.tracking.view_assignment import Predicted, assign_with_probability

LEAST_PROBABILITY = 0.6
"""Minimum existence probability of a person in an isolated frame. Of people with probability 0.6,
six in ten are real, in simulated crowds and in a real operating room alike."""


def reassociate(
    given: Sequence[Input],
    rows: Observations,
    joints: Array,
    covariance: Array,
    skeleton: Skeleton,
    least: float | None = None,
) -> Observations:
    """Assign detections again around `joints` (N, J, 3) with covariance (N, J, 3, 3); returns the
    rows with these.

    All views and people of a frame are assigned together, one-to-one. Rows without any joint stay,
    without detections: the motion model bridges them. If `least` is given, frames are isolated, and
    people are removed who have no joints, are less probable than `least`, or are duplicates. Rows
    are sorted by frame.
    """
    sigma_m = np.sqrt(np.trace(covariance, axis1=-2, axis2=-1) / 3)
    parts = []
    for frame in given:
        index = np.flatnonzero(rows.frame == frame.frame)
        if least is not None:
            index = index[np.isfinite(sigma_m[index]).any(axis=1)]
        candidate, probability = _reassigned(frame, joints[index], sigma_m[index], skeleton)
        evidence = rows.evidence[index]
        while least is not None and len(index) > 0:
            evidence = probabilities_of(frame, candidate, joints[index], skeleton)
            removed = people_to_remove(evidence, joints[index], skeleton, least)
            if not removed.any():
                break
            index, evidence = index[~removed], evidence[~removed]
            candidate, probability = _reassigned(frame, joints[index], sigma_m[index], skeleton)
        columns = {name: getattr(rows, name)[index] for name in ("track", "frame", "time_s")}
        existence = {"probability": probability, "evidence": evidence}
        parts.append(
            Observations.of(candidate, frame.detections, joints[index], **columns, **existence)
        )
    return Observations.concatenate(parts)


def changed(before: Observations, now: Observations) -> Mask:
    """(N, J, V) mask of detections that differ between the same rows `before` and `now`, where
    either has one.
    """
    return np.asarray((before.candidate != now.candidate) & (before.seen | now.seen))


def _reassigned(
    frame: Input, joints: Array, sigma_m: Array, skeleton: Skeleton
) -> tuple[Index, Array]:
    """(P, J, V) detections assigned to the people of one frame, and their probabilities."""
    predicted = Predicted(joints, sigma_m, lost=~np.isfinite(sigma_m))
    return assign_with_probability(predicted, FrameArrays.of(frame.detections, frame.rig, skeleton))


def probabilities_of(frame: Input, candidate: Index, joints: Array, skeleton: Skeleton) -> Array:
    """(P,) existence probability of each person of a frame."""
    of_frame = Frame(frame.detections, frame.rig, skeleton, longest_bones(skeleton))
    return existence(
        PossiblePeople(joints, candidate, gaps(joints, candidate, of_frame)),
        of_frame,
        PRIOR_WITH_BODY,
    )


def people_to_remove(
    probability: Array, joints: Array, skeleton: Skeleton, least: float, double_m: float = SAME_M
) -> Mask:
    """(P,) whether to remove: the least probable person below `least`, and the less probable of
    duplicates.
    """
    doubles = ((core_distance(joints, joints, skeleton) < double_m) & _smaller(probability)).any(
        axis=1
    )
    # Detections that one person releases may help another.
    return doubles | ((probability < least) & (probability == probability.min()))


def _smaller(value: Array) -> Mask:
    """(P, P) whether one has a smaller `value` (P,) than another; on a tie, the later one has."""
    return (value[:, None] < value) | (
        (value[:, None] == value) & np.tri(len(value), k=-1, dtype=bool)
    )
