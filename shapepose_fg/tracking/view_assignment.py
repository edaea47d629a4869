"""Which detections are whose when it is known where people's joints should be: one-to-one in every view."""

from dataclasses import dataclass
from functools import cache

import numpy as np

from shapepose_fg.core.arrays import Array, Index, Mask
from shapepose_fg.core.camera import Rig
from shapepose_fg.core.compiled import kernel
from shapepose_fg.core.detections import Detections
from shapepose_fg.core.skeleton import Skeleton
from shapepose_fg.proposal.claims import LEAST_AFFINITY, OVERLAP_M

_NEAR_M = 0.06
"""How closeness to the predicted joint falls off where the prediction is exact: sigma of a Gaussian, as a length
at the joint's depth."""
_FAR_M = 0.12
"""No detection farther than this, and twice the prediction's sigma, is taken."""
FARTHEST_M = 0.5
"""No detection farther than this is taken, however uncertain the prediction."""
_REACH_M = 0.8
"""A lost joint is sought this far around its neighbour on the skeleton."""
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


@dataclass(frozen=True)
class Near:
    """N detections that are near people's joints, sorted by joint and view, then by people."""

    first: Index
    """(J V + 1,) where those of each joint and view begin."""
    person: Index
    """(N,) whose joint it is."""
    detection: Index
    """(N,) which of the frame's."""
    distance_m: Array
    """(N,) from the joint's projection, metres at its depth."""
    inside: Mask
    """(N,) near enough to a joint whose place is known."""
    score: Array
    """(N,) nearness, and affinity to what the person has at the other ends of the joint's limbs."""
    likely: Mask
    """(N,) whether these are enough."""


def assign(predicted: Predicted, detections: Detections, rig: Rig, skeleton: Skeleton) -> Index:
    """The detection (A, J, V) of each person's joint in each view, -1 where there is none: the best score first,
    each detection once, but for those on which several people's joints lie.
    """
    return _assigned(predicted, detections, rig, skeleton)[0]


def assign_with_probability(
    predicted: Predicted, detections: Detections, rig: Rig, skeleton: Skeleton
) -> tuple[Index, Array]:
    """What `assign` gives, and how probably (A, J, V) each of these detections is the person's; 0 where none is.

    A detection that serves two people, because it lies on the joints of both, is in the right place for either if
    it is anybody's.
    """
    chosen, near = _assigned(predicted, detections, rig, skeleton)
    probable = probabilities(near, len(detections))
    of, count = near.detection, len(detections)
    serves = np.bincount(chosen[chosen >= 0], minlength=count)[of] > 1
    # Marginals of competitors that form a cycle are not exact: their sum may be over 1 by a little.
    together = np.minimum(np.bincount(of, probable, count)[of], 1.0)
    place = near.person, detections.joint[of], detections.view[of]
    taken, probability = chosen[place] == of, np.zeros(chosen.shape)
    probability[tuple(each[taken] for each in place)] = np.where(serves, together, probable)[taken]
    return chosen, probability


def probabilities(near: Near, detections: int) -> Array:
    """(N,) how probably each detection is each person's, of those that are `near`, by their score.

    A person has at most one detection of a joint in a view, and a detection is one person's or nobody's: the
    marginals of all ways to give them out, by belief propagation (Williams and Lau, 2014), which is exact where
    who competes for what has no cycle.
    """
    weight = np.where(near.inside | near.likely, np.exp(_ODDS * (near.score - _EVEN)), 0.0)
    probable = np.empty_like(weight)
    people = int(near.person.max(initial=-1)) + 1
    _marginals(near.first, near.person, near.detection, weight, people, detections, _MESSAGES, probable)
    return probable


def own_affinity(
    person: Index, detection: Index, candidate: Index, detections: Detections, skeleton: Skeleton
) -> tuple[Array, Index]:
    """Mean affinity (N,) of each `detection` (N,) to what a `person` (N,) has of `candidate` (A, J, V) at the
    other ends of the joint's limbs, and how many (N,) of these there are.
    """
    count, pairs = len(detections), detections.pairs
    begin, (limb, ends) = np.zeros(count + 2, dtype=np.intp), _limb_ends(skeleton)
    other, value = np.empty(pairs.size, dtype=np.intp), np.empty(pairs.size)
    mean, neighbours = np.empty(len(person)), np.empty(len(person), dtype=np.intp)
    _tie(
        person, detection, candidate, detections.joint, detections.view, pairs, detections.affinity, limb, ends,
        begin, other, value, mean, neighbours,
    )  # fmt: skip
    return mean, neighbours


def _assigned(predicted: Predicted, detections: Detections, rig: Rig, skeleton: Skeleton) -> tuple[Index, Near]:
    """The detections (A, J, V), and all that are near."""
    gate_m = np.where(predicted.lost, _REACH_M, np.minimum(_FAR_M + 2 * predicted.sigma_m, FARTHEST_M))
    world = np.zeros(len(gate_m), dtype=np.intp) if predicted.world is None else predicted.world
    first, *found = _found(predicted.places, np.maximum(gate_m, OVERLAP_M), world, rig, skeleton, detections)
    person, detection, distance_m = found
    at = person, detections.joint[detection]
    within, lost, sigma_m = distance_m < gate_m[at], predicted.lost[at], predicted.sigma_m[at]
    nearness = np.exp(-0.5 * distance_m**2 / (_NEAR_M**2 + sigma_m**2))
    # People whom the detector has grouped have affinities of exactly 1: equal scores are told apart.
    apart = 1e-10 * detections.rank[detection]
    chosen = np.full((len(gate_m), len(skeleton), len(rig)), -1, dtype=np.intp)
    for _ in range(_PASSES + 1):
        before, chosen = chosen, np.full_like(chosen, -1)
        tied, neighbours = own_affinity(person, detection, before, detections, skeleton)
        # Where no neighbour is seen, the affinities say nothing: neither for nor against.
        score = nearness + np.where(neighbours > 0, tied, LEAST_AFFINITY)
        sure = (neighbours > 0) & (tied >= LEAST_AFFINITY)
        likely = within & np.where(lost, sure, score >= 2 * LEAST_AFFINITY)
        key, queue = np.round(score, 9) + apart, np.empty(len(person), dtype=np.intp)
        taken = np.empty(len(detections), dtype=np.intp)
        _match(first, person, detection, key, likely, world, queue, taken, chosen)
        if (chosen == before).all():
            break
    on_it = np.flatnonzero((distance_m < OVERLAP_M) & (tied >= LEAST_AFFINITY))
    on_it = on_it[np.argsort(-distance_m[on_it], kind="stable")]  # the nearest is written last
    place = person[on_it], detections.joint[detection[on_it]], detections.view[detection[on_it]]
    empty = chosen[place] < 0
    chosen[tuple(each[empty] for each in place)] = detection[on_it[empty]]
    return chosen, Near(first, person, detection, distance_m, within & ~lost, score, likely)


def _found(
    places: Array, reach_m: Array, world: Index, rig: Rig, skeleton: Skeleton, detections: Detections
) -> tuple[Index, Index, Index, Array]:
    """The first four fields of `Near`: detections within `reach_m` (A, J) of `places` (A, J, 3), metres, of people
    of the same `world` (A,) one after the other.
    """
    people, places = np.argsort(world, kind="stable"), np.ascontiguousarray(places)
    slot = detections.joint * len(rig) + detections.view
    order = np.lexsort((detections.xy[:, 0], slot))
    first = np.searchsorted(slot[order], np.arange(len(skeleton) * len(rig) + 1))
    begins, count, room = np.zeros_like(first), 4 * reach_m.size * len(rig), 0
    person = detection = np.zeros(0, dtype=np.intp)
    distance_m = np.zeros(0)
    while count > room:
        room = count
        person, detection, distance_m = np.empty(room, np.intp), np.empty(room, np.intp), np.empty(room)
        found = begins, person, detection, distance_m
        count = _near(places, reach_m, people, rig.K @ rig.cTw, rig.focal_px, first, order, detections.xy, *found)
    return begins, person[:count], detection[:count], distance_m[:count]


@cache
def _limb_ends(skeleton: Skeleton) -> tuple[Index, Index]:
    """The joints at the other ends of each joint's limbs, one after the other, and where each joint's begin."""
    joint, other = np.nonzero(skeleton.adjacency)
    return np.searchsorted(joint, np.arange(len(skeleton) + 1)), other


@kernel
def _near(places, reach_m, people, P, focal, first, order, xy, begins, person, detection, distance_m):
    """Fill in what `_found` returns, as far as there is room; returns how much there is.

    `order` (D,) sorts detections by joint and view, of which each begins at `first` (J V + 1,), and by x.
    """
    views, count = len(P), 0
    for slot in range(len(first) - 1):
        j, v, stop = slot // views, slot % views, first[slot + 1]
        for n in range(len(people) if first[slot] < stop else 0):
            place, reach = places[people[n], j], reach_m[people[n], j]
            depth = _along(P[v, 2], place)
            if not depth > 0:
                continue
            x, y, m_per_px = _along(P[v, 0], place) / depth, _along(P[v, 1], place) / depth, depth / focal[v]
            reach_px = 1.000001 * reach / m_per_px
            low, high = first[slot], stop
            while low < high:  # the first that is not too far to the left
                middle = (low + high) // 2
                if xy[order[middle], 0] < x - reach_px:
                    low = middle + 1
                else:
                    high = middle
            while low < stop and xy[order[low], 0] <= x + reach_px:
                d = order[low]
                low += 1
                apart_m = np.sqrt((x - xy[d, 0]) ** 2 + (y - xy[d, 1]) ** 2) * m_per_px
                if apart_m < reach:
                    if count < len(person):
                        person[count], detection[count], distance_m[count] = people[n], d, apart_m
                    count += 1
        begins[slot + 1] = count
    return count


@kernel
def _along(row, place):
    """A row (4,) of a projection times a place (3,), in the world."""
    return row[0] * place[0] + row[1] * place[1] + row[2] * place[2] + row[3]


@kernel
def _tie(
    person, detection, own, joint, view, pairs, affinity, limb, ends, begin, other, value, mean, neighbours
):  # fmt: skip
    """Fill in the `mean` affinity (N,) and `neighbours` (N,) of `own_affinity`.

    On the way `begin` (D + 2,), zeros before, `other` and `value` (2 E,): the pairs of each detection.
    """
    for e in range(len(pairs)):
        for end in range(2):
            if pairs[e, end] + 2 < len(begin):
                begin[pairs[e, end] + 2] += 1
    for d in range(2, len(begin)):
        begin[d] += begin[d - 1]
    for e in range(len(pairs)):
        for end in range(2):
            place = begin[pairs[e, end] + 1]
            other[place], value[place] = pairs[e, 1 - end], affinity[e]
            begin[pairs[e, end] + 1] += 1
    for e in range(len(person)):
        a, d, count, total = person[e], detection[e], 0, 0.0
        for n in range(limb[joint[d]], limb[joint[d] + 1]):
            if own[a, ends[n], view[d]] >= 0:
                count += 1
        if count > 0:
            for n in range(begin[d], begin[d + 1]):
                if own[a, joint[other[n]], view[other[n]]] == other[n]:
                    total += value[n]
            total /= count
        mean[e], neighbours[e] = total, count


@kernel
def _match(first, person, detection, key, likely, world, queue, taken, chosen):
    """Give each detection of a joint and view to one person, and each person one, the best `key` first."""
    views = chosen.shape[2]
    for slot in range(len(first) - 1):
        j, v, end = slot // views, slot % views, first[slot]
        while end < first[slot + 1]:  # worlds stand one after the other, and do not compete
            of, length = world[person[end]], 0
            while end < first[slot + 1] and world[person[end]] == of:
                taken[detection[end]] = -1
                if likely[end]:
                    queue[length] = end
                    length += 1
                end += 1
            gap = length // 2
            while gap > 0:  # sorted in Shell's way
                for n in range(gap, length):
                    moved, place = queue[n], n
                    while place >= gap:
                        e = queue[place - gap]
                        if key[e] > key[moved] or (key[e] == key[moved] and e < moved):
                            break
                        queue[place] = e
                        place -= gap
                    queue[place] = moved
                gap //= 2
            for n in range(length):
                a, d = person[queue[n]], detection[queue[n]]
                if chosen[a, j, v] < 0 and taken[d] < 0:
                    chosen[a, j, v], taken[d] = d, a


@kernel
def _marginals(first, person, detection, weight, people, detections, rounds, probable):
    """Fill in `probable` (N,) from `weight` (N,), joint by joint and view by view."""
    of_person, of_detection, unclaimed = np.zeros(people), np.zeros(detections), np.ones(len(weight))
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
