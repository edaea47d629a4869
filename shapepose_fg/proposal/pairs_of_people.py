"""Hypotheses of people from pairs of 2D people in two views: joint rays that intersect."""

from dataclasses import replace

import numpy as np

from shapepose_fg.core.arrays import Array, Index, Mask
from shapepose_fg.core.compiled import kernel
from shapepose_fg.proposal.candidates import PairPoints
from shapepose_fg.proposal.growth import GrowthConfig
from shapepose_fg.proposal.people_2d import LEAST_COMMON, group_people
from shapepose_fg.proposal.possible_people import Frame, PossiblePeople, connected, settled, sizes

SAME_M = 0.2
"""Distance, m, below which joints of two hypotheses are of one person: a pelvis is 20 cm deep."""
_SAME_SHARE = 0.8
"""Share of the smaller hypothesis's joints that must agree for the two to be duplicates."""
_PASSES = 3
"""Number of alternations between assignment of detections and triangulation."""


def pooled(points: PairPoints, free: Mask, frame: Frame) -> PossiblePeople:
    """Hypotheses of people from the `free` (D,) detections, each with all detections that it would
    explain.

    Triangulated joints of two 2D people, in connected parts, give a hypothesis; detections of
    further views are then assigned to it.
    """
    group = _groups(free, frame)
    places, owners = _meeting(points, group, frame)
    part = connected(places, frame)
    hypothesis, first = np.nonzero(sizes(part) >= LEAST_COMMON)
    places = np.where((part[hypothesis] == first[:, None])[..., None], places[hypothesis], np.nan)
    owners, detections = owners[hypothesis], frame.detections
    confidence = np.zeros((group.max(initial=-1) + 1, places.shape[1]))
    grouped = np.flatnonzero(group >= 0)
    np.add.at(
        confidence, (group[grouped], detections.joint[grouped]), detections.confidence[grouped]
    )
    has = np.isfinite(places[..., 0])
    different = _different(places, np.where(has, confidence[owners].sum(axis=1), 0.0).sum(axis=1))
    if len(different) == 0:
        return PossiblePeople.none(frame)
    owners = owners[different]
    owns = (group == owners[:, :1]) | (group == owners[:, 1:])
    person, detection = np.nonzero(owns & has[different][:, detections.joint])
    own = np.full((*places[different].shape[:2], len(frame.rig)), -1, dtype=np.intp)
    own[person, detections.joint[detection], detections.view[detection]] = detection
    return settled(places[different], own, frame, _PASSES)


def _groups(free: Mask, frame: Frame) -> Index:
    """(D,) index of the 2D person of each free detection; -1 for none, or a person with too few
    joints.
    """
    detections = frame.detections
    tied = free[detections.pairs].all(axis=1) & (detections.affinity >= GrowthConfig.doubt)
    tied = replace(detections, pairs=detections.pairs[tied], affinity=detections.affinity[tied])
    group = np.full(len(detections), -1, dtype=np.intp)
    for number, members in enumerate(
        each for each in group_people(tied) if len(each) >= LEAST_COMMON
    ):
        group[members] = number
    return group


def _meeting(points: PairPoints, group: Index, frame: Frame) -> tuple[Array, Index]:
    """Joints (M, J, 3) at which rays of two 2D people intersect, and the two people (M, 2)."""
    count, joints = group.max(initial=-1) + 1, len(frame.skeleton)
    ends = np.sort(group[points.pair], axis=1)
    both = (ends >= 0).all(axis=1)
    pair, place = np.unique(ends[both, 0] * count + ends[both, 1], return_inverse=True)
    owners = np.stack(np.divmod(pair, max(count, 1)), axis=1)
    places = np.full((len(pair), joints, 3), np.nan)
    places[place, points.joint[both]] = points.xyz[both]
    return places, owners


def _different(places: Array, weight: Array) -> Index:
    """Indices of `places` (H, J, 3) without duplicates, in descending order of `weight`."""
    # Ties are broken by position: the order of cameras and detections must not matter.
    order = np.lexsort((*np.nansum(places, axis=1).T, -np.round(weight, 9)))
    # Maximum number of hypotheses per round, those with the highest weight. In simulated
    # crowds of eight with four and six cameras this finds as many people as 256, with a
    # third fewer false positives, in 70 ms instead of 190 ms per frame with six cameras; 32
    # loses people.
    stays = np.empty(64, dtype=np.intp)
    return stays[: _sieve(np.ascontiguousarray(places), order, stays)]


@kernel("f3 i1 i1")
def _sieve(places, order, stays):
    """Fill in the indices that stay, going through `order`, as far as the array reaches; returns
    their number.
    """
    count, least = 0, SAME_M * SAME_M
    for h in order:
        alone = True
        for n in range(count):
            near, known = 0, 0
            for j in range(places.shape[1]):
                squared = 0.0
                for x in range(3):
                    squared += (places[h, j, x] - places[stays[n], j, x]) ** 2
                near += squared < least
                known += np.isfinite(places[h, j, 0])
            if not near < _SAME_SHARE * known:
                alone = False
                break
        if alone:
            stays[count] = h
            count += 1
            if count == len(stays):
                break
    return count
