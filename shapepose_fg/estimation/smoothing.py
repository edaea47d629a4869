"""Drafts of joints, frame by frame, smoothed over time: what a few frames' wrong detections do not lead away."""

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.estimation.motion_model import MotionModel

Array = NDArray[np.float64]

SPEED_M_S = 1.5
"""How fast a joint is taken to be for the density of its accelerations: a walker's, whose feet are faster."""
LEAST_SIGMA_M = 0.03
"""A draft's error is not new in every frame: its sigma counts twice, and this much is added."""
KERNEL = 6.0
"""A draft whose squared distance from the smoothed joint, in its variances, is this counts half."""
SPEED_SIGMA_M_S = 2.0
"""How fast a joint is, one sigma per axis, before anything is known of it."""
_ROUNDS = 3
_UNKNOWN = 1e6


def smoothed(
    joints: Array, covariance: Array, track: NDArray[np.integer], time_s: Array, motion: MotionModel
) -> tuple[Array, Array]:
    """Draft `joints` (N, J, 3), metres, known to `covariance` (N, J, 3, 3), smoothed along each `track` (N,).

    A Kalman smoother of every joint by itself, alike along all axes, for white-noise acceleration; drafts far from
    it lose weight (Cauchy), and it is run again. `time_s` (N,) seconds. Joints without a draft in some frames are
    carried through these; NaN where a track never has one.
    """
    times, at = np.unique(time_s, return_inverse=True)
    people, who = np.unique(track, return_inverse=True)
    shape = len(times), len(people), joints.shape[1]
    place, variance = np.full((*shape, 3), np.nan), np.full(shape, np.nan)
    place[at, who] = joints
    variance[at, who] = 4 * np.trace(covariance, axis1=-2, axis2=-1) / 3 + LEAST_SIGMA_M**2
    known = np.isfinite(variance) & np.isfinite(place).all(axis=-1)
    place, variance = np.where(known[..., None], place, 0.0), np.where(known, variance, _UNKNOWN)
    psd, weight = motion.psd(np.full(shape[2], SPEED_M_S)), np.ones(shape)
    mean, of_mean = place, variance
    for _ in range(_ROUNDS):
        mean, of_mean = _smooth(place, np.where(known, variance / weight, _UNKNOWN), np.diff(times), psd)
        weight = 1 / (1 + ((place - mean) ** 2).sum(axis=-1) / (of_mean + variance) / KERNEL)
    ever = np.asarray(known.any(axis=0))[who]
    isotropic = of_mean[at, who][..., None, None] * np.eye(3)
    return np.where(ever[..., None], mean[at, who], np.nan), np.where(ever[..., None, None], isotropic, np.nan)


def _smooth(place: Array, variance: Array, steps_s: Array, psd: Array) -> tuple[Array, Array]:
    """Mean (T, A, J, 3) and variance (T, A, J) of positions measured as `place` with `variance`.

    Rauch-Tung-Striebel. A state is position and velocity: p and v are their variances, c their covariance.
    """
    T = len(place)
    x, u = np.zeros_like(place[0]), np.zeros_like(place[0])
    p, c, v = (np.full(variance.shape[1:], start) for start in (_UNKNOWN, 0.0, SPEED_SIGMA_M_S**2))
    kept, predicted = [], []
    for t in range(T):
        if t > 0:
            h = steps_s[t - 1]
            x = x + h * u
            p, c, v = p + 2 * h * c + h**2 * v + psd * h**3 / 3, c + h * v + psd * h**2 / 2, v + psd * h
        predicted.append((x, u, p, c, v))
        total = p + variance[t]
        gain, gain_u = p / total, c / total
        apart = place[t] - x
        x, u = x + gain[..., None] * apart, u + gain_u[..., None] * apart
        p, c, v = p * (1 - gain), c * (1 - gain), v - gain_u * c
        kept.append((x, u, p, c, v))
    means, variances = np.empty_like(place), np.empty_like(variance)
    means[-1], variances[-1] = x, p
    for t in range(T - 2, -1, -1):
        h = steps_s[t]
        x0, u0, p0, c0, v0 = kept[t]
        x1, u1, p1, c1, v1 = predicted[t + 1]
        determinant = p1 * v1 - c1**2
        # G = P F^T S^-1, of position and velocity (rows) upon both of the next frame (columns).
        a, b = p0 + h * c0, c0 + h * v0
        G = (a * v1 - c0 * c1) / determinant, (c0 * p1 - a * c1) / determinant
        H = (b * v1 - v0 * c1) / determinant, (v0 * p1 - b * c1) / determinant
        dx, du, dp, dc, dv = x - x1, u - u1, p - p1, c - c1, v - v1
        x = x0 + G[0][..., None] * dx + G[1][..., None] * du
        u = u0 + H[0][..., None] * dx + H[1][..., None] * du
        p, c, v = (
            p0 + G[0] ** 2 * dp + 2 * G[0] * G[1] * dc + G[1] ** 2 * dv,
            c0 + G[0] * H[0] * dp + (G[0] * H[1] + G[1] * H[0]) * dc + G[1] * H[1] * dv,
            v0 + H[0] ** 2 * dp + 2 * H[0] * H[1] * dc + H[1] ** 2 * dv,
        )
        means[t], variances[t] = x, p
    return means, variances
