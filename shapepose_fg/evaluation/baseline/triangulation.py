"""Joints from a person's views, some of which are wrong: the best pair of views, and all that agree with it."""

from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.camera import Rig

Array = NDArray[np.float64]

_REFINEMENTS = 3
_MIN_DEPTH_M = 0.2


def triangulate_robustly(
    xy: Array, confidence: Array, rig: Rig, gate_m: float, min_views: int
) -> tuple[Array, NDArray[np.bool_]]:
    """Joints (P, J, 3), metres, from `xy` (P, J, V, 2) with `confidence` (P, J, V), 0 where a view lacks one.

    Every pair of views is tried; a view agrees with its point within `gate_m` at the point's depth. The pair with
    the greatest sum of confidence times (1 - squared distance over squared gate) wins (MSAC: Torr and Zisserman
    2000), and the point is refined by least squares over the views that agree. Returns also which views do
    (P, J, V); NaN where they are fewer than `min_views`.
    """
    P, J, V = confidence.shape
    view = np.tile(np.arange(V), P * J)
    normalised = rig.normalise(view, xy.reshape(-1, 2)).reshape(P, J, V, 2)
    equations = normalised[..., None] * rig.cTw[:, 2:3, :] - rig.cTw[:, :2, :]  # (P, J, V, 2, 4)
    seen = confidence > 0
    pairs = np.array(list(combinations(range(V), 2)))
    points = _points(equations[:, :, pairs], np.ones((P, J, len(pairs), 2)))  # (P, J, M, 3)
    score = _agreement(points, normalised[:, :, None], confidence[:, :, None], rig, gate_m)
    score = np.where(seen[:, :, pairs].all(axis=-1), score.sum(axis=-1), -1.0)
    best = score.argmax(axis=-1)
    point = np.take_along_axis(points, best[..., None, None], axis=2)[:, :, 0]
    agree = np.zeros(confidence.shape, dtype=bool)
    for _ in range(_REFINEMENTS):
        weight = _agreement(point, normalised, confidence, rig, gate_m)
        agree = weight > 0
        depth = np.einsum("vi,pji->pjv", rig.cTw[:, 2, :3], point) + rig.cTw[:, 2, 3]
        weight = np.where(agree, confidence, 0.0) / np.maximum(depth, _MIN_DEPTH_M) ** 2
        enough = agree.sum(axis=-1) >= 2
        point = np.where(enough[..., None], _points(equations, weight), point)
    placed = (agree.sum(axis=-1) >= min_views) & np.isfinite(point).all(axis=-1)
    return np.where(placed[..., None], point, np.nan), agree & placed[..., None]


def _points(equations: Array, weight: Array) -> Array:
    """(..., 3) the points that solve `equations` (..., V, 2, 4) best, each view with its `weight` (..., V)."""
    A = np.einsum("...v,...vki,...vkj->...ij", weight, equations, equations)
    damping = 1e-9 * (1e-12 + np.trace(A[..., :3, :3], axis1=-2, axis2=-1))[..., None, None] * np.eye(3)
    return np.linalg.solve(A[..., :3, :3] + damping, -A[..., :3, 3:])[..., 0]


def _agreement(points: Array, normalised: Array, confidence: Array, rig: Rig, gate_m: float) -> Array:
    """(..., V) confidence times (1 - squared distance over squared gate), 0 beyond the gate and behind cameras."""
    camera = np.einsum("vij,...j->...vi", rig.cTw[:, :, :3], points) + rig.cTw[:, :, 3]
    squared = np.sum((camera[..., :2] - normalised * camera[..., 2:]) ** 2, axis=-1) / gate_m**2
    return confidence * np.where(camera[..., 2] > _MIN_DEPTH_M, np.maximum(0.0, 1.0 - squared), 0.0)
