"""Where joints are, how fast they move and how surely: a Kalman filter, batched over people and joints."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class JointStates:
    """Position and velocity of A people's J joints, a Gaussian for each joint."""

    mean: Array
    """(A, J, 6) position, metres in the world, and velocity, metres per second."""
    covariance: Array
    """(A, J, 6, 6) its covariance."""

    @property
    def position(self) -> Array:
        """(A, J, 3) metres."""
        return self.mean[..., :3]

    @property
    def velocity(self) -> Array:
        """(A, J, 3) metres per second."""
        return self.mean[..., 3:]

    @property
    def sigma_m(self) -> Array:
        """(A, J) standard deviation of the position, root mean square over the axes, metres."""
        return np.sqrt(np.trace(self.covariance[..., :3, :3], axis1=-2, axis2=-1) / 3)

    @property
    def across_m(self) -> Array:
        """(A, J) standard deviation of the position across the ray of a joint that one view sees, metres.

        The root of what pairs of axes know together over what they know in sum: where all axes are alike it is
        `sigma_m`, and an axis that is known much worse than the others (v) drops out: (u + w) v / v.
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
    def concatenate(cls, first: "JointStates", second: "JointStates") -> "JointStates":
        """The people of both."""
        return cls(
            np.concatenate([first.mean, second.mean]), np.concatenate([first.covariance, second.covariance])
        )

    @classmethod
    def at(cls, position: Array, sigma_m: Array, speed_mps: float) -> "JointStates":
        """People at `position` (A, J, 3), known to `sigma_m` (A, J), at rest but for `speed_mps` on each axis."""
        mean = np.concatenate([position, np.zeros_like(position)], axis=-1)
        return cls(mean, _diagonal(sigma_m, np.full_like(sigma_m, speed_mps)))

    def predicted(self, step_s: float, psd: Array) -> "JointStates":
        """`step_s` seconds later; accelerations are white noise of power spectral density `psd` (J,), m²/s³.

        A negative step predicts into the past.
        """
        F, eye, h = np.eye(6), np.eye(3), abs(step_s)
        F[:3, 3:] = step_s * eye
        noise = np.zeros((len(psd), 6, 6))
        noise[:, :3, :3] = psd[:, None, None] * eye * h**3 / 3
        noise[:, :3, 3:] = psd[:, None, None] * eye * h**2 / 2 * np.sign(step_s)
        noise[:, 3:, :3] = noise[:, :3, 3:]
        noise[:, 3:, 3:] = psd[:, None, None] * eye * h
        return JointStates(self.mean @ F.T, F @ self.covariance @ F.T + noise)

    def updated(self, information: Array, pull: Array) -> "JointStates":
        """After a measurement z of the positions with `information` L (A, J, 3, 3) and L (z - position) = `pull`.

        L may be singular (a joint that one view sees) or zero: the gain P (I + L P)^-1 needs no inverse of it.
        """
        P = self.covariance[..., :3, :3]
        gain = self.covariance[..., :, :3] @ np.linalg.inv(np.eye(3) + information @ P)
        mean = self.mean + np.einsum("...ij,...j->...i", gain, pull)
        covariance = self.covariance - gain @ information @ self.covariance[..., :3, :]
        return JointStates(mean, (covariance + np.swapaxes(covariance, -1, -2)) / 2)

    def replaced(self, where: NDArray[np.bool_], other: "JointStates") -> "JointStates":
        """The same, with the joints `where` (A, J) from another."""
        return JointStates(
            np.where(where[..., None], other.mean, self.mean),
            np.where(where[..., None, None], other.covariance, self.covariance),
        )

    def with_velocity(self, velocity: Array) -> "JointStates":
        """The same with other mean velocities (A, J, 3)."""
        return replace(self, mean=np.concatenate([self.position, velocity], axis=-1))


def _diagonal(position_sigma: Array, velocity_sigma: Array) -> Array:
    """(..., 6, 6) of standard deviations (...,) of positions and velocities."""
    variance = np.stack([position_sigma] * 3 + [velocity_sigma] * 3, axis=-1) ** 2
    return variance[..., None] * np.eye(6)
