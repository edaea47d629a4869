"""Greedy one-to-one matching on arrays."""

import numpy as np

from shapepose_fg.core.arrays import Array, Index, Mask
from shapepose_fg.core.compiled import kernel


def match_best_first(left: Index, right: Index, score: Array) -> Index:
    """Greedy one-to-one matching of edges (left, right) by descending score; returns indices of the
    chosen edges.

    On a tie the first edge is chosen. Ends are numbered from 0.
    """
    order = np.argsort(-score, kind="stable")
    left, right = (np.require(end, np.intp, ["C", "W"]) for end in (left, right))
    taken = (np.zeros(end.max(initial=-1) + 1, dtype=bool) for end in (left, right))
    return order[: _pick(order, left, right, *taken)]


@kernel("i1 i1 i1 b1 b1")
def _pick(order: Index, left: Index, right: Index, taken_left: Mask, taken_right: Mask) -> int:
    """Move the edges with free ends to the front of `order`, in order; returns their number."""
    count = 0
    for k in range(len(order)):
        edge = order[k]
        if not taken_left[left[edge]] and not taken_right[right[edge]]:
            taken_left[left[edge]] = taken_right[right[edge]] = True
            order[count] = edge
            count += 1
    return count
