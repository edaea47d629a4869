"""Who gets what: greedy one-to-one matching of whole arrays."""

import numpy as np

from shapepose_fg.core.arrays import Array, Index, Mask, Real, Whole


def lesser(value: Real | Whole) -> Mask:
    """(P, P) whether one has less of `value` (P,) than another; of equal ones the later has."""
    return (value[:, None] < value) | ((value[:, None] == value) & np.tri(len(value), k=-1, dtype=bool))


def match_best_first(left: Index, right: Index, score: Array) -> Index:
    """Greedy one-to-one matching of edges (left, right) by falling score; returns indices of picked edges.

    Edges that are the best of both their ends would be picked before any rival, so all of them are picked in a
    round; a few rounds give the same matching as one edge at a time.
    """
    rank = np.empty(len(score), dtype=np.intp)
    rank[np.argsort(-score, kind="stable")] = np.arange(len(score))
    live = np.arange(len(score))
    picked = []
    ends = max(left.max(initial=-1), right.max(initial=-1)) + 1
    while len(live) > 0:
        best_left = np.full(ends, len(score))
        best_right = np.full(ends, len(score))
        np.minimum.at(best_left, left[live], rank[live])
        np.minimum.at(best_right, right[live], rank[live])
        wins = live[(best_left[left[live]] == rank[live]) & (best_right[right[live]] == rank[live])]
        picked.append(wins)
        used_left = np.zeros(ends, dtype=bool)
        used_right = np.zeros(ends, dtype=bool)
        used_left[left[wins]] = True
        used_right[right[wins]] = True
        live = live[~used_left[left[live]] & ~used_right[right[live]]]
    return np.concatenate(picked) if picked else live
