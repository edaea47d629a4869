"""Whose a detection is: by how near it is to a person's joint, and by its affinities to what the person has.

One rule for the proposals of a frame, for hypotheses of who may be there, and for people who are followed. They
differ in how near is near, and in what is sought of joints whose place is not known. Lists of what is possible,
not tables of everybody and everything: most detections are nowhere near most people.
"""

from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np

from shapepose_fg.core.arrays import Array, Index, Mask
from shapepose_fg.core.camera import Rig
from shapepose_fg.core.compiled import kernel
from shapepose_fg.core.detections import Detections
from shapepose_fg.core.skeleton import Skeleton

LEAST_AFFINITY = 0.3
"""What counts as affinity where no neighbour is seen, and half of the least score: unrelated pairs are mostly 0,
true ones above 0.4."""
OVERLAP_M = 0.025
"""Two people's projected joints closer than this overlap, as a length at their depth: the one detection there
serves both. A detector is 2 to 3 cm off."""


class Claims(NamedTuple):
    """What speaks for each of N detections being people's."""

    tied: Array
    """(N,) mean affinity to what the person has at the other ends of the joint's limbs; 0 where there is none."""
    score: Array
    """(N,) nearness and affinity."""
    likely: Mask
    """(N,) where these are enough."""


@dataclass(frozen=True)
class Nearby:
    """N detections that may be people's, sorted by joint and view, then by world, then by person."""

    first: Index
    """(J V + 1,) where those of each joint and view begin."""
    person: Index
    """(N,) whose joint it is."""
    detection: Index
    """(N,) which of the frame's."""
    distance_m: Array
    """(N,) from the joint's projection, metres at its depth."""

    def claimed(
        self,
        nearness: Array,
        lost: Mask,
        sure: float,
        own: Index,
        world: Index,
        detections: Detections,
        skeleton: Skeleton,
    ) -> tuple[Index, Claims]:
        """The detections (A, J, V) that people get, -1 for none, who are thought to have `own` (A, J, V): the best
        score first, each detection once in a `world` (A,), each person one for a joint and view.

        The score is `nearness` (N,), 1 on the joint and 0 far from it, and mean affinity to the person's own. Of
        joints that are `lost` (N,) only affinity tells, and so much of it must be there.
        """
        tied, neighbours = own_affinity(self.person, self.detection, own, detections, skeleton)
        # Where no neighbour is seen, the affinities say nothing: neither for nor against.
        score = nearness + np.where(neighbours > 0, tied, LEAST_AFFINITY)
        likely = np.where(lost, (neighbours > 0) & (tied >= sure), score >= 2 * LEAST_AFFINITY)
        # People whom the detector has grouped have affinities of exactly 1: equal scores are told apart.
        key, chosen = np.round(score, 9) + 1e-10 * detections.rank[self.detection], np.full_like(own, -1)
        queue, taken = np.empty(len(key), dtype=np.intp), np.empty(len(detections), dtype=np.intp)
        _match(self.first, self.person, self.detection, key, likely, world, queue, taken, chosen)
        return chosen, Claims(tied, score, likely)

    def with_tied(self, own: Index, unplaced: Mask, detections: Detections, views: int) -> "Nearby":
        """And detections of joints that are `unplaced` (A, J), infinitely far, which affinities tie to people's
        `own` (A, J, V).
        """
        person, joint, view = np.nonzero(own >= 0)
        mine, ends = own[person, joint, view], np.concatenate([detections.pairs, detections.pairs[:, ::-1]])
        ends = ends[np.argsort(ends[:, 0], kind="stable")]
        start, stop = (np.searchsorted(ends[:, 0], mine, side=side) for side in ("left", "right"))
        count = stop - start
        whose = np.repeat(person, count)
        each = np.arange(len(whose)) + np.repeat(start - np.cumsum(count) + count, count)
        tied = ends[each, 1]
        lacks = unplaced[whose, detections.joint[tied]]
        key = np.unique(whose[lacks] * len(detections) + tied[lacks])
        whose, tied = np.divmod(key, max(len(detections), 1))
        person, detection = np.append(self.person, whose), np.append(self.detection, tied)
        slot = detections.joint[detection] * views + detections.view[detection]
        order = np.lexsort((person, slot))
        first = np.searchsorted(slot[order], np.arange(len(self.first)))
        distance_m = np.append(self.distance_m, np.full(len(tied), np.inf))
        return Nearby(first, person[order], detection[order], distance_m[order])

    def share(self, tied: Array, chosen: Index, detections: Detections) -> None:
        """Let a detection on a joint, `tied` (N,) to its person, serve this one too where nothing is `chosen`."""
        on_it = np.flatnonzero((self.distance_m < OVERLAP_M) & (tied >= LEAST_AFFINITY))
        on_it = on_it[np.argsort(-self.distance_m[on_it], kind="stable")]  # the nearest is written last
        of = self.detection[on_it]
        place = self.person[on_it], detections.joint[of], detections.view[of]
        empty = chosen[place] < 0
        chosen[tuple(each[empty] for each in place)] = of[empty]


def nearby(
    places: Array, reach_m: Array, world: Index, rig: Rig, skeleton: Skeleton, detections: Detections
) -> Nearby:
    """Detections within `reach_m` (A, J) of `places` (A, J, 3), metres, of people of a `world` (A,)."""
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
        count = _near(
            places, reach_m, people, rig.K @ rig.cTw, rig.focal_px, first, order, detections.columns[2], *found
        )
    return Nearby(begins, person[:count], detection[:count], distance_m[:count])


def own_affinity(
    person: Index, detection: Index, candidate: Index, detections: Detections, skeleton: Skeleton
) -> tuple[Array, Index]:
    """Mean affinity (N,) of each `detection` (N,) to what a `person` (N,) has of `candidate` (A, J, V) at the
    other ends of the joint's limbs, and how many (N,) of these there are.
    """
    view, joint, _, pairs, affinity = detections.columns
    begin, (limb, ends) = np.zeros(len(view) + 2, dtype=np.intp), _limb_ends(skeleton)
    other, value = np.empty(pairs.size, dtype=np.intp), np.empty(pairs.size)
    mean, neighbours = np.empty(len(person)), np.empty(len(person), dtype=np.intp)
    _tie(
        person, detection, candidate, joint, view, pairs, affinity, limb, ends, begin, other, value, mean,
        neighbours,
    )  # fmt: skip
    return mean, neighbours


@cache
def _limb_ends(skeleton: Skeleton) -> tuple[Index, Index]:
    """The joints at the other ends of each joint's limbs, one after the other, and where each joint's begin."""
    joint, other = np.nonzero(skeleton.adjacency)
    return np.searchsorted(joint, np.arange(len(skeleton) + 1)), other


@kernel
def _near(places, reach_m, people, P, focal, first, order, xy, begins, person, detection, distance_m):
    """Fill in what `nearby` returns, as far as there is room; returns how much there is.

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
