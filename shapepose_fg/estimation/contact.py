"""Standing feet: their probability from speeds over a window, and the constraint on their next
step.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Annotated

import numpy as np

from shapepose_fg.body.fitting.fitter import JointTargets
from shapepose_fg.core.arrays import Array, Index
from shapepose_fg.core.decompositions import principal_axes
from shapepose_fg.core.hidden_markov import state_probabilities
from shapepose_fg.core.shipped_numbers import shipped_numbers
from shapepose_fg.core.storage.schema import Column, Table
from shapepose_fg.estimation.in_time import SPEED_S

FEET = ("Ankle", "Heel", "BigToe", "SmallToe")
"""Joints that may stand, independently on either side: toes stand while the heel rises."""
ALIKE_S = 0.25
"""Time within which frames count as one measurement of a standing foot, s: detectors' errors are
correlated as long."""
FREE_M2_S = 0.003
"""Density above which a step is unconstrained: at 30 frames a second it corresponds to 1 cm. With
0.02 salsa and crowds of four cameras are 0.05 to 0.1 mm worse, with 0.001 standing feet move."""


@dataclass(frozen=True)
class FootMotion(Table):
    """Hidden Markov model of a foot's joint with K = 3 states: it stands, rotates or slides, moves.

    `scripts/fit_motion.py` fits it to motion capture.
    """

    speed_m_s: Annotated[Array, Column("K")]
    """(K,) standard deviation of the speed per axis."""
    lasts_s: Annotated[Array, Column("K")]
    """(K,) mean duration of each state, seconds."""
    first: Annotated[Array, Column("K")]
    """(K,) stationary probability of each state."""
    turns: Annotated[Array, Column("K K")]
    """(K, K) probabilities of the next state when one ends."""
    correlation_s: Annotated[Array, Column("K")]
    """(K,) correlation time of the speed within each state, seconds."""

    @classmethod
    @cache
    def measured(cls) -> "FootMotion":
        """The numbers that ship with the package."""
        return cls(**shipped_numbers("estimation", "motion")["feet"])


def feet_of(joints: Sequence[str]) -> Index:
    """(F,) indices of a detector's joints that stand with a foot."""
    return np.array(
        [n for n, name in enumerate(joints) if name[:1] in "RL" and name[1:] in FEET], dtype=np.intp
    )


def standing_density(velocity: Array, covariance: Array, times_s: Array) -> Array:
    """(T - 1, F) density of the random walk of joints in each step, m²/s: small if they stand.

    `velocity` (T, F, 3) m/s and its `covariance` (T, F, 3, 3) are of a solution without standing
    constraints, NaN if not seen. With p_k the probability of each state given the whole window, and
    2 s_k² c_k the density for speed s_k with correlation time c_k, the density is their mean: if it
    is uncertain whether a foot stands, it is hardly constrained.
    """
    known = np.asarray(np.isfinite(velocity).all(axis=2) & np.isfinite(covariance).all(axis=(2, 3)))
    log = log_densities(
        np.nan_to_num(velocity), np.where(known[..., None, None], covariance, np.eye(3))
    )
    probability = smoothed(np.where(known[..., None], log, 0.0), times_s)
    feet = FootMotion.measured()
    density = probability @ (2 * feet.speed_m_s**2 * feet.correlation_s)
    return (density[1:] + density[:-1]) / 2


def held_in_place(targets: JointTargets, density: Array, times_s: Array) -> tuple[Array, Array]:
    """Constraint on F joints in T frames from their positions in the other frames of the same
    stance: information (T, F, 3, 3), 1/m², and information times position (T, F, 3), 1/m.

    `targets` (T, F) are the estimates of joints from the views of each frame. Between frames a
    joint is a random walk of `density` (T - 1, F), m²/s, free where infinite. As errors of
    detectors are correlated over time, a frame counts as its share of `ALIKE_S`.
    """
    share = np.minimum(np.gradient(times_s) / ALIKE_S, 1.0)
    L = targets.information * share[:, None, None, None]
    eta = (L @ np.nan_to_num(targets.xyz)[..., None])[..., 0]
    q = density * np.diff(times_s)[:, None]
    found, pull, one = np.zeros_like(L), np.zeros_like(eta), np.eye(3)
    for rows, steps in ((range(1, len(L)), -1), (range(len(L) - 2, -1, -1), 1)):
        message, force = np.zeros_like(L[0]), np.zeros_like(eta[0])
        for t in rows:
            walk = q[min(t, t + steps)]
            free = ~np.isfinite(walk)
            walk = np.where(free, 0.0, walk)[:, None, None]
            message, force = message + L[t + steps], force + eta[t + steps]
            kept = np.linalg.inv(one + walk * message)
            message, force = message @ kept, (kept.mT @ force[..., None])[..., 0]
            message[free], force[free] = 0.0, 0.0
            found[t] += (message + message.mT) / 2
            pull[t] += force
    return found, pull


def log_densities(velocity: Array, covariance: Array) -> Array:
    """(T, F, K) log-density of velocities under each state, up to a constant."""
    values, axes = principal_axes(covariance)
    along = np.einsum("tfia,tfi->tfa", axes, velocity)
    variance = np.maximum(values, 0.0)[..., None] + FootMotion.measured().speed_m_s ** 2
    return -0.5 * (along[..., None] ** 2 / variance + np.log(variance)).sum(axis=2)


def smoothed(log: Array, times_s: Array) -> Array:
    """(T, F, K) probability of each state in each frame, given all frames (forward-backward
    algorithm).

    `log` (T, F, K) are log-densities of the observations. Frames within `SPEED_S`, over which
    velocities are measured, count as one.
    """
    dt, feet = np.diff(times_s), FootMotion.measured()
    share = np.minimum(np.gradient(times_s) / SPEED_S, 1.0)[:, None, None]
    seen = np.exp(np.maximum(log - log.max(axis=2, keepdims=True), -600.0) * share)
    stays = np.exp(-dt[:, None] / feet.lasts_s)
    turn = stays[..., None] * np.eye(len(feet.first)) + (1 - stays)[..., None] * feet.turns
    return state_probabilities(seen, feet.first, turn)[0]
