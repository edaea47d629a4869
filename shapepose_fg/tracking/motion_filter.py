"""Where joints are, how fast they move and how surely: a Kalman filter, batched over people and joints."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from factors import Motion
from shapepose_fg.core.arrays import Array
from shapepose_fg.core.compiled import kernel


@dataclass(frozen=True)
class JointStates:
    """States of A people's J joints, a Gaussian each: position and n - 1 derivatives (`factors.Motion`)."""

    mean: Array
    """(A, J, 3 n) position, metres in the world, velocity, metres per second, and so on."""
    covariance: Array
    """(A, J, 3 n, 3 n) its covariance."""

    @property
    def position(self) -> Array:
        """(A, J, 3) metres."""
        return self.mean[..., :3]

    @property
    def velocity(self) -> Array:
        """(A, J, 3) metres per second."""
        return self.mean[..., 3:6]

    @property
    def sigma_m(self) -> Array:
        """(A, J) standard deviation of the position, root mean square over the axes, metres."""
        return np.sqrt(np.trace(self.covariance[..., :3, :3], axis1=-2, axis2=-1) / 3)

    @property
    def across_m(self) -> Array:
        """(A, J) standard deviation of the position across the ray of a joint that one view sees, metres: an axis
        that is known much worse than the others drops out, and where all are alike it is `sigma_m`.
        """
        P = self.covariance[..., :3, :3]
        trace = np.trace(P, axis1=-2, axis2=-1)
        pairs = (trace**2 - np.einsum("...ij,...ji->...", P, P)) / 2
        return np.sqrt(pairs / trace)

    def __len__(self) -> int:
        return len(self.mean)

    def rows(self, index: NDArray) -> "JointStates":
        """Some of the people."""
        return JointStates(self.mean[index], self.covariance[index])

    @classmethod
    def concatenate(cls, parts: Sequence["JointStates"]) -> "JointStates":
        """The people of several."""
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in ("mean", "covariance")))

    @classmethod
    def at(cls, position: Array, sigma_m: Array, start: Sequence[float]) -> "JointStates":
        """People at `position` (A, J, 3), known to `sigma_m` (A, J), whose derivatives are 0, known to `start`."""
        mean = np.concatenate([position, *[np.zeros_like(position)] * len(start)], axis=-1)
        sigma = np.stack([sigma_m, *(np.full_like(sigma_m, each) for each in start)], axis=-1)
        return cls(mean, np.repeat(sigma**2, 3, axis=-1)[..., None] * np.eye(mean.shape[-1]))

    def predicted(self, step_s: float, motion: Motion, density: Array) -> "JointStates":
        """`step_s` seconds later, by a model of motion with noise of this `density` (J,).

        A negative step predicts into the past.
        """
        F, noise = motion.step(step_s, density)
        mean, covariance, half = (
            np.empty_like(self.mean),
            np.empty_like(self.covariance),
            np.empty(self.mean.shape[-1]),
        )
        _predict(self.mean, self.covariance, F, noise, half, mean, covariance)
        return JointStates(mean, covariance)

    def with_derivatives(self, *derivatives: Array) -> "JointStates":
        """The same with other mean velocities (A, J, 3), and with what is beyond these."""
        return replace(self, mean=np.concatenate([self.position, *derivatives], axis=-1))


@kernel
def _predict(mean, covariance, F, noise, half, mean_after, covariance_after):
    """F m and F P F^T + Q of all joints, with F (n, n) and Q (J, n, n) for each axis; `half` (S,) is for work."""
    people, joints, size = mean.shape
    for a in range(people):
        for j in range(joints):
            for row in range(size):
                total = 0.0
                for k in range(row % 3, size, 3):
                    total += F[row // 3, k // 3] * mean[a, j, k]
                mean_after[a, j, row] = total
                for column in range(size):
                    half[column] = 0.0
                    for k in range(row % 3, size, 3):
                        half[column] += F[row // 3, k // 3] * covariance[a, j, k, column]
                for column in range(size):
                    total = noise[j, row // 3, column // 3] if row % 3 == column % 3 else 0.0
                    for k in range(column % 3, size, 3):
                        total += half[k] * F[column // 3, k // 3]
                    covariance_after[a, j, row, column] = total
