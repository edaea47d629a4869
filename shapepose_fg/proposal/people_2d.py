"""Who is in each picture: candidates grouped by their part affinities, greedily, as OpenPose does."""

import numpy as np

from shapepose_fg.core.arrays import Index
from shapepose_fg.core.detections import Detections


def without_repeats(found: Detections) -> tuple[Detections, Index]:
    """The detections with what is listed twice listed once, and which of `found` each of them is.

    Some detectors give a person twice, or two people with the same arm: each view saw it once.
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
        found.view[first], found.joint[first], found.xy[first], found.confidence[first], pairs, affinity
    ), first


def group_people(found: Detections) -> list[Index]:
    """Candidates grouped into people, greedily: the rows (N,) of each group, single candidates included.

    As OpenPose does, by the affinities alone: pairs in falling order; a pair joins its two groups unless
    both have a candidate of one kind of joint, so that nobody gets two left knees.
    """
    group = list(range(len(found)))
    members = [[row] for row in group]
    kinds = [1 << joint for joint in found.joint.tolist()]
    for first, second in found.pairs[np.argsort(-found.affinity, kind="stable")].tolist():
        one, other = group[first], group[second]
        if one == other or kinds[one] & kinds[other]:
            continue
        members[one] += members[other]
        kinds[one] |= kinds[other]
        for row in members[other]:
            group[row] = one
    return [np.array(members[one], dtype=np.intp) for one in sorted(set(group))]
