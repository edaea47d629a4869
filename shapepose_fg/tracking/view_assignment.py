"""Assignment of detections to predicted joints, one-to-one in every view."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from shapepose_fg.core.arrays import Array, Index, Mask
from shapepose_fg.core.compiled import kernel
from shapepose_fg.proposal.nearby import (
    LEAST_AFFINITY,
    NEAR_M,
    OVERLAP_M,
    PASSES,
    FrameArrays,
    claim,
    find_near,
    share,
)

_FAR_M = 0.12
"""Distance, plus twice the prediction's sigma, up to which a detection is near, m."""
FARTHEST_M = 0.5
"""Maximum distance of a detection from its predicted joint, m, however uncertain that is."""
_REACH_M = 0.8
"""Maximum distance of a detection from a predicted joint of arms or legs, m; for a lost joint, from
its neighbour on the skeleton. Detections that are not near need affinities to a person with a trunk
seen near in this view. A foot kicking at 150 m/s² moves this far in 0.1 s."""
_TRUNK_JOINTS = 2
"""Joints of trunk and head that a view must see near before far detections of arms and legs are
accepted."""
_ODDS = 5.0
"""Log-odds that a detection is a person's, per unit of score."""
_EVEN = 0.45
"""Score at which a detection with a single candidate person is as likely theirs as unassigned.

Both are fitted to simulated crowds of eight (seeds 4711, 777, 90211; three and four cameras,
198,000 assignments, 2.2 % wrong): of assignments with probability 0.62 / 0.75 / 0.86 / 0.93 / 0.97
/ 0.985 / 0.997, the shares 0.63 / 0.75 / 0.83 / 0.91 / 0.97 / 0.990 / 0.998 are right."""
_MESSAGES = 6
"""Iterations of belief propagation; later changes are under 0.01."""


@dataclass(frozen=True)
class Predicted:
    """Predicted joints of A people."""

    places: Array
    """(A, J, 3) positions, metres."""
    sigma_m: Array
    """(A, J) standard deviations, m."""
    lost: Mask
    """(A, J) lost joints, at the position of their neighbour; they are assigned by
    affinity only."""
    global_hypothesis: Index | None = None
    """(A,) global hypothesis of each person; people of different global hypotheses do not compete
    for detections."""


class Scored(NamedTuple):
    """Scores of N pairs of person and detection, sorted by joint and view, then global hypothesis,
    then person.
    """

    kinds = "i1 i1 i1 f1 f1 b1"
    first: Index
    """(J V + 1,) offsets of the pairs of each joint and view."""
    person: Index
    """(N,) person."""
    detection: Index
    """(N,) index of the detection in the frame."""
    distance_m: Array
    """(N,) distance from the joint's projection, metres at its depth."""
    score: Array
    """(N,) nearness plus affinity to the person's detections at the other ends of the joint's
    limbs."""
    possible: Mask
    """(N,) whether the pair is possible: near a joint of known position, or likely by affinity."""


def assign(predicted: Predicted, arrays: FrameArrays) -> Index:
    """Detection (A, J, V) of each person's joint in each view, -1 for none: greedy by score, each
    detection once, except those on which joints of several people coincide.
    """
    return _assigned(predicted, arrays)[0]


def assign_with_probability(predicted: Predicted, arrays: FrameArrays) -> tuple[Index, Array]:
    """`assign`, and the probability (A, J, V) that each detection is the person's; 0 without a
    detection.

    A detection that two people share, because joints of both coincide, is well placed for both if
    it is right for either.
    """
    chosen, near = _assigned(predicted, arrays)
    probable = probabilities(near, len(arrays.of_view))
    of, count = near.detection, len(arrays.of_view)
    serves = np.bincount(chosen[chosen >= 0], minlength=count)[of] > 1
    # Belief propagation is inexact with cycles of competitors: the sum may slightly exceed 1.
    together = np.minimum(np.bincount(of, probable, count)[of], 1.0)
    place = near.person, arrays.of_joint[of], arrays.of_view[of]
    taken, probability = chosen[place] == of, np.zeros(chosen.shape)
    probability[tuple(each[taken] for each in place)] = np.where(serves, together, probable)[taken]
    return chosen, probability


def probabilities(near: Scored, detections: int) -> Array:
    """(N,) probability that each possible detection is the person's, by the scores.

    A person has at most one detection of a joint per view, and a detection at most one person. The
    marginals over all such assignments are computed by belief propagation (Williams and Lau, 2014),
    exact if the graph of competitors has no cycle.
    """
    weight = np.where(near.possible, np.exp(_ODDS * (near.score - _EVEN)), 0.0)
    probable = np.empty_like(weight)
    people = int(near.person.max(initial=-1)) + 1
    room = np.zeros(people), np.zeros(detections), np.ones_like(weight)
    _marginals(near.first, near.person, near.detection, weight, _MESSAGES, *room, probable)
    return probable


def _assigned(predicted: Predicted, arrays: FrameArrays) -> tuple[Index, Scored]:
    """The detections (A, J, V), and the scores of all near pairs."""
    (A, J), V = predicted.sigma_m.shape, len(arrays.cameras)
    hypothesis = (
        np.zeros(A, dtype=np.intp)
        if predicted.global_hypothesis is None
        else predicted.global_hypothesis
    )
    people, given = (
        np.argsort(hypothesis, kind="stable"),
        np.ascontiguousarray(predicted.places),
    )
    chosen, first = np.empty((2, A, J, V), dtype=np.intp), np.empty((2, J * V + 1), dtype=np.intp)
    count, near = 4 * A * J * V, None
    while near is None or count > len(near.person):
        whole, real, flag = (
            np.empty((3, count), np.intp),
            np.empty((5, count)),
            np.empty((2, count), dtype=bool),
        )
        near = Scored(first[0], whole[0], whole[1], real[0], real[1], flag[0])
        gates, taken = np.empty((2, A, J)), np.empty(len(arrays.of_view), np.intp)
        count = _assign(
            given, predicted.sigma_m, predicted.lost, hypothesis, people, arrays, near, gates,
            first[1], whole[2], taken, real[2:], flag[1], chosen,
        )  # fmt: skip
    begins, person, detection, distance_m, score, possible = near
    ends = distance_m[:count], score[:count], possible[:count]
    return chosen[0], Scored(begins, person[:count], detection[:count], *ends)


@kernel("f3 f2 b2 i1 i1", FrameArrays, Scored, "f3 i1 i1 i1 f2 b1 i4")
def _assign(
    places, sigma_m, lost, hypothesis, people, arrays, near, gates, first, queue, taken, reals,
    sought, both
):  # fmt: skip
    """Fill in `near` and the first of `both` (2, A, J, V), as far as the arrays reach; returns the
    number of near pairs.
    """
    gate_m, reach_m, chosen, before = gates[0], gates[1], both[0], both[1]
    nearness, tied, key = reals[0], reals[1], reals[2]
    people_count, joints, views = chosen.shape
    for a in range(people_count):
        for j in range(joints):
            gate_m[a, j] = 0.0 if lost[a, j] else min(_FAR_M + 2 * sigma_m[a, j], FARTHEST_M)
            for v in range(views):
                before[a, j, v] = -1
            reach_m[a, j] = (
                _REACH_M if lost[a, j] or arrays.swings[j] else max(gate_m[a, j], OVERLAP_M)
            )
    begins, person, detection, distance_m, score, possible = near
    count = find_near(places, reach_m, people, arrays, first, begins, person, detection, distance_m)
    if count > len(person):
        return count
    of_joint = arrays.of_joint
    for e in range(count):
        a, j = person[e], of_joint[detection[e]]
        sought[e] = lost[a, j]
        nearness[e] = -np.inf
        if sought[e] or distance_m[e] < gate_m[a, j]:
            nearness[e] = np.exp(-0.5 * distance_m[e] ** 2 / (NEAR_M**2 + sigma_m[a, j] ** 2))
    for n in range(1 + PASSES):
        for e in range(count if n > 0 else 0):
            a, j, v = person[e], of_joint[detection[e]], arrays.of_view[detection[e]]
            if arrays.swings[j] and not sought[e] and not distance_m[e] < gate_m[a, j]:
                trunk = 0
                for k in range(joints):
                    trunk += before[a, k, v] >= 0 and not arrays.swings[k]
                nearness[e] = 0.0 if trunk >= _TRUNK_JOINTS else -np.inf
        claim(
            begins, person, detection, nearness, sought, LEAST_AFFINITY, before, hypothesis, arrays,
            tied, score, possible, key, queue, taken, chosen,
        )  # fmt: skip
        changed = False
        for a in range(people_count):
            for j in range(joints):
                for v in range(views):
                    changed = changed or chosen[a, j, v] != before[a, j, v]
                    before[a, j, v] = chosen[a, j, v]
        if not changed:
            break
    share(begins, person, detection, distance_m, tied, chosen)
    for e in range(count):
        possible[e] = possible[e] or distance_m[e] < gate_m[person[e], of_joint[detection[e]]]
    return count


@kernel("i1 i1 i1 f1 i0 f1 f1 f1 f1")
def _marginals(
    first, person, detection, weight, rounds, of_person, of_detection, unclaimed, probable
):
    """Fill in `probable` (N,) from `weight` (N,) for each joint and view; `of_person` and
    `of_detection` must be zeros, `unclaimed` (N,) ones.
    """
    for slot in range(len(first) - 1):
        span = range(first[slot], first[slot + 1])
        for _ in range(rounds):
            for e in span:
                of_person[person[e]] += weight[e] * unclaimed[e]
            for e in span:
                others = of_person[person[e]] - weight[e] * unclaimed[e]
                probable[e] = weight[e] / (1 + max(others, 0.0))
                of_detection[detection[e]] += probable[e]
            for e in span:
                unclaimed[e] = 1 / (1 + of_detection[detection[e]] - probable[e])
                of_person[person[e]] = 0.0
            for e in span:
                of_detection[detection[e]] = 0.0
        for e in span:
            of_person[person[e]] += weight[e] * unclaimed[e]
        for e in span:
            probable[e] = weight[e] * unclaimed[e] / (1 + of_person[person[e]])
        for e in span:
            of_person[person[e]] = 0.0
