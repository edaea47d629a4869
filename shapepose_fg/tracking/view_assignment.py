"""Which detections are whose when it is known where people's joints should be: one-to-one in every view."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from shapepose_fg.core.arrays import Array, Index, Mask
from shapepose_fg.core.compiled import kernel
from shapepose_fg.proposal.nearby import LEAST_AFFINITY, OVERLAP_M, Sight, claim, find_near, share

_NEAR_M = 0.06
"""How closeness to the predicted joint falls off where the prediction is exact: sigma of a Gaussian, as a length
at the joint's depth."""
_FAR_M = 0.12
"""Distance, beside twice the prediction's sigma, up to which a detection is near, m."""
FARTHEST_M = 0.5
"""Most of that, however uncertain the prediction, m."""
_REACH_M = 0.8
"""Farthest distance of a detection from a predicted joint of arms and legs, m; of a lost joint, from its neighbour
on the skeleton. What is not near must be tied by affinities to a person whose trunk the view sees near. A foot
that kicks at 150 m/s² goes so far in 0.1 s."""
_TRUNK_JOINTS = 2
"""Joints of trunk and head that a view must see near, for those of arms and legs to be far."""
_PASSES = 2
"""How often the choice is made again with the affinities to what the last one chose."""
_ODDS = 5.0
"""What a score's point adds to the logarithm of the odds that a detection is somebody's."""
_EVEN = 0.45
"""The score at which a detection that only one person can have is as likely theirs as nobody's.

Both from simulated crowds of eight (seeds 4711, 777, 90211; three and four cameras, 198,000 choices of which 2.2 %
are wrong): of choices of probability 0.62 / 0.75 / 0.86 / 0.93 / 0.97 / 0.985 / 0.997 0.63 / 0.75 / 0.83 / 0.91 /
0.97 / 0.990 / 0.998 are right."""
_MESSAGES = 6
"""Rounds of messages between people and detections: changes are under 0.01 from then on."""


@dataclass(frozen=True)
class Predicted:
    """Where the joints of A people should be."""

    places: Array
    """(A, J, 3) metres."""
    sigma_m: Array
    """(A, J) how surely."""
    lost: Mask
    """(A, J) joints that are found by affinity alone; their place is that of their neighbour."""
    world: Index | None = None
    """(A,) people of different worlds do not compete for detections."""


class Scored(NamedTuple):
    """What speaks for each of N detections being people's, by joint and view, then by world, then by person."""

    kinds = "i1 i1 i1 f1 f1 b1"
    first: Index
    """(J V + 1,) where those of each joint and view begin."""
    person: Index
    """(N,) whose joint it is."""
    detection: Index
    """(N,) which of the frame's."""
    distance_m: Array
    """(N,) from the joint's projection, metres at its depth."""
    score: Array
    """(N,) nearness, and affinity to what the person has at the other ends of the joint's limbs."""
    possible: Mask
    """(N,) near a joint whose place is known, or likely by affinity."""


def assign(predicted: Predicted, sight: Sight) -> Index:
    """The detection (A, J, V) of each person's joint in each view, -1 where there is none: the best score first,
    each detection once, but for those on which several people's joints lie.
    """
    return _assigned(predicted, sight)[0]


def assign_with_probability(predicted: Predicted, sight: Sight) -> tuple[Index, Array]:
    """What `assign` gives, and how probably (A, J, V) each of these detections is the person's; 0 where none is.

    A detection that serves two people, because it lies on the joints of both, is in the right place for either if
    it is anybody's.
    """
    chosen, near = _assigned(predicted, sight)
    probable = probabilities(near, len(sight.of_view))
    of, count = near.detection, len(sight.of_view)
    serves = np.bincount(chosen[chosen >= 0], minlength=count)[of] > 1
    # Marginals of competitors that form a cycle are not exact: their sum may be over 1 by a little.
    together = np.minimum(np.bincount(of, probable, count)[of], 1.0)
    place = near.person, sight.of_joint[of], sight.of_view[of]
    taken, probability = chosen[place] == of, np.zeros(chosen.shape)
    probability[tuple(each[taken] for each in place)] = np.where(serves, together, probable)[taken]
    return chosen, probability


def probabilities(near: Scored, detections: int) -> Array:
    """(N,) how probably each detection is the person's, of those that are possible, by their score.

    A person has at most one detection of a joint in a view, and a detection is one person's or nobody's: the
    marginals of all ways to give them out, by belief propagation (Williams and Lau, 2014), which is exact where
    who competes for what has no cycle.
    """
    weight = np.where(near.possible, np.exp(_ODDS * (near.score - _EVEN)), 0.0)
    probable = np.empty_like(weight)
    people = int(near.person.max(initial=-1)) + 1
    room = np.zeros(people), np.zeros(detections), np.ones_like(weight)
    _marginals(near.first, near.person, near.detection, weight, _MESSAGES, *room, probable)
    return probable


def _assigned(predicted: Predicted, sight: Sight) -> tuple[Index, Scored]:
    """The detections (A, J, V), and what speaks for all that are near."""
    (A, J), V = predicted.sigma_m.shape, len(sight.cameras)
    world = np.zeros(A, dtype=np.intp) if predicted.world is None else predicted.world
    people, given = np.argsort(world, kind="stable"), np.ascontiguousarray(predicted.places)
    chosen, first = np.empty((2, A, J, V), dtype=np.intp), np.empty((2, J * V + 1), dtype=np.intp)
    count, near = 4 * A * J * V, None
    while near is None or count > len(near.person):
        whole, real, flag = np.empty((3, count), np.intp), np.empty((5, count)), np.empty((2, count), dtype=bool)
        near = Scored(first[0], whole[0], whole[1], real[0], real[1], flag[0])
        gates, taken = np.empty((2, A, J)), np.empty(len(sight.of_view), np.intp)
        count = _assign(
            given, predicted.sigma_m, predicted.lost, world, people, sight, near, gates, first[1], whole[2], taken,
            real[2:], flag[1], chosen,
        )  # fmt: skip
    begins, person, detection, distance_m, score, possible = near
    ends = distance_m[:count], score[:count], possible[:count]
    return chosen[0], Scored(begins, person[:count], detection[:count], *ends)


@kernel("f3 f2 b2 i1 i1", Sight, Scored, "f3 i1 i1 i1 f2 b1 i4")
def _assign(
    places, sigma_m, lost, world, people, sight, near, gates, first, queue, taken, reals, sought, both
):  # fmt: skip
    """Fill in `near`, and the first of `both` (2, A, J, V), as far as there is room for what is near; returns how
    much there is.
    """
    gate_m, reach_m, chosen, before = gates[0], gates[1], both[0], both[1]
    nearness, tied, key = reals[0], reals[1], reals[2]
    people_count, joints, views = chosen.shape
    for a in range(people_count):
        for j in range(joints):
            gate_m[a, j] = 0.0 if lost[a, j] else min(_FAR_M + 2 * sigma_m[a, j], FARTHEST_M)
            for v in range(views):
                before[a, j, v] = -1
            reach_m[a, j] = _REACH_M if lost[a, j] or sight.swings[j] else max(gate_m[a, j], OVERLAP_M)
    begins, person, detection, distance_m, score, possible = near
    count = find_near(places, reach_m, people, sight, first, begins, person, detection, distance_m)
    if count > len(person):
        return count
    of_joint = sight.of_joint
    for e in range(count):
        a, j = person[e], of_joint[detection[e]]
        sought[e] = lost[a, j]
        nearness[e] = -np.inf
        if sought[e] or distance_m[e] < gate_m[a, j]:
            nearness[e] = np.exp(-0.5 * distance_m[e] ** 2 / (_NEAR_M**2 + sigma_m[a, j] ** 2))
    for n in range(1 + _PASSES):
        for e in range(count if n > 0 else 0):
            a, j, v = person[e], of_joint[detection[e]], sight.of_view[detection[e]]
            if sight.swings[j] and not sought[e] and not distance_m[e] < gate_m[a, j]:
                trunk = 0
                for k in range(joints):
                    trunk += before[a, k, v] >= 0 and not sight.swings[k]
                nearness[e] = 0.0 if trunk >= _TRUNK_JOINTS else -np.inf
        claim(
            begins, person, detection, nearness, sought, LEAST_AFFINITY, before, world, sight, tied, score,
            possible, key, queue, taken, chosen,
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
def _marginals(first, person, detection, weight, rounds, of_person, of_detection, unclaimed, probable):
    """Fill in `probable` (N,) from `weight` (N,), joint by joint and view by view; zeros by person and detection
    and ones (N,) to begin with.
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
