"""Who is in each picture: candidates grouped by their part affinities, greedily, as OpenPose does."""

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.detections import Detections


def group_people(found: Detections) -> list[NDArray[np.intp]]:
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
