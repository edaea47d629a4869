"""2D people in each view: candidates grouped greedily by part affinities, as OpenPose does."""

import numpy as np

from shapepose_fg.core.arrays import Index
from shapepose_fg.core.compiled import kernel
from shapepose_fg.core.detections import Detections

LEAST_JOINTS = 4
"""Minimum number of joints that a 2D person must share with a 3D person to match it."""
LEAST_COMMON = 3
"""Minimum number of joints in which two 2D people, of one view or of two, can be compared: two hips
may agree by chance."""


def without_repeats(found: Detections) -> tuple[Detections, Index]:
    """The detections without duplicates, and the index of each in `found`.

    Some detectors give a person twice, or two people with the same arm; a view can see each only
    once.
    """
    places = np.column_stack([found.view, found.joint, found.xy])
    order = np.lexsort((-found.confidence, *places.T))
    new = np.ones(len(order), dtype=bool)
    new[1:] = (places[order][1:] != places[order][:-1]).any(axis=1)
    if new.all():
        return found, np.arange(len(found))
    first = order[new]
    once = np.empty(len(order), dtype=np.intp)
    once[order] = np.cumsum(new) - 1
    pairs, place = np.unique(once[found.pairs], axis=0, return_inverse=True)
    affinity = np.zeros(len(pairs))
    np.maximum.at(affinity, place, found.affinity)
    return Detections(
        found.view[first],
        found.joint[first],
        found.xy[first],
        found.confidence[first],
        pairs,
        affinity,
    ), first


def group_people(found: Detections) -> list[Index]:
    """Group candidates into people, greedily: the rows (N,) of each group, single candidates
    included.

    As OpenPose does, by affinities only: pairs in descending order; a pair joins its two groups
    unless both have a candidate of the same joint, so that no person gets two left knees.
    """
    _, joint, _, pairs, affinity = found.columns
    count = len(found)
    order, stop = np.empty(count, dtype=np.intp), np.empty(count, dtype=np.intp)
    has = np.zeros((count, joint.max(initial=-1) + 1), dtype=bool)
    chains = np.arange(count), np.full(count, -1), np.arange(count)
    groups = _group(pairs[np.argsort(-affinity, kind="stable")], joint, *chains, has, order, stop)
    ends = stop[:groups].tolist()
    return [order[first:end] for first, end in zip([0, *ends], ends, strict=False)]


def whole_people(chosen: Index, found: Detections) -> Index:
    """All detections (N, J, V) of the 2D people that match N 3D people; -1 for none.

    `chosen` (N, J, V) are the detections of the 3D people. A joint is left out if its 3D person has
    a detection of another 2D person, or if another 3D person has its detection. There the grouping
    into 2D people is wrong, not the detector.
    """
    group, groups = np.empty(len(found), dtype=np.intp), group_people(found)
    for number, rows in enumerate(groups):
        group[rows] = number
    whole = np.full(chosen.shape, -1, dtype=np.intp)
    for row, view in np.ndindex(len(chosen), chosen.shape[2]):
        own = chosen[row, :, view]
        number, count = np.unique(group[own[own >= 0]], return_counts=True)
        if count.max(initial=0) >= LEAST_JOINTS:
            rows = groups[number[count.argmax()]]
            whole[row, found.joint[rows], view] = rows
    taken = np.bincount(chosen[chosen >= 0], minlength=len(found) + 1)
    excluded = np.where(chosen == whole, taken[whole] > 1, (taken[whole] > 0) | (chosen >= 0))
    return np.where(excluded, -1, whole)


@kernel("i2 i1 i1 i1 i1 b2 i1 i1")
def _group(pairs, joint, group, after, last, has, order, stop):
    """Implements `group_people`: writes the groups, concatenated, into `order` (N,), their ends
    into `stop`; returns their number.

    At the start each candidate is its own `group` (N,) and its `last` (N,), `after` (N,) is -1, and
    `has` (N, J), the joints of each group, is False.
    """
    count = len(joint)
    for row in range(count):
        has[row, joint[row]] = True
    for pair in range(len(pairs)):
        one, other = group[pairs[pair, 0]], group[pairs[pair, 1]]
        row, separate = other, one != other
        while separate and row >= 0:
            separate = not has[one, joint[row]]
            row = after[row]
        if separate:
            row = other
            while row >= 0:
                group[row], has[one, joint[row]] = one, True
                row = after[row]
            after[last[one]], last[one] = other, last[other]
    place, groups = 0, 0
    for first in range(count):
        row = first if group[first] == first else -1
        while row >= 0:
            order[place] = row
            place, row = place + 1, after[row]
        if group[first] == first:
            stop[groups] = place
            groups += 1
    return groups
