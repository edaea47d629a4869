"""Temporal smoothing of single-frame initial estimates, robust to wrong detections in a
few frames.
"""

import numpy as np

from factors import Motion
from shapepose_fg.core.arrays import Array, Whole
from shapepose_fg.estimation.in_time import WALK_M_S, motion_of
from shapepose_fg.estimation.kernels import solve_chains
from shapepose_fg.estimation.motion_densities import MotionModel

LEAST_SIGMA_M = 0.03
"""Added standard deviation, m, besides a factor of two, since errors of initial estimates are
correlated over time."""
KERNEL = 6.0
"""Squared distance from the smoothed joint, in variances, at which an initial estimate has half its
weight."""
_ROUNDS = 3
_UNKNOWN = 1e6


def smoothed(
    joints: Array, covariance: Array, track: Whole, time_s: Array, motion: MotionModel
) -> tuple[Array, Array]:
    """Smooth initial estimates `joints` (N, J, 3), metres, with `covariance` (N, J, 3, 3), along
    each `track` (N,).

    Every joint is an independent, isotropic chain of states; distant estimates are down-weighted
    (Cauchy), and it is solved again. `time_s` (N,) seconds. Gaps are bridged by the motion model;
    NaN for joints of a track that are never estimated.
    """
    times, at = np.unique(time_s, return_inverse=True)
    people, row = np.unique(track, return_inverse=True)
    T, J, C = len(times), joints.shape[1], len(people) * joints.shape[1]
    place, variance = np.full((len(people), J, T, 3), np.nan), np.full((len(people), J, T), np.nan)
    place[row, :, at] = joints
    variance[row, :, at] = 4 * np.trace(covariance, axis1=-2, axis2=-1) / 3 + LEAST_SIGMA_M**2
    by_time = np.moveaxis(place, 2, 0).reshape(T, C, 3), np.moveaxis(variance, 2, 0).reshape(T, C)
    speed, turning = (each.reshape(T - 1, len(people), J) for each in motion_of(*by_time, times))
    known = np.asarray(np.isfinite(variance) & np.isfinite(place).all(axis=-1))
    place = np.where(known[..., None], place, 0.0).reshape(C, T, 3)
    information = np.where(known, 1.0 / np.where(known, variance, 1.0), 1.0 / _UNKNOWN).reshape(
        C, T
    )
    # Joints are at least as fast as a walker.
    density = motion.density(np.maximum(speed, WALK_M_S), turning=turning).reshape(T - 1, C)
    moving, below = motion_information(motion.law, np.diff(times), density)
    n, weight, mean, of_mean = motion.law.order, information, place, 1.0 / information
    for _ in range(_ROUNDS):
        diagonal, right = moving.copy(), np.zeros((3, C, T, n))
        diagonal[..., 0, 0] += weight
        right[..., 0] = np.moveaxis(place * weight[..., None], -1, 0)
        states, spread = np.empty(right.shape), np.empty((C, T, n, n))
        solve_chains(diagonal, below, right, states, spread)
        mean, of_mean = np.moveaxis(states[..., 0], 0, -1), spread[..., 0, 0]
        squared = ((place - mean) ** 2).sum(axis=-1) / (of_mean + 1.0 / information)
        weight = information / (1 + squared / KERNEL)
    ever = np.asarray(known.any(axis=2))[row]
    mean, of_mean = (each.reshape(-1, J, *each.shape[1:])[row, :, at] for each in (mean, of_mean))
    isotropic = of_mean[..., None, None] * np.eye(3)
    return np.where(ever[..., None], mean, np.nan), np.where(
        ever[..., None, None], isotropic, np.nan
    )


def motion_information(law: Motion, dt_s: Array, density: Array) -> tuple[Array, Array]:
    """Information of a motion model about C chains of T states, along one axis: diagonal blocks (C,
    T, n, n), and blocks with the state before (C, T - 1, n, n).

    Steps `dt_s` (T - 1,), densities (T - 1, C). There is a prior on initial derivatives, none on
    positions.
    """
    F = law.transition(dt_s)
    # Copied, as a kernel takes what follows from it, and names C-contiguous arrays.
    noise = np.linalg.inv(law.noise(dt_s)) / density.T.copy()[..., None, None]
    own = np.zeros((noise.shape[0], len(dt_s) + 1, *F.shape[1:]))
    own[:, 0] = np.diag([0.0, *np.power(law.start, -2.0)])
    own[:, 1:] += noise
    own[:, :-1] += F.mT @ noise @ F
    return own, -noise @ F
