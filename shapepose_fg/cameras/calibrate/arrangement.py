"""Approximate poses of all cameras from relative poses of pairs: the spanning tree that most pairs
agree with.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from shapepose_fg.cameras.parameters import difference
from shapepose_fg.core.arrays import Array

_TREES = 100
"""Number of spanning trees that are tried: the best, and random ones weighted by the scores of
pairs."""
_AGREE_DEG = 8.0
"""Deviation within which a pair agrees, degrees: right pairs are off by 0.3 to 4 in simulated
recordings and on Shelf."""


@dataclass(frozen=True)
class Edge:
    """The relative pose of two cameras, in metres if people have the assumed stature."""

    bTa: Array
    """(4, 4) the second camera's frame from the first's."""
    score: float
    """Score of the pair (`Relative.score`)."""


def arranged(edges: Mapping[tuple[int, int], Edge], views: int) -> Array:
    """(V, 4, 4) poses in the frame of the first camera, for `edges` that connect all cameras."""
    rng, best, most = np.random.default_rng(0), np.zeros((0,)), -np.inf
    for trial in range(_TREES):
        luck = rng.gumbel(size=len(edges)) if trial > 0 else np.zeros(len(edges))
        order = sorted(
            zip(edges, luck.tolist(), strict=True),
            key=lambda each: -edges[each[0]].score - 0.15 * each[1],
        )
        poses = _tree([pair for pair, _ in order], edges, views)
        if (agree := agreement(poses, edges)) > most:
            best, most = poses, agree
    return best


def agreement(poses: Array, edges: Mapping[tuple[int, int], Edge]) -> float:
    """Agreement of poses (V, 4, 4) with all pairs: the sum of the scores of agreeing pairs."""
    return float(sum(edge.score * _alike(poses, *pair, edge) for pair, edge in edges.items()))


def _alike(poses: Array, a: int, b: int, edge: Edge) -> float:
    """Agreement of a pair's poses with its edge, from 1 if equal to 0 if far apart."""
    bTa = np.linalg.solve(poses[b], poses[a])
    turn, _ = difference(bTa[:3], edge.bTa[:3])
    ways = [each[:3, 3] / np.linalg.norm(each[:3, 3]) for each in (bTa, edge.bTa)]
    way = np.degrees(np.arccos(np.clip(ways[0] @ ways[1], -1.0, 1.0)))
    return float(np.exp(-0.5 * (turn**2 + way**2) / _AGREE_DEG**2))


def _tree(order: list[tuple[int, int]], edges: Mapping[tuple[int, int], Edge], views: int) -> Array:
    """Poses along the first edges in `order` that close no loop."""
    poses, found = np.tile(np.eye(4), (views, 1, 1)), {0}
    while len(found) < views:
        a, b = next(pair for pair in order if (pair[0] in found) != (pair[1] in found))
        if a in found:
            poses[b] = poses[a] @ np.linalg.inv(edges[a, b].bTa)
        else:
            poses[a] = poses[b] @ edges[a, b].bTa
        found |= {a, b}
    return poses


def parts(pairs: Mapping[tuple[int, int], object], views: int) -> list[list[int]]:
    """The connected components of cameras under `pairs`, the largest first."""
    ends = np.array(list(pairs), dtype=np.intp).reshape(-1, 2).T
    count, part = connected_components(
        coo_array((np.ones(ends.shape[1]), tuple(ends)), shape=(views, views))
    )
    return sorted((np.flatnonzero(part == n).tolist() for n in range(count)), key=len, reverse=True)
