"""Joints of people after a frame, by the detections that are theirs: Kalman's update, linearised anew in turn."""

import numpy as np

from factors import DEFAULT_WIDTH_SIGMA
from shapepose_fg.core.arrays import Index, Mask
from shapepose_fg.core.camera import Rig, Views
from shapepose_fg.core.compiled import kernel
from shapepose_fg.core.detections import Detections
from shapepose_fg.core.observations import Observations
from shapepose_fg.estimation.linearisation import MIN_DEPTH_M, ObservationConfig, triangulate
from shapepose_fg.tracking.motion_filter import JointStates

_ITERATIONS = 3
"""How often gates and linearisation are made anew in one frame."""
_KERNELS = ("none", "huber", "cauchy", "geman_mcclure", "tukey")
"""Robust kernels, by the number that stands for them in `_weight`."""


def measured(
    joints: JointStates,
    lost: Mask,
    candidate: Index,
    detections: Detections,
    rig: Rig,
    config: ObservationConfig,
    names: tuple[str, ...],
) -> tuple[JointStates, Mask]:
    """A people's joints, of these `names`, after a frame in which they have the detections `candidate` (A, J, V),
    -1 for none; and which of these (A, J, V) are within the gate.

    It is what `observation_sigmas` and `linearise` say at the joints, as the measurement of a Kalman filter.
    Joints that are `lost` (A, J) begin where the views put them, if two or more do.
    """
    at = joints.position.copy()
    unplaced = lost & ((candidate >= 0).sum(axis=-1) >= 2)
    rows = np.flatnonzero(unplaced.any(axis=1))
    if len(rows) > 0:
        begin = np.where(unplaced[rows][..., None], np.nan, at[rows])
        placed = triangulate(Observations.of(candidate[rows], detections, begin), Views.of(rig), config)
        at[rows] = np.where(np.isfinite(placed), placed, at[rows])
    weight = np.where(detections.confidence > 0, config.weight(detections.confidence), 0.0)
    wide = DEFAULT_WIDTH_SIGMA.get(config.kernel, 1.0)
    sigma, gate = (config.sigma_m, config.floor_rad), (config.rho_2d_m, config.fixed_depth_m)
    numbers = np.array([*sigma, *gate, _KERNELS.index(config.kernel), wide, MIN_DEPTH_M])
    mean, covariance = joints.mean.copy(), joints.covariance.copy()
    inlier = np.zeros(candidate.shape, dtype=bool)
    seen = detections.columns[2], weight, config.scatter(names)
    _measure(mean, covariance, at, candidate, *seen, rig.K @ rig.cTw, rig.focal_px, numbers, inlier)
    return JointStates(mean, covariance), inlier


@kernel
def _measure(mean, covariance, at, candidate, xy, confident, scatter, P, focal, numbers, inlier):
    """Update `mean` (A, J, S) and `covariance` (A, J, S, S) by views `P` (V, 3, 4), pixels from the world."""
    sigma_m, floor_rad, nearest_m = numbers[0], numbers[1], numbers[6]
    people, joints, views = candidate.shape
    sigma, depths = np.empty(views), np.empty(views)
    L, g, M, gain = np.empty((3, 3)), np.empty(3), np.empty((3, 3)), np.empty((3, mean.shape[2], 3))
    for a in range(people):
        for v in range(views):
            depths[v] = _mean_depth(mean[a], P[v, 2], nearest_m)
        for j in range(joints):
            seen = False
            for v in range(views):
                d, sigma[v] = candidate[a, j, v], 0.0
                if d >= 0 and confident[d] > 0:
                    depth = _along(P[v, 2], mean[a, j])
                    depth = numbers[3] if numbers[3] > 0 else depth if depth >= nearest_m else depths[v]
                    px = np.sqrt((floor_rad * focal[v]) ** 2 + (sigma_m * focal[v] / depth) ** 2)
                    sigma[v], seen = px * scatter[j] / np.sqrt(confident[d]), True
            if seen:
                for _ in range(_ITERATIONS):
                    _linearise(at[a, j], candidate[a, j], xy, sigma, P, focal, numbers, L, g, inlier[a, j])
                    _move(mean[a, j], covariance[a, j], at[a, j], L, g, M, gain)
                _update(mean[a, j], covariance[a, j], L, M, gain)


@kernel
def _along(row, place):
    """A row (4,) of a projection times a place (3,), in the world."""
    return row[0] * place[0] + row[1] * place[1] + row[2] * place[2] + row[3]


@kernel
def _mean_depth(mean, row, nearest_m):
    """Of the joints in front of a view."""
    total, count = 0.0, 0
    for j in range(len(mean)):
        depth = _along(row, mean[j])
        if depth >= nearest_m:
            total += depth
            count += 1
    return total / count if count > 0 else nearest_m


@kernel
def _linearise(place, candidate, xy, sigma, P, focal, numbers, L, g, inlier):
    """Sum up what views say of a joint at `place`: information L (3, 3) and gradient g (3,)."""
    for i in range(3):
        g[i] = L[i, 0] = L[i, 1] = L[i, 2] = 0.0
    for v in range(len(P)):
        depth, d = _along(P[v, 2], place), candidate[v]
        inlier[v] = False
        if sigma[v] == 0 or not depth >= numbers[6]:
            continue
        x, y = _along(P[v, 0], place) / depth, _along(P[v, 1], place) / depth
        to_x, to_y = x - xy[d, 0], y - xy[d, 1]
        off = np.sqrt(to_x * to_x + to_y * to_y)
        if not off < numbers[2] * focal[v] / (numbers[3] if numbers[3] > 0 else depth):
            continue
        inlier[v] = True
        weight = _weight(numbers[4], off / sigma[v] / numbers[5]) / (sigma[v] * depth) ** 2
        for i in range(3):
            dx, dy = P[v, 0, i] - x * P[v, 2, i], P[v, 1, i] - y * P[v, 2, i]
            g[i] += weight * depth * (dx * to_x + dy * to_y)
            for k in range(3):
                L[i, k] += weight * (dx * (P[v, 0, k] - x * P[v, 2, k]) + dy * (P[v, 1, k] - y * P[v, 2, k]))


@kernel
def _weight(shape, ratio):
    """What a robust kernel leaves of a residual of `ratio` times its width (`factors.kernel_weight`)."""
    squared = ratio * ratio
    if shape == 0 or (shape == 1 and squared <= 1):
        return 1.0
    if shape == 1:
        return 1.0 / ratio
    if shape == 2:
        return 1.0 / (1.0 + squared)
    if shape == 3:
        return 1.0 / (1.0 + squared) ** 2
    return (1.0 - squared) ** 2 if squared < 1 else 0.0


@kernel
def _move(mean, P, place, L, g, M, gain):
    """Put `place` where a joint is after the measurement, by the gain P (1 + L P)^-1.

    It needs no inverse of L, which is singular where one view sees the joint. What pulls is left in `M[0]`.
    """
    for i in range(3):
        for k in range(3):
            M[i, k] = L[i, 0] * P[0, k] + L[i, 1] * P[1, k] + L[i, 2] * P[2, k] + (1.0 if i == k else 0.0)
    _invert(M)
    for i in range(len(mean)):
        for k in range(3):
            gain[0, i, k] = P[i, 0] * M[0, k] + P[i, 1] * M[1, k] + P[i, 2] * M[2, k]
    x, y, z = place[0] - mean[0], place[1] - mean[1], place[2] - mean[2]
    for i in range(3):
        M[0, i] = L[i, 0] * x + L[i, 1] * y + L[i, 2] * z - g[i]
    for i in range(3):
        place[i] = mean[i] + gain[0, i, 0] * M[0, 0] + gain[0, i, 1] * M[0, 1] + gain[0, i, 2] * M[0, 2]


@kernel
def _update(mean, P, L, M, gain):
    """A joint's state after `_move`: P less (gain L) P, symmetric."""
    for i in range(len(mean)):
        mean[i] += gain[0, i, 0] * M[0, 0] + gain[0, i, 1] * M[0, 1] + gain[0, i, 2] * M[0, 2]
        for k in range(3):
            gain[1, i, k] = gain[0, i, 0] * L[0, k] + gain[0, i, 1] * L[1, k] + gain[0, i, 2] * L[2, k]
            gain[2, i, k] = P[i, k]
    for i in range(len(mean)):
        for k in range(i + 1):
            less = 0.0
            for m in range(3):
                less += gain[1, i, m] * gain[2, k, m] + gain[1, k, m] * gain[2, i, m]
            P[i, k] -= less / 2
            P[k, i] = P[i, k]


@kernel
def _invert(M):
    """The inverse of a matrix (3, 3), in its place."""
    a, b, c, d, e, f, g, h, i = M[0, 0], M[0, 1], M[0, 2], M[1, 0], M[1, 1], M[1, 2], M[2, 0], M[2, 1], M[2, 2]
    first, second, third = e * i - f * h, f * g - d * i, d * h - e * g
    over = 1.0 / (a * first + b * second + c * third)
    M[0, 0], M[0, 1], M[0, 2] = first * over, (c * h - b * i) * over, (b * f - c * e) * over
    M[1, 0], M[1, 1], M[1, 2] = second * over, (a * i - c * g) * over, (c * d - a * f) * over
    M[2, 0], M[2, 1], M[2, 2] = third * over, (b * g - a * h) * over, (a * e - b * d) * over
