"""Poses of all cameras from relative poses of pairs: best spanning tree by agreement, then a pose
graph.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import gtsam
import numpy as np
from gtsam.symbol_shorthand import X
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from factors.noise import gaussian, robust_kernel
from shapepose_fg.calibration.relative import Relative
from shapepose_fg.core.arrays import Array
from shapepose_fg.core.decompositions import rigid
from shapepose_fg.setup_check.fit import difference

_TREES = 100
"""Number of spanning trees that are tried: the best, and random ones weighted by the scores of
pairs."""
_AGREE_DEG = 8.0
"""Deviation within which a pair agrees, degrees: right pairs are off by 0.3 to 4 in simulated
recordings and on Shelf."""
_LEAST, _LENGTH = np.radians(0.3), 0.1
"""Minimum standard deviation of a pair's rotation and direction, rad, and of its length, as a
share."""


@dataclass(frozen=True)
class Edge:
    """The relative pose of two cameras, in metres if people have the assumed stature."""

    bTa: Array
    """(4, 4) the second camera's frame from the first's."""
    score: float
    """Score of the pair (`Relative.score`)."""
    covariance: Array
    """(6, 6) covariance of bTa in GTSAM's tangent, in the first camera's frame: rotation, rad, then
    translation, m."""

    @classmethod
    def of(cls, pair: Relative, metres: float) -> "Edge":
        """Edge of a pair whose cameras are `metres` apart."""
        bTa = rigid(pair.R, metres * pair.t)
        way = pair.t / np.linalg.norm(pair.t)
        covariance = pair.covariance + _LEAST**2 * np.diag(np.r_[1.0, 1, 1, 0, 0, 0])
        covariance[3:, 3:] += _LEAST**2 * (np.eye(3) - np.outer(way, way)) + _LENGTH**2 * np.outer(
            way, way
        )
        to = np.kron(np.diag([1.0, metres]), pair.R.T)
        return cls(bTa, pair.score, to @ covariance @ to.T)


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
    return _together(best, edges)


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


def _together(poses: Array, edges: Mapping[tuple[int, int], Edge]) -> Array:
    """Poses refined by a pose graph of all pairs, with a robust kernel (Cauchy)."""
    graph, values, kernel = gtsam.NonlinearFactorGraph(), gtsam.Values(), robust_kernel("cauchy")
    for view, pose in enumerate(poses):
        values.insert(X(view), gtsam.Pose3(pose))
    for (a, b), edge in edges.items():
        noise = gaussian((edge.covariance + edge.covariance.T) / 2, kernel)
        graph.add(gtsam.BetweenFactorPose3(X(b), X(a), gtsam.Pose3(edge.bTa), noise))
    graph.addPriorPose3(X(0), gtsam.Pose3(poses[0]), gtsam.noiseModel.Isotropic.Sigma(6, 1e-4))
    found = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    return np.stack([found.atPose3(X(view)).matrix() for view in range(len(poses))])


def parts(pairs: Mapping[tuple[int, int], object], views: int) -> list[list[int]]:
    """The connected components of cameras under `pairs`, the largest first."""
    ends = np.array(list(pairs), dtype=np.intp).reshape(-1, 2).T
    count, part = connected_components(
        coo_array((np.ones(ends.shape[1]), tuple(ends)), shape=(views, views))
    )
    return sorted((np.flatnonzero(part == n).tolist() for n in range(count)), key=len, reverse=True)
