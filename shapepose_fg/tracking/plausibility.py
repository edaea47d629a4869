"""Which joints cannot be a person's own: those that are farther from their neighbours than any bone is long."""

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.skeleton import Skeleton


def torn_joints(
    places: NDArray[np.float64],
    trusted: NDArray[np.bool_],
    views: NDArray[np.intp],
    longest_m: NDArray[np.float64],
    skeleton: Skeleton,
) -> NDArray[np.bool_]:
    """(A, J) joints without which no bone of a person is longer than `longest_m` (J,), from each joint's parent.

    `places` (A, J, 3); only joints that are `trusted` (A, J) are judged. The joint of which the larger share of
    bones is too long is taken first, of equals the one that fewer `views` (A, J) see, until nothing is too long.
    """
    child = np.flatnonzero(np.array(skeleton.parents) >= 0)
    parent = np.array(skeleton.parents)[child]
    length = np.linalg.norm(places[:, child] - places[:, parent], axis=-1)
    long = np.nan_to_num(length) > longest_m[child]
    torn = np.zeros(trusted.shape, dtype=bool)
    ends = np.zeros((len(child), len(skeleton)))
    ends[np.arange(len(child)), child] = ends[np.arange(len(child)), parent] = 1.0
    doubt = 0.1 / (1.0 + views)  # less than any difference of shares of a joint's few bones
    while True:
        judged = trusted & ~torn
        both = judged[:, child] & judged[:, parent]
        too_long = (both & long) @ ends
        share = np.where(too_long > 0, too_long / np.maximum(both @ ends, 1.0) + doubt, 0.0)
        rows = np.flatnonzero(share.max(axis=1, initial=0.0) > 0)
        if len(rows) == 0:
            return torn
        torn[rows, share[rows].argmax(axis=1)] = True
