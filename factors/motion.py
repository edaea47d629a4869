"""Motion models of joints: the interface, and the two models that are included.

A joint's state s is its position and the first n - 1 derivatives of it, independently along each
axis. A model predicts the state after a time step dt of any length:

    s' = F(dt) s + w,   w ~ N(0, q Q(dt))

with q the noise density, a number for each joint and step. F and Q define a model completely: the
factors between two states in a graph (`Motion.factors`), hence the covariances, the tracker's
prediction, the smoother of initial estimates, and the links between a person's bodies all follow
from them. A model of your own overrides `transition` and `noise`, and is registered by name in
`MOTIONS`.

`Motion` itself is white noise on the n-th derivative: on acceleration for n = 2 (Barfoot's prior),
on jerk for n = 3.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import repeat
from math import factorial

import gtsam
import numpy as np
from gtsam import noiseModel
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

ORDERS = (2, 3)
"""Allowed orders: the state along an axis has 2 numbers (position, velocity) or 3 (and
acceleration)."""
MEASURED_S = 2 / 30
"""Time scale of the measured accelerations of people, s: second differences at 30 frames a
second."""


@dataclass(frozen=True)
class Motion:
    """Motion model with white noise on the derivative of the position of this `order`."""

    order: int = 2
    """n, number of state variables along an axis: one of `ORDERS`."""
    start: tuple[float, ...] = (2.0,)
    """Prior standard deviation of each derivative along an axis: m/s, m/s²."""

    def __post_init__(self) -> None:
        if self.order not in ORDERS or len(self.start) != self.order - 1:
            raise ValueError(
                f"order must be one of {ORDERS}, and start must have order - 1 values, got {self}"
            )

    def transition(self, dt_s: ArrayLike) -> Array:
        """F (..., n, n) over steps of `dt_s` (...), positive, seconds."""
        h, places = np.asarray(dt_s, dtype=np.float64), range(self.order)
        return matrices(
            [[h ** (j - i) / factorial(j - i) if j >= i else 0 * h for j in places] for i in places]
        )

    def noise(self, dt_s: ArrayLike, density: ArrayLike = 1.0) -> Array:
        """Covariance q Q (..., n, n) over steps of `dt_s` (...), positive, seconds, for densities q
        (...).
        """
        q, h = (
            np.asarray(density, dtype=np.float64),
            dt_s if isinstance(dt_s, float) else np.asarray(dt_s),
        )
        left = range(self.order - 1, -1, -1)
        # The integral over dt of (u^i / i!) (u^j / j!).
        return matrices(
            [
                [q * h ** (i + j + 1) / ((i + j + 1) * factorial(i) * factorial(j)) for j in left]
                for i in left
            ]
        )

    def density(self, acceleration: ArrayLike, within_s: float = MEASURED_S) -> Array:
        """The density q of this model that corresponds to the measured power spectral density of
        `acceleration`, m²/s³.

        With this q, positions are as uncertain after `within_s` seconds as with white noise on
        acceleration. A time scale is needed because people's motion corresponds to another q on
        every time scale.
        """
        white = within_s**3 / 3
        return np.asarray(acceleration, dtype=np.float64) * (white / self.noise(within_s)[0, 0])

    def step(self, dt_s: float, density: ArrayLike) -> tuple[Array, Array]:
        """F (n, n) and q Q (..., n, n) of a step that may be backwards in time: then derivatives of
        odd order change sign.
        """
        F, Q = self.transition(abs(dt_s)), self.noise(abs(dt_s), density)
        turn = np.sign(dt_s) ** np.arange(self.order) if dt_s != 0 else np.ones(self.order)
        both = np.outer(turn, turn)
        return both * F, both * Q

    def factors(
        self, keys: ArrayLike, times_s: ArrayLike, density: ArrayLike
    ) -> list[gtsam.NonlinearFactor]:
        """T - 1 native, linear factors between the T consecutive states of one joint.

        `keys` (T, n) are the states' `Point3` variables, position first; `times_s` (T,) are
        increasing; `density` is q, one number or one for each step (T - 1,).
        """
        times, states = np.asarray(times_s, dtype=np.float64), np.asarray(keys)
        if states.shape != (len(times), self.order):
            raise ValueError(
                f"keys must be (T, {self.order}) and times_s (T,), got {states.shape}, "
                f"{times.shape}"
            )
        if not rise(times):
            raise ValueError("times_s must be finite and rise from state to state")
        densities = np.broadcast_to(np.asarray(density, dtype=np.float64), max(len(times) - 1, 0))
        if not np.all((densities > 0) & np.isfinite(densities)):
            raise ValueError("psd must be positive and finite, m²/s³ (or m²/s⁵ of jerk)")
        return self._factors(states, times, densities)

    def _factors(
        self, states: NDArray[np.int64], times: Array, densities: Array
    ) -> list[gtsam.NonlinearFactor]:
        """One Gaussian p(s' | s) for each step, with the whitened residual r = s' - F s."""
        eye, unit = np.eye(3), noiseModel.Unit.Create(3 * self.order)
        linear = []
        for before, after, dt, q in zip(
            states[:-1].tolist(),
            states[1:].tolist(),
            np.diff(times).tolist(),
            densities,
            strict=True,
        ):
            root = np.linalg.cholesky(np.linalg.inv(self.noise(dt, q))).T
            blocks = np.kron(np.hstack([root, -root @ self.transition(dt)]), eye)
            terms = list(
                zip([*after, *before], np.split(blocks, 2 * self.order, axis=1), strict=True)
            )
            conditional = gtsam.GaussianConditional(terms, self.order, np.zeros(len(blocks)), unit)
            linear.append(gtsam.JacobianFactor(conditional))
        return contained(linear, states)


class ConstantVelocity(Motion):
    """Motion model with white noise on acceleration, by GTSAM's own factor.

    r = [x' - x - dt v,  v' - v]  ~  N(0, q [[dt³/3, dt²/2], [dt²/2, dt]])
    """

    def _factors(
        self, states: NDArray[np.int64], times: Array, densities: Array
    ) -> list[gtsam.NonlinearFactor]:
        states_at = zip(*states.T.tolist(), times.tolist(), strict=True)
        every = [
            gtsam.StateData(position, velocity, time) for position, velocity, time in states_at
        ]
        diagonals = np.repeat(densities[:, None], 3, axis=1)
        return list(map(gtsam.WnoaMotionFactorPoint3, every[:-1], every[1:], diagonals))


CONSTANT_VELOCITY = ConstantVelocity()
"""Motion model with white noise on the acceleration (constant velocity between steps)."""
CONSTANT_ACCELERATION = Motion(3, (2.0, 5.0))
"""Motion model with white noise on the jerk (constant acceleration between steps)."""
MOTIONS: dict[str, Motion] = {
    "constant velocity": CONSTANT_VELOCITY,
    "constant acceleration": CONSTANT_ACCELERATION,
}
"""Motion models by the names that the settings use."""


def matrices(rows: Sequence[Sequence[Array]]) -> Array:
    """Matrices (..., n, n) from their entries (...), row by row."""
    shape = np.broadcast_shapes(*(np.shape(entry) for row in rows for entry in row))
    found = np.empty((*shape, len(rows), len(rows)))
    for i, row in enumerate(rows):
        for j, entry in enumerate(row):
            found[..., i, j] = entry
    return found


def motion_factors(
    keys: ArrayLike, velocity_keys: ArrayLike, times_s: ArrayLike, psd: ArrayLike
) -> list[gtsam.NonlinearFactor]:
    """`CONSTANT_VELOCITY.factors` of positions `keys` (T,) and velocities `velocity_keys` (T,)."""
    positions, velocities = np.asarray(keys), np.asarray(velocity_keys)
    if positions.shape != velocities.shape:
        raise ValueError(
            f"keys and velocity_keys must be (T,), got {positions.shape}, {velocities.shape}"
        )
    return CONSTANT_VELOCITY.factors(np.stack([positions, velocities], axis=-1), times_s, psd)


def motion_covariance(dt_s: ArrayLike, psd: ArrayLike) -> Array:
    """Covariance (..., 6, 6) of [x' - x - dt v, v' - v] over steps `dt_s` (...): m², m²/s,
    m²/s².
    """
    return np.asarray(np.kron(CONSTANT_VELOCITY.noise(dt_s, psd), np.eye(3)), dtype=np.float64)


def rise(times_s: NDArray[np.float64]) -> bool:
    """Whether times (T,) are finite and strictly increasing."""
    return bool(np.isfinite(times_s).all() and (np.diff(times_s) > 0).all())


def contained(
    linear: Iterable[gtsam.JacobianFactor], keys: NDArray[np.int64]
) -> list[gtsam.NonlinearFactor]:
    """Linear factors on `Point3` variables `keys` (D,) as factors of a nonlinear graph.

    They get the linearisation point zero: without one their error is always 0.
    """
    zeros, origin = gtsam.Values(), np.zeros(3)
    for key in np.unique(keys).tolist():
        zeros.insert(key, origin)
    return list(map(gtsam.LinearContainerFactor, linear, repeat(zeros)))
