"""Scores of detections for people's joints: nearness to the joint, and affinities to the person's
other detections.

The same rule serves the proposals of a frame, hypotheses of people, and tracked people; they differ
in the distance limits and in the treatment of joints without a position. Possible pairs are stored
as sparse lists, because most detections are far from most people.
"""

from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np

from shapepose_fg.core.arrays import Array, Index, Mask
from shapepose_fg.core.camera import Rig
from shapepose_fg.core.compiled import kernel, part
from shapepose_fg.core.detections import Detections
from shapepose_fg.core.kernel_geometry import project
from shapepose_fg.core.skeleton import Skeleton

LEAST_AFFINITY = 0.3
"""Affinity assumed if no neighbour is detected, and half of the minimum score: unrelated pairs are
mostly 0, true ones above 0.4."""
OVERLAP_M = 0.025
"""Distance of two people's projected joints, as a length at their depth, m, below which one
detection serves both. A detector's error is 2 to 3 cm."""
NEAR_M = 0.06
"""Standard deviation of the nearness score around an exactly known position, as a length at the
joint's depth, m."""
PASSES = 2
"""Number of further passes of an assignment, each with the affinities to the previous one."""


class FrameArrays(NamedTuple):
    """A frame in the form that kernels take: V cameras, D detections, and the limbs of J joints."""

    kinds = "f3 f1 f2 i1 i1 f2 f1 i1 f1 i1 i1 f1 i1 i1 b1"
    cameras: Array
    """(V, 3, 4) K [R | t] of each view."""
    focal: Array
    """(V,) focal lengths, pixels."""
    sizes: Array
    """(V, 2) width and height of the images, pixels."""
    of_view: Index
    """(D,) view of each detection."""
    of_joint: Index
    """(D,) index of the joint of each detection."""
    xy: Array
    """(D, 2) undistorted pixels."""
    confidence: Array
    """(D,) confidence of the detector."""
    order: Index
    """(D,) `Detections.order`."""
    rank: Array
    """(D,) `Detections.rank`."""
    begin: Index
    """(D + 1,) offsets; `other` and `value` are (2 E,): see `Detections.ties`."""
    other: Index
    value: Array
    limb: Index
    """(J + 1,) offset of each joint's limbs in `limb_ends`."""
    limb_ends: Index
    """(2 L,) the joint at the other end of each limb."""
    swings: Mask
    """(J,) joints of arms and legs except shoulders and hips."""

    @classmethod
    def of(cls, detections: Detections, rig: Rig, skeleton: Skeleton) -> "FrameArrays":
        """The arrays of detections and cameras."""
        view, joint, xy, _, _ = detections.columns
        confidence = np.require(detections.confidence, float, ["C", "W"])
        seen = view, joint, xy, confidence, detections.order, detections.rank, *detections.ties
        return cls(rig.K @ rig.cTw, rig.focal_px, rig.image_sizes, *seen, *_limb_ends(skeleton))


class Claims(NamedTuple):
    """Scores of N possible pairs of person and detection."""

    tied: Array
    """(N,) mean affinity to the person's detections at the other ends of the joint's limbs; 0
    without any."""
    score: Array
    """(N,) nearness plus affinity."""
    likely: Mask
    """(N,) whether the score suffices."""


@dataclass(frozen=True)
class Nearby:
    """N possible pairs of person and detection, sorted by joint and view, then hypothesis,
    then person.
    """

    first: Index
    """(J V + 1,) offset of the pairs of each joint and view."""
    person: Index
    """(N,) person."""
    detection: Index
    """(N,) index of the detection in the frame."""
    distance_m: Array
    """(N,) distance from the joint's projection, metres at its depth."""

    def claimed(
        self,
        nearness: Array,
        lost: Mask,
        least_affinity: float,
        own: Index,
        hypothesis: Index,
        arrays: FrameArrays,
    ) -> tuple[Index, Claims]:
        """Assign detections (A, J, V) to people, -1 for none, given their present ones `own` (A, J,
        V): greedy by score, each detection once in a `hypothesis` (A,), one per person, joint and
        view.

        The score is `nearness` (N,), 1 on the joint and 0 far from it, plus mean affinity to the
        person's own detections. For `lost` (N,) joints only the affinity is used, which must be at
        least `least_affinity`.
        """
        N, chosen = len(self.person), np.empty(own.shape, dtype=np.intp)
        claims = Claims(np.empty(N), np.empty(N), np.empty(N, dtype=bool))
        room = np.empty(N), np.empty(N, dtype=np.intp), np.empty(len(arrays.of_view), dtype=np.intp)
        near = self.first, self.person, self.detection
        claim(
            *near, nearness, lost, least_affinity, own, hypothesis, arrays, *claims, *room, chosen
        )
        return chosen, claims

    def with_tied(self, own: Index, unplaced: Mask, arrays: FrameArrays) -> "Nearby":
        """Add detections of `unplaced` joints (A, J) with affinities to people's detections `own`
        (A, J, V).

        Their distance is infinite.
        """
        person, joint, view = np.nonzero(own >= 0)
        own_detection, views = own[person, joint, view], len(arrays.cameras)
        start, count = (
            arrays.begin[own_detection],
            arrays.begin[own_detection + 1] - arrays.begin[own_detection],
        )
        pair_person = np.repeat(person, count)
        tied = arrays.other[
            np.arange(len(pair_person)) + np.repeat(start - np.cumsum(count) + count, count)
        ]
        lacks = unplaced[pair_person, arrays.of_joint[tied]]
        key = np.unique(pair_person[lacks] * len(arrays.of_view) + tied[lacks])
        pair_person, tied = np.divmod(key, max(len(arrays.of_view), 1))
        person, detection = np.append(self.person, pair_person), np.append(self.detection, tied)
        slot = arrays.of_joint[detection] * views + arrays.of_view[detection]
        order = np.lexsort((person, slot))
        first = np.searchsorted(slot[order], np.arange(len(self.first)))
        distance_m = np.append(self.distance_m, np.full(len(tied), np.inf))
        return Nearby(first, person[order], detection[order], distance_m[order])

    def share(self, tied: Array, chosen: Index) -> None:
        """Where nothing is `chosen`, share a detection that lies on the joint and is `tied` (N,) to
        the person.
        """
        share(self.first, self.person, self.detection, self.distance_m, tied, chosen)


def nearby(places: Array, reach_m: Array, hypothesis: Index, arrays: FrameArrays) -> Nearby:
    """Detections within `reach_m` (A, J) of joints at `places` (A, J, 3), metres; people have a
    `hypothesis` (A,).
    """
    people, places = np.argsort(hypothesis, kind="stable"), np.ascontiguousarray(places)
    slots = places.shape[1] * len(arrays.cameras) + 1
    first, begins = np.zeros((2, slots), dtype=np.intp)
    room, count = 0, 4 * reach_m.size * len(arrays.cameras)
    person = detection = np.zeros(0, dtype=np.intp)
    distance_m = np.zeros(0)
    while count > room:
        room = count
        person, detection, distance_m = (
            np.empty(room, np.intp),
            np.empty(room, np.intp),
            np.empty(room),
        )
        count = find_near(
            places, reach_m, people, arrays, first, begins, person, detection, distance_m
        )
    return Nearby(begins, person[:count], detection[:count], distance_m[:count])


def own_affinity(
    person: Index, detection: Index, candidate: Index, arrays: FrameArrays
) -> tuple[Array, Index]:
    """Mean affinity (N,) of each `detection` (N,) to the detections `candidate` (A, J, V) of
    `person` (N,) at the other ends of the joint's limbs, and their number (N,).
    """
    mean, neighbours = np.empty(len(person)), np.empty(len(person), dtype=np.intp)
    tie(person, detection, candidate, arrays, mean, neighbours)
    return mean, neighbours


@cache
def _limb_ends(skeleton: Skeleton) -> tuple[Index, Index, Mask]:
    """Offsets of each joint's limbs, the joints at their other ends, concatenated, and a mask of
    joints beyond shoulders and hips.
    """
    joint, other = np.nonzero(skeleton.adjacency)
    paired = np.array(skeleton.mirror) != np.arange(len(skeleton))
    swings = paired & paired[np.array(skeleton.parents)]
    return np.searchsorted(joint, np.arange(len(skeleton) + 1)), np.ascontiguousarray(other), swings


@cache
def limbs_of(skeleton: Skeleton) -> Index:
    """(L, 2) limbs between core joints, and the spine; these occlude others."""
    core = set(skeleton.core)
    return np.array(
        [(skeleton.parents[j], j) for j in skeleton.core if skeleton.parents[j] in core]
    )


@kernel("f3 f2 i1", FrameArrays, "i1 i1 i1 i1 f1")
def find_near(places, reach_m, people, arrays, first, begins, person, detection, distance_m):
    """Fill in the results of `nearby`, as far as the arrays reach; returns the number of pairs.

    `first` (J V + 1,) gets the offset of each joint and view in `arrays.order`.
    """
    views, count, xy, order, cameras = (
        len(arrays.cameras),
        0,
        arrays.xy,
        arrays.order,
        arrays.cameras,
    )
    of_joint, of_view, focal = arrays.of_joint, arrays.of_view, arrays.focal
    for slot in range(len(first)):
        first[slot] = begins[slot] = 0
    for d in range(len(order)):
        first[of_joint[d] * views + of_view[d] + 1] += 1
    for slot in range(len(first) - 1):
        first[slot + 1] += first[slot]
        j, v, stop = slot // views, slot % views, first[slot + 1]
        for n in range(len(people) if first[slot] < stop else 0):
            reach = reach_m[people[n], j]
            x, y, depth = project(cameras[v], places[people[n], j])
            if not depth > 0:
                continue
            m_per_px = depth / focal[v]
            reach_px = 1.000001 * reach / m_per_px
            low, high = first[slot], stop
            while low < high:  # binary search for the left end
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


@kernel("i1 i1 i3", FrameArrays, "f1 i1")
def tie(person, detection, own, arrays, mean, neighbours):
    """Fill in the `mean` affinity (N,) and `neighbours` (N,) of `own_affinity`."""
    of_joint, of_view, begin, other, value = (
        arrays.of_joint,
        arrays.of_view,
        arrays.begin,
        arrays.other,
        arrays.value,
    )
    limb, limb_ends = arrays.limb, arrays.limb_ends
    for e in range(len(person)):
        a, d = person[e], detection[e]
        j, v, total, count = of_joint[d], of_view[d], 0.0, 0
        for n in range(limb[j], limb[j + 1]):
            if own[a, limb_ends[n], v] >= 0:
                count += 1
        if count > 0:
            for n in range(begin[d], begin[d + 1]):
                if own[a, of_joint[other[n]], v] == other[n]:
                    total += value[n]
            total /= count
        mean[e], neighbours[e] = total, count


@kernel("i1 i1 i1 f1 b1 f0 i3 i1", FrameArrays, "f1 f1 b1 f1 i1 i1 i3")
def claim(
    first, person, detection, nearness, lost, least_affinity, own, hypothesis, arrays, tied, score,
    likely, key, queue, taken, chosen,
):  # fmt: skip
    """Fill in the results of `Nearby.claimed`; `key` and `queue` (N,) and `taken` (D,) are
    workspace.
    """
    people, joints, views = chosen.shape
    rank, count = arrays.rank, first[len(first) - 1]
    tie(person[:count], detection[:count], own, arrays, tied, queue)
    for e in range(count):
        neighbours = queue[e]
        # Without detected neighbours the affinities are neutral.
        score[e] = nearness[e] + (tied[e] if neighbours > 0 else LEAST_AFFINITY)
        if lost[e]:
            likely[e] = neighbours > 0 and tied[e] >= least_affinity
        else:
            likely[e] = score[e] >= 2 * LEAST_AFFINITY
        # People grouped by the detector have affinities of exactly 1: ties are broken by rank.
        key[e] = np.rint(score[e] * 1e9) / 1e9 + 1e-10 * rank[detection[e]]
    for a in range(people):
        for j in range(joints):
            for v in range(views):
                chosen[a, j, v] = -1
    for slot in range(len(first) - 1):
        j, v, end = slot // views, slot % views, first[slot]
        while end < first[slot + 1]:  # hypotheses do not compete
            of, length = hypothesis[person[end]], 0
            while end < first[slot + 1] and hypothesis[person[end]] == of:
                if likely[end]:
                    queue[length] = end
                    length += 1
                end += 1
            while length > 0:  # match mutual best pairs, then repeat for the rest
                length = _together(queue, length, person, detection, key, taken, chosen, j, v)


@part
def _together(queue, length, person, detection, key, taken, chosen, j, v):
    """Assign each person's best detection if no better person wants it; returns the number of
    entries left at the front of the `queue`, which is ascending.

    `taken` is the best entry for each detection, -2 if it is assigned.
    """
    for n in range(length):
        taken[detection[queue[n]]] = -1
    for n in range(length):
        e, d = queue[n], detection[queue[n]]
        if taken[d] < 0 or key[e] > key[taken[d]]:
            taken[d] = e
    n = 0
    while n < length:
        a, best = person[queue[n]], queue[n]
        while n < length and person[queue[n]] == a:
            if key[queue[n]] > key[best]:
                best = queue[n]
            n += 1
        if taken[detection[best]] == best:
            chosen[a, j, v] = detection[best]
            taken[detection[best]] = -2
    left = 0
    for n in range(length):
        e = queue[n]
        if chosen[person[e], j, v] < 0 and taken[detection[e]] != -2:
            queue[left] = e
            left += 1
    return left


@kernel("i1 i1 i1 f1 f1 i3")
def share(first, person, detection, distance_m, tied, chosen):
    """Implements `Nearby.share`, with the nearest of each person's detections of a
    joint and view.
    """
    views = chosen.shape[2]
    for slot in range(len(first) - 1):
        j, v, e = slot // views, slot % views, first[slot]
        while e < first[slot + 1]:
            a, nearest = person[e], -1
            while e < first[slot + 1] and person[e] == a:
                on_it = distance_m[e] < OVERLAP_M and tied[e] >= LEAST_AFFINITY
                if on_it and (nearest < 0 or distance_m[e] <= distance_m[nearest]):
                    nearest = e
                e += 1
            if nearest >= 0 and chosen[a, j, v] < 0:
                chosen[a, j, v] = detection[nearest]
