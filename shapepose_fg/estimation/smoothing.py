"""Drafts of joints, frame by frame, smoothed over time: what a few frames' wrong detections do not lead away."""

import numpy as np

from factors import Motion
from shapepose_fg.core.arrays import Array, Whole
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
    density, weight = motion.density(np.full(shape[2], SPEED_M_S)), np.ones(shape)
    mean, of_mean = place, variance
    for _ in range(_ROUNDS):
        mean, of_mean = _smooth(
            place, np.where(known, variance / weight, _UNKNOWN), np.diff(times), density, motion.law
        )
        weight = 1 / (1 + ((place - mean) ** 2).sum(axis=-1) / (of_mean + variance) / KERNEL)
    ever = np.asarray(known.any(axis=0))[who]
    isotropic = of_mean[at, who][..., None, None] * np.eye(3)
    return np.where(ever[..., None], mean[at, who], np.nan), np.where(ever[..., None, None], isotropic, np.nan)


def _smooth(place: Array, variance: Array, steps_s: Array, density: Array, law: Motion) -> tuple[Array, Array]:
    """Mean (T, A, J, 3) and variance (T, A, J) of positions measured as `place` with `variance`.

    Rauch-Tung-Striebel, along all axes alike. A state x has n parts (A, J, 3), its covariance P n times n (A, J).
    """
    n, shape = law.order, variance.shape[1:]
    every, none = range(n), np.zeros(shape)
    start = (_UNKNOWN, *np.square(law.start))
    x = [np.zeros_like(place[0]) for _ in every]
    P = [[np.full(shape, start[i]) if i == j else none for j in every] for i in every]
    kept, predicted = [], []
    for t in range(len(place)):
        if t > 0:
            F, Q = law.step(float(steps_s[t - 1]), density)
            x = [sum(F[i, j] * x[j] for j in every) for i in every]
            P = [[entry + Q[:, i, j] for j, entry in enumerate(row)] for i, row in enumerate(_congruent(F, P))]
        predicted.append((x, P))
        gain, apart = [row[0] / (P[0][0] + variance[t]) for row in P], place[t] - x[0]
        x = [part + of_part[..., None] * apart for part, of_part in zip(x, gain, strict=True)]
        first = [entry * (1 - gain[0]) for entry in P[0]]
        rest = [[P[i][j] - gain[min(i, j)] * P[0][max(i, j)] for j in every] for i in every]
        P = [[first[i + j] if i == 0 or j == 0 else rest[i][j] for j in every] for i in every]
        kept.append((x, P))
    means, variances = np.empty_like(place), np.empty_like(variance)
    means[-1], variances[-1] = x[0], P[0][0]
    for t in range(len(place) - 2, -1, -1):
        (x0, P0), (x1, P1), F = kept[t], predicted[t + 1], law.transition(float(steps_s[t]))
        G = _over([[sum(P0[i][k] * F[j, k] for k in every) for j in every] for i in every], P1)
        x = [sum((G[i][j][..., None] * (x[j] - x1[j]) for j in every), x0[i]) for i in every]
        P = _congruent(G, [[P[i][j] - P1[i][j] for j in every] for i in every], P0)
        means[t], variances[t] = x[0], P[0][0]
    return means, variances


def _congruent(A, P, start=None) -> list[list[Array]]:
    """A P A^T, plus `start` if that is given, of n times n arrays; P is symmetric."""
    places = [(j, k) for j in range(len(P)) for k in range(j, len(P))]

    def entry(i: int, m: int) -> Array:
        weights = (A[i][j] * A[m][k] + (A[i][k] * A[m][j] if j < k else 0) for j, k in places)
        terms = (weight * P[j][k] for weight, (j, k) in zip(weights, places, strict=True))
        return sum(terms, np.zeros(()) if start is None else start[i][m])

    return [[entry(i, m) for m in range(len(P))] for i in range(len(P))]


def _over(B, S) -> list[list[Array]]:
    """B S^-1 of n times n arrays; two by two by Cramer's rule, in a fraction of the time."""
    if len(S) == 2:
        (p, c), (_, v) = S
        return [[(a * v - b * c) / (p * v - c**2), (b * p - a * c) / (p * v - c**2)] for a, b in B]
    whole = np.linalg.solve(*(np.moveaxis(np.array(each), (0, 1), (-1, -2)) for each in (S, B)))
    return list(np.moveaxis(whole, (-1, -2), (0, 1)))
