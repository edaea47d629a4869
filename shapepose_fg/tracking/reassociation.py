"""Detections are reassociated, once it is known where people's joints are."""

from collections.abc import Sequence

import numpy as np

from shapepose_fg.body.fitting.priors import longest_bones
from shapepose_fg.core.arrays import Array, Index, Mask
from shapepose_fg.core.detections import Input
from shapepose_fg.core.observations import Observations
from shapepose_fg.core.skeleton import Skeleton
from shapepose_fg.proposal.assignment import lesser
from shapepose_fg.proposal.nearby import Sight
from shapepose_fg.proposal.possible_people import Frame, PossiblePeople, gaps
from shapepose_fg.proposal.selection import PRIOR_WITH_BODY, existence
from shapepose_fg.tracking.following import core_distance
from shapepose_fg.tracking.view_assignment import Predicted, assign_with_probability

LEAST_PROBABILITY = 0.6
"""How probable it must be that somebody is there in a frame that stands alone: of those who have 0.6, six in ten
are, in simulated crowds and in a real operating room alike."""
_DOUBLE_M = 0.2
"""Mean distance of core joints below which two people are one, metres: a pelvis is 20 cm deep."""


def reassociate(
    given: Sequence[Input],
    rows: Observations,
    joints: Array,
    covariance: Array,
    skeleton: Skeleton,
    least: float | None = None,
) -> Observations:
    """Return the rows with the detections around their `joints` (N, J, 3), known to `covariance` (N, J, 3, 3).

    All views and people of a frame at once, one-to-one. Rows without any joint keep their place, without
    detections: motion carries them. Where frames stand alone people may go: those who have no joints, who are
    less probable than the `least` that is asked for, and doubles. Rows come back sorted by frame.
    """
    sigma_m = np.sqrt(np.trace(covariance, axis1=-2, axis2=-1) / 3)
    parts = []
    for frame in given:
        index = np.flatnonzero(rows.frame == frame.frame)
        if least is not None:
            index = index[np.isfinite(sigma_m[index]).any(axis=1)]
        candidate, probability = _given_out(frame, joints[index], sigma_m[index], skeleton)
        evidence = rows.evidence[index]
        while least is not None and len(index) > 0:
            evidence = probabilities_of(frame, candidate, joints[index], skeleton)
            gone = who_goes(evidence, joints[index], skeleton, least)
            if not gone.any():
                break
            index, evidence = index[~gone], evidence[~gone]
            candidate, probability = _given_out(frame, joints[index], sigma_m[index], skeleton)
        who = {name: getattr(rows, name)[index] for name in ("track", "frame", "time_s")}
        sure = {"probability": probability, "evidence": evidence}
        parts.append(Observations.of(candidate, frame.detections, joints[index], **who, **sure))
    return Observations.concatenate(parts)


def changed(before: Observations, now: Observations) -> float:
    """Share of the places where somebody is seen by a view, in the same rows, whose detection is another."""
    seen = before.seen | now.seen
    return float((before.candidate != now.candidate)[seen].sum() / max(seen.sum(), 1))


def _given_out(frame: Input, joints: Array, sigma_m: Array, skeleton: Skeleton) -> tuple[Index, Array]:
    """(P, J, V) the detections of one frame's people, and how probably they are theirs."""
    predicted = Predicted(joints, sigma_m, lost=~np.isfinite(sigma_m))
    return assign_with_probability(predicted, Sight.of(frame.detections, frame.rig, skeleton))


def probabilities_of(frame: Input, candidate: Index, joints: Array, skeleton: Skeleton) -> Array:
    """(P,) how probable each person of a frame is."""
    there = Frame(frame.detections, frame.rig, skeleton, longest_bones(skeleton))
    return existence(PossiblePeople(joints, candidate, gaps(joints, candidate, there)), there, PRIOR_WITH_BODY)


def who_goes(sure: Array, joints: Array, skeleton: Skeleton, least: float, double_m: float = _DOUBLE_M) -> Mask:
    """(P,) who is not probable enough, the least probable of them, or is a double of one who is more probable."""
    doubles = ((core_distance(joints, joints, skeleton) < double_m) & lesser(sure)).any(axis=1)
    # What one leaves may be what another lacks.
    return doubles | ((sure < least) & (sure == sure.min()))
