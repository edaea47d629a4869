"""Which joints cannot be a person's own: those that are farther from their neighbours than any bone is long."""

import numpy as np

from shapepose_fg.core.arrays import Array, Index, Mask
from shapepose_fg.core.compiled import kernel
from shapepose_fg.core.skeleton import Skeleton


def torn_joints(
    places: Array, trusted: Mask, views: Index, longest_m: Array, skeleton: Skeleton, reach_m: float
) -> Mask:
    """(A, J) joints without which no bone of a person is longer than `longest_m` (J,), from each joint's parent.

    `places` (A, J, 3); only joints that are `trusted` (A, J) are judged. Of two ends of a bone the one goes of
    which the larger share of bones is too long, of equals the one that fewer `views` (A, J) see; and so on until
    nothing is too long.

    A joint whose parent is not judged is judged by the next such joint above it, with the bones between added up;
    where there is none, by the first of the person: legs below a pelvis that nobody sees may be another's. It goes
    where it is `reach_m` farther than bones are long: nearer, whole bodies put it right.
    """
    torn = np.zeros(trusted.shape, dtype=bool)
    _tear(np.ascontiguousarray(places), trusted, views, longest_m, np.array(skeleton.parents), reach_m, torn)
    return torn


@kernel
def _tear(places, trusted, views, longest_m, parents, reach_m, torn):
    """Fill in `torn` (A, J)."""
    people, joints = trusted.shape
    above, way_m = np.empty(joints, dtype=np.intp), np.empty(joints)
    count, too_long = np.empty(joints), np.empty(joints)
    for a in range(people):
        worst = 0
        while worst >= 0:
            judged = trusted[a] & ~torn[a]
            _judged_above(judged, longest_m, parents, above, way_m)
            count[:], too_long[:] = 0.0, 0.0
            for j in range(joints):
                if not judged[j] or above[j] == j:
                    continue
                bone, squared = above[j] == parents[j], 0.0
                for x in range(3):
                    squared += (places[a, j, x] - places[a, above[j], x]) ** 2
                long = np.sqrt(squared) > way_m[j] + (0.0 if bone else reach_m)
                if bone or long:
                    count[j] += 1.0
                    too_long[j] += 1.0 if long else 0.0
                if bone:
                    count[parents[j]] += 1.0
                    too_long[parents[j]] += 1.0 if long else 0.0
            worst, most = -1, 0.0
            for j in range(joints):
                if too_long[j] > 0:
                    # The doubt is less than any difference of shares of a joint's few bones.
                    share = too_long[j] / count[j] + 0.1 / (1.0 + views[a, j])
                    if share > most:
                        worst, most = j, share
            if worst >= 0:
                torn[a, worst] = True


@kernel
def _judged_above(judged, longest_m, parents, above, way_m):
    """For each joint the nearest `judged` (J,) one above it, (J,), and the longest way there, metres (J,).

    Joints with none above them have the first of these, by way of the root; that one has itself.
    """
    first = -1
    for j in range(len(judged)):
        above[j], way_m[j] = parents[j], longest_m[j] if parents[j] >= 0 else 0.0
        while above[j] >= 0 and not judged[above[j]]:
            if parents[above[j]] >= 0:
                way_m[j] += longest_m[above[j]]
            above[j] = parents[above[j]]
        if above[j] < 0 and judged[j] and first < 0:
            first = j
    top_m = way_m[first]
    for j in range(len(judged)):
        if above[j] < 0:
            above[j] = first
            way_m[j] += top_m
