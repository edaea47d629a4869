"""Drafts of joints, frame by frame, smoothed over time: what a few frames' wrong detections do not lead away."""

import numpy as np

from shapepose_fg.core.arrays import Array, Whole
from shapepose_fg.core.compiled import kernel
from shapepose_fg.estimation.kernels import ready
from shapepose_fg.estimation.motion_model import MotionModel

SPEED_M_S = 1.5
"""How fast a joint is taken to be for the density of its accelerations: a walker's, whose feet are faster."""
LEAST_SIGMA_M = 0.03
"""A draft's error is not new in every frame: its sigma counts twice, and this much is added."""
KERNEL = 6.0
"""A draft whose squared distance from the smoothed joint, in its variances, is this counts half."""
_ROUNDS = 3
_UNKNOWN = 1e6


def smoothed(
    joints: Array, covariance: Array, track: Whole, time_s: Array, motion: MotionModel
) -> tuple[Array, Array]:
    """Draft `joints` (N, J, 3), metres, known to `covariance` (N, J, 3, 3), smoothed along each `track` (N,).

    A Kalman smoother of every joint by itself, alike along all axes; drafts far from it lose weight (Cauchy), and
    it is run again. `time_s` (N,) seconds. Joints without a draft in some frames are
    carried through these; NaN where a track never has one.
    """
    times, at = np.unique(time_s, return_inverse=True)
    people, who = np.unique(track, return_inverse=True)
    shape = len(times), len(people), joints.shape[1]
    place, variance = np.full((*shape, 3), np.nan), np.full(shape, np.nan)
    place[at, who] = joints
    variance[at, who] = 4 * np.trace(covariance, axis1=-2, axis2=-1) / 3 + LEAST_SIGMA_M**2
    known = np.asarray(np.isfinite(variance) & np.isfinite(place).all(axis=-1))
    place, variance = np.where(known[..., None], place, 0.0), np.where(known, variance, _UNKNOWN)
    dt, M = np.diff(times), shape[1] * shape[2]
    density = np.tile(motion.density(np.full(shape[2], SPEED_M_S)), shape[1])
    mean, of_mean = np.empty((len(times), M, 3)), np.empty((len(times), M))
    _smooth(
        place.reshape(mean.shape), variance.reshape(of_mean.shape),
        ready(motion.law.transition(dt)), ready(motion.law.noise(dt[:, None], density)),
        np.array([_UNKNOWN, *np.square(motion.law.start)]), _ROUNDS, KERNEL, mean, of_mean,
    )  # fmt: skip
    mean, of_mean = mean.reshape(*shape, 3), of_mean.reshape(shape)
    ever = np.asarray(known.any(axis=0))[who]
    isotropic = of_mean[at, who][..., None, None] * np.eye(3)
    return np.where(ever[..., None], mean[at, who], np.nan), np.where(ever[..., None, None], isotropic, np.nan)


@kernel
def _add_moved(F, state, part, to):
    """Add to the state `to` what `F` (n, n) makes of another: F x and F P F^T. States are as in `_smooth`."""
    n = len(F)
    for a in range(n):
        for b in range(n + 3):
            part[a, b] = 0.0
            for k in range(n):
                part[a, b] += F[a, k] * state[k, b]
            if b < 3:
                to[a, b] += part[a, b]
        for b in range(n):
            for k in range(n):
                to[a, b + 3] += part[a, k + 3] * F[b, k]


@kernel
def _find_gain(state, F, S, G):
    """G (n, n) = P F^T S^-1, by Gauss's elimination; the covariance of the state `S` is lost."""
    n = len(F)
    for a in range(n):
        for b in range(n):
            G[b, a] = 0.0
            for k in range(n):
                G[b, a] += F[a, k] * state[k, b + 3]
    for k in range(n):
        for a in range(n):
            if a != k:
                times = S[a, k + 3] / S[k, k + 3]
                for b in range(n):
                    S[a, b + 3] -= times * S[k, b + 3]
                    G[b, a] -= times * G[b, k]
    for k in range(n):
        for b in range(n):
            G[b, k] /= S[k, k + 3]


@kernel
def _smooth(place, variance, F, Q, start, rounds, width, mean, of_mean):
    """Smooth M joints, each by itself: `place` (T, M, 3) with `variance` (T, M), into `mean` and `of_mean`; by
    Rauch, Tung and Striebel, `rounds` times with weights of Cauchy's kernel.

    `F` (T - 1, n, n) and `Q` (T - 1, M, n, n) are the law of motion's steps, `start` (n,) variances before the
    first. A state x is n by 3 numbers with the covariance P, the same along all axes, beside them: (n, 3 + n).
    """
    T, M, n = variance.shape[0], variance.shape[1], len(start)
    x, ahead, difference = np.zeros((T, n, n + 3)), np.zeros((T, n, n + 3)), np.zeros((n, n + 3))
    part, G, S, weight = np.empty((n, n + 3)), np.empty((n, n)), np.empty((n, n + 3)), np.empty(T)
    for m in range(M):
        for t in range(T):
            weight[t] = 1.0
        for _ in range(rounds):
            for t in range(T):
                for a in range(n):
                    for b in range(n + 3):
                        ahead[t, a, b] = Q[t - 1, m, a, b - 3] if t > 0 and b > 2 else 0.0
                    if t == 0:
                        ahead[0, a, a + 3] = start[a]
                if t > 0:
                    _add_moved(F[t - 1], x[t - 1], part, ahead[t])
                noise = variance[t, m] / weight[t]
                total = ahead[t, 0, 3] + noise
                for a in range(n):
                    gain = ahead[t, a, 3] / total
                    for b in range(n + 3):
                        left = place[t, m, b] - ahead[t, 0, b] if b < 3 else -ahead[t, 0, b]
                        x[t, a, b] = ahead[t, a, b] + gain * left
                    # Of the position it is a small difference of large numbers while that is not known.
                    x[t, a, 3] = x[t, 0, a + 3] = ahead[t, a, 3] * (noise / total)
            for t in range(T - 1, -1, -1):
                if t + 1 < T:
                    for a in range(n):
                        for b in range(n + 3):
                            S[a, b] = ahead[t + 1, a, b]
                            difference[a, b] = x[t + 1, a, b] - S[a, b]
                    _find_gain(x[t], F[t], S, G)
                    _add_moved(G, difference, part, x[t])
                squared = 0.0
                for i in range(3):
                    mean[t, m, i] = x[t, 0, i]
                    squared += (place[t, m, i] - x[t, 0, i]) ** 2
                of_mean[t, m] = x[t, 0, 3]
                weight[t] = 1.0 / (1.0 + squared / (of_mean[t, m] + variance[t, m]) / width)
