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
    torn, joints = np.zeros(trusted.shape, dtype=bool), len(skeleton)
    room = np.empty(joints, dtype=np.intp), np.empty(joints), np.empty(joints), np.empty(joints)
    _tear(
        np.ascontiguousarray(places), trusted, views, longest_m, np.array(skeleton.parents), reach_m, *room, torn
    )
    return torn


@kernel
def _tear(places, trusted, views, longest_m, parents, reach_m, above, way_m, count, too_long, torn):
    """Fill in `torn` (A, J); the four arrays (J,) before it are room to work in."""
    people, joints = trusted.shape
    for a in range(people):
        worst = 0
        while worst >= 0:
            _judged_above(trusted[a], torn[a], longest_m, parents, above, way_m, count, too_long)
            for j in range(joints):
                i = above[j]
                if i == j or not trusted[a, j] or torn[a, j]:
                    continue
                bone, squared = i == parents[j], 0.0
                for x in range(3):
                    squared += (places[a, j, x] - places[a, i, x]) ** 2
                long = np.sqrt(squared) > way_m[j] + (0.0 if bone else reach_m)
                if bone or long:
                    count[j] += 1
                    too_long[j] += long
                if bone:
                    count[i] += 1
                    too_long[i] += long
            worst, most = -1, 0.0
            for j in range(joints):
                # The doubt is less than any difference of shares of a joint's few bones.
                share = too_long[j] / count[j] + 0.1 / (1.0 + views[a, j])
                if too_long[j] > 0 and share > most:
                    worst, most = j, share
            if worst >= 0:
                torn[a, worst] = True


@kernel
def _judged_above(trusted, torn, longest_m, parents, above, way_m, count, too_long):
    """For each joint the nearest one `above` (J,) it that is judged, and the longest way there, metres (J,).

    Joints with none above them have the first of these, by way of the root; that one has itself.
    """
    first, top_m = -1, 0.0
    for j in range(len(parents)):
        above[j], way_m[j], count[j], too_long[j] = j, 0.0, 0.0, 0.0
        while above[j] >= 0 and (above[j] == j or not trusted[above[j]] or torn[above[j]]):
            if parents[above[j]] >= 0:
                way_m[j] += longest_m[above[j]]
            above[j] = parents[above[j]]
        if above[j] < 0 and first < 0 and trusted[j] and not torn[j]:
            first, top_m = j, way_m[j]
    for j in range(len(parents)):
        if above[j] < 0:
            above[j] = first
            way_m[j] += top_m
