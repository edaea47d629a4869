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
    seen = np.ascontiguousarray(detections.xy), weight, config.scatter(names)
    _measure(mean, covariance, at, candidate, *seen, rig.K @ rig.cTw, rig.focal_px, numbers, inlier)
    return JointStates(mean, covariance), inlier


@kernel
def _measure(mean, covariance, at, candidate, xy, confident, scatter, P, focal, numbers, inlier):
    """Update `mean` (A, J, S) and `covariance` (A, J, S, S) by views `P` (V, 3, 4), pixels from the world."""
    sigma_m, floor_rad, rho_m, fixed_m = numbers[0], numbers[1], numbers[2], numbers[3]
    shape, wide, nearest_m = int(numbers[4]), numbers[5], numbers[6]
    people, joints, views = candidate.shape
    size = mean.shape[2]
    mean_depth, sigma = np.empty(views), np.empty(views)
    L, g, place, pull, A = np.empty((3, 3)), np.empty(3), np.empty(3), np.empty(3), np.empty((2, 3))
    M, gain, information = np.empty((3, 3)), np.empty((size, 3)), np.empty((size, 3))
    for a in range(people):
        for v in range(views):
            total, count = 0.0, 0
            for j in range(joints):
                depth = _along(P[v, 2], mean[a, j])
                if depth >= nearest_m:
                    total, count = total + depth, count + 1
            mean_depth[v] = max(total / max(count, 1), nearest_m)
        for j in range(joints):
            seen = False
            for v in range(views):
                d = candidate[a, j, v]
                sigma[v] = 0.0
                if d >= 0 and confident[d] > 0:
                    depth = _along(P[v, 2], mean[a, j])
                    depth = fixed_m if fixed_m > 0 else depth if depth >= nearest_m else mean_depth[v]
                    px = np.hypot(floor_rad * focal[v], sigma_m * focal[v] / depth)
                    sigma[v] = px * scatter[j] / np.sqrt(confident[d])
                    seen = True
            if not seen:
                continue
            place[:] = at[a, j]
            for _ in range(_ITERATIONS):
                L[:], g[:] = 0.0, 0.0
                for v in range(views):
                    inlier[a, j, v] = False
                    depth = _along(P[v, 2], place)
                    if sigma[v] == 0 or not depth >= nearest_m:
                        continue
                    d = candidate[a, j, v]
                    x, y = _along(P[v, 0], place) / depth, _along(P[v, 1], place) / depth
                    rx, ry = x - xy[d, 0], y - xy[d, 1]
                    off = np.hypot(rx, ry)
                    if not off < rho_m * focal[v] / (fixed_m if fixed_m > 0 else depth):
                        continue
                    inlier[a, j, v] = True
                    weight = _weight(shape, off / sigma[v] / wide) / sigma[v] ** 2
                    for i in range(3):
                        A[0, i] = (P[v, 0, i] - x * P[v, 2, i]) / depth
                        A[1, i] = (P[v, 1, i] - y * P[v, 2, i]) / depth
                    for i in range(3):
                        g[i] += weight * (A[0, i] * rx + A[1, i] * ry)
                        for k in range(3):
                            L[i, k] += weight * (A[0, i] * A[0, k] + A[1, i] * A[1, k])
                for i in range(3):
                    pull[i] = -g[i]
                    for k in range(3):
                        pull[i] += L[i, k] * (place[k] - mean[a, j, k])
                # The gain P (1 + L P)^-1 needs no inverse of L, which is singular where one view sees the joint.
                for i in range(3):
                    for k in range(3):
                        M[i, k] = 1.0 if i == k else 0.0
                        for m in range(3):
                            M[i, k] += L[i, m] * covariance[a, j, m, k]
                _invert(M)
                for i in range(size):
                    for k in range(3):
                        gain[i, k] = 0.0
                        for m in range(3):
                            gain[i, k] += covariance[a, j, i, m] * M[m, k]
                for i in range(3):
                    place[i] = mean[a, j, i]
                    for k in range(3):
                        place[i] += gain[i, k] * pull[k]
            for i in range(size):
                for k in range(3):
                    mean[a, j, i] += gain[i, k] * pull[k]
                    information[i, k] = 0.0
                    for m in range(3):
                        information[i, k] += gain[i, m] * L[m, k]
            _lessen(covariance[a, j], information)


@kernel
def _along(row, place):
    """A row (4,) of a projection times a place (3,), in the world."""
    return row[0] * place[0] + row[1] * place[1] + row[2] * place[2] + row[3]


@kernel
def _weight(shape, ratio):
    """What a robust kernel leaves of a residual of `ratio` times its width (`factors.kernel_weight`)."""
    if shape == 0:
        return 1.0
    if shape == 1:
        return 1.0 / max(ratio, 1.0)
    if shape == 2:
        return 1.0 / (1.0 + ratio * ratio)
    if shape == 3:
        return 1.0 / (1.0 + ratio * ratio) ** 2
    return max(1.0 - ratio * ratio, 0.0) ** 2


@kernel
def _invert(M):
    """The inverse of a matrix (3, 3), in its place."""
    a, b, c, d, e, f, g, h, i = M[0, 0], M[0, 1], M[0, 2], M[1, 0], M[1, 1], M[1, 2], M[2, 0], M[2, 1], M[2, 2]
    first, second, third = e * i - f * h, f * g - d * i, d * h - e * g
    over = 1.0 / (a * first + b * second + c * third)
    M[0, 0], M[0, 1], M[0, 2] = first * over, (c * h - b * i) * over, (b * f - c * e) * over
    M[1, 0], M[1, 1], M[1, 2] = second * over, (a * i - c * g) * over, (c * d - a * f) * over
    M[2, 0], M[2, 1], M[2, 2] = third * over, (b * g - a * h) * over, (a * e - b * d) * over


@kernel
def _lessen(P, told):
    """Take `told` (S, 3) times the first three rows of a covariance (S, S) from it; it stays symmetric."""
    size = len(P)
    top = P[:3].copy()
    for i in range(size):
        for k in range(size):
            for m in range(3):
                P[i, k] -= told[i, m] * top[m, k]
    for i in range(size):
        for k in range(i):
            P[i, k] = P[k, i] = (P[i, k] + P[k, i]) / 2
