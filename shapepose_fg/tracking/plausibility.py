"""Which joints cannot be a person's own: those that are farther from their neighbours than any bone is long."""

import numpy as np

from shapepose_fg.core.arrays import Array, Index, Mask
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
    person, joint, parent = np.arange(len(places))[:, None], np.arange(len(skeleton)), np.array(skeleton.parents)
    doubt = 0.1 / (1.0 + views)  # less than any difference of shares of a joint's few bones
    while True:
        judged = trusted & ~torn
        above, allowed_m = _judged_above(judged, longest_m, skeleton)
        bone = above == parent
        apart_m = np.linalg.norm(places - places[person, above], axis=-1)
        long = judged & (above != joint) & (np.nan_to_num(apart_m) > allowed_m + np.where(bone, 0.0, reach_m))
        compared = (judged & bone) | long
        count, too_long = compared.astype(float), long.astype(float)
        for of, those in ((count, compared), (too_long, long)):
            rows, children = np.nonzero(those & bone)
            np.add.at(of, (rows, parent[children]), 1.0)
        share = np.where(too_long > 0, too_long / np.maximum(count, 1.0) + doubt, 0.0)
        rows = np.flatnonzero(share.max(axis=1, initial=0.0) > 0)
        if len(rows) == 0:
            return torn
        torn[rows, share[rows].argmax(axis=1)] = True


def _judged_above(judged: Mask, longest_m: Array, skeleton: Skeleton) -> tuple[Index, Array]:
    """For each joint the nearest `judged` (A, J) one above it, (A, J), and the longest way there, metres.

    Joints with none above them have the first of these, by way of the root; that one has itself.
    """
    count, person = len(skeleton), np.arange(len(judged))[:, None]
    parent = np.array([*skeleton.parents, -1])
    parent[parent < 0] = count  # a place above the root, where every way ends
    longest = np.append(np.where(parent[:count] < count, longest_m, 0.0), 0.0)
    ends = np.append(judged, np.ones((len(judged), 1), dtype=bool), axis=1)
    above, way_m = (np.tile(of[:count], (len(judged), 1)) for of in (parent, longest))
    for _ in skeleton.tree_levels:
        on = ~ends[person, above]
        way_m = way_m + np.where(on, longest[above], 0.0)
        above = np.where(on, parent[above], above)
    top = above == count
    first = (top & judged).argmax(axis=1)[:, None]
    return np.where(top, first, above), way_m + np.where(top, way_m[person, first], 0.0)
