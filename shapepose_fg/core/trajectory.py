"""Trajectories of carriers of cameras (a robot, a person or a crane): poses over time from odometry
or SLAM.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from shapepose_fg.core.arrays import Array, Index, Mask
from shapepose_fg.core.decompositions import is_rotation, rigid, rotation_angle

DRIFT = 0.01
"""Default drift of an odometry, per metre: wheel and visual odometry drift by about 1 % of the
distance."""
LONGEST_GAP_S = 0.5
"""Longest gap between poses that is interpolated, s: the carrier moves up to 0.7 m at walking
speed, or turns up to 45 degrees."""
_MOST_DRIFT = 1.0
MOST_METRES = 1e6
"""Maximum coordinate of a position, m; farther away, double precision is too coarse for joints."""
UNIT_LENGTH = 0.01
"""Largest deviation of the length of a quaternion from 1: files have two or more digits."""
_START_M, _START_RAD = 0.05, 0.02
"""Standard deviation per axis of an odometry's start in the world of the fixed cameras: metres,
rad."""
_M_A_RAD, _M_A_S = 0.5, 0.05
"""Path length, m, to which a rotation by one radian, and a second at rest, are equivalent in the
drift model."""
MOST_VARIANCE = 1e18
"""Largest entry of a pose's covariance, rad² or m²: a larger one is equivalent to an unknown
pose."""


@dataclass(frozen=True)
class Trajectory:
    """Poses over time of a carrier of cameras."""

    name: str
    """Name of the carrier; cameras refer to it."""
    time_s: Array
    """(F,) increasing times, seconds, on the clock of the pictures' times."""
    wTb: Array
    """(F, 4, 4) world from carrier, metres."""
    covariance: Array | None = None
    """(F, 6, 6) covariance of each pose in the world: rotation, then translation, along the
    carrier's own axes, rad² and m² (GTSAM's order); None for an odometry, which has a known start
    and drifts."""
    drift: float = DRIFT
    """Drift of an odometry, as a share of the path length; its errors are a random walk."""
    refined: bool = False
    """Whether the trajectory was refined with the people of a recording (`pipeline.trajectories`);
    it is then not refined again."""

    def __post_init__(self) -> None:
        def refuse(problem: str) -> ValueError:
            return ValueError(f"trajectory {self.name}: {problem}")

        time_s, wTb = (
            np.asarray(self.time_s, dtype=np.float64),
            np.asarray(self.wTb, dtype=np.float64),
        )
        if len(time_s) < 2 or time_s.ndim != 1 or wTb.shape != (len(time_s), 4, 4):
            raise refuse(
                f"time_s must be (F,) and wTb (F, 4, 4), F at least 2, got {time_s.shape} and "
                f"{wTb.shape}"
            )
        if not (np.isfinite(time_s).all() and np.isfinite(wTb).all()):
            raise refuse("times and poses must be finite")
        if (most := float(np.abs(wTb[:, :3, 3]).max())) > MOST_METRES:
            raise refuse(f"poses must be at most {MOST_METRES:g} m away, got {most:.3g}")
        if (np.diff(time_s) <= 0).any():
            raise refuse(
                "times must increase, but do not at pose "
                f"{int(np.argmax(np.diff(time_s) <= 0)) + 1}"
            )
        R = wTb[:, :3, :3]
        if not is_rotation(R):
            raise refuse("rotations must be orthonormal with determinant 1")
        if not 0 < self.drift <= _MOST_DRIFT:
            raise refuse(f"drift must be above 0 and at most {_MOST_DRIFT:g}, got {self.drift}")
        if self.covariance is not None:
            covariance = np.asarray(self.covariance, dtype=np.float64)
            if covariance.shape != (len(time_s), 6, 6) or not np.isfinite(covariance).all():
                raise refuse(
                    f"covariance must have finite numbers and the shape {(len(time_s), 6, 6)}, "
                    f"got the shape {covariance.shape}"
                )
            if np.abs(covariance).max(initial=0.0) > MOST_VARIANCE:
                raise refuse(
                    f"covariance must be at most {MOST_VARIANCE:g}, got "
                    f"{np.abs(covariance).max():.3g}"
                )
            if np.linalg.eigvalsh(covariance)[:, 0].min() < -1e-9:
                raise refuse("covariances must have no negative eigenvalue")
            object.__setattr__(self, "covariance", covariance)
        object.__setattr__(self, "time_s", time_s)
        object.__setattr__(self, "wTb", wTb)

    def __len__(self) -> int:
        return len(self.time_s)

    def from_start(self, time_s: Array) -> "Trajectory":
        """The trajectory if it has times in common with pictures at `time_s` (T,), NaN for missing
        ones; otherwise shifted in time to begin with them, as logs with a clock of their own do.
        """
        first, last = np.nanmin(time_s), np.nanmax(time_s)
        if self.time_s[0] < last and first < self.time_s[-1]:
            return self
        return replace(self, time_s=self.time_s - self.time_s[0] + first)

    def covers(self, time_s: Array) -> Mask:
        """(...,) mask of the times between two poses that are at most `LONGEST_GAP_S` apart."""
        after = np.clip(np.searchsorted(self.time_s, time_s), 1, len(self) - 1)
        near = (np.diff(self.time_s)[after - 1] <= LONGEST_GAP_S) | (self.time_s[after] == time_s)
        return np.asarray((time_s >= self.time_s[0]) & (time_s <= self.time_s[-1]) & near)

    def at(self, time_s: Array) -> Array:
        """(..., 4, 4) poses at times (...,): translations are interpolated linearly, rotations
        about a fixed axis; constant beyond the ends.
        """
        from scipy.spatial.transform import Rotation

        flat = np.ravel(time_s)
        before, part = self._place(flat)
        R, last = self.wTb[before, :3, :3], self.wTb[before + 1, :3, :3]
        turn = part[:, None] * Rotation.from_matrix(R.mT @ last).as_rotvec()
        pose = rigid(
            R @ Rotation.from_rotvec(turn).as_matrix(), self._between(self.wTb[:, :3, 3], flat)
        )
        return pose.reshape(*np.shape(time_s), 4, 4)

    def covariance_at(self, time_s: Array) -> Array:
        """(..., 6, 6) covariances of the poses at times (...,); 0 if none are given."""
        if self.covariance is None:
            return np.zeros((*np.shape(time_s), 6, 6))
        return self._between(self.covariance, np.ravel(time_s)).reshape(*np.shape(time_s), 6, 6)

    def start_covariance(self) -> Array:
        """(6, 6) covariance of the first pose."""
        if self.covariance is not None:
            return self.covariance[0]
        return np.diag([_START_RAD**2] * 3 + [_START_M**2] * 3)

    def drifted(self, poses: Array, time_s: Array) -> Array:
        """(T - 1, 6, 6) covariances of the steps between `poses` (T, 4, 4) of this odometry at
        `time_s` (T,).
        """
        steps = np.linalg.inv(poses[:-1]) @ poses[1:]
        way = (
            np.linalg.norm(steps[:, :3, 3], axis=1)
            + _M_A_RAD * rotation_angle(steps[:, :3, :3])
            + _M_A_S * np.diff(time_s)
        )
        # Error of rotation, rad, per metre of translational error of an odometry; both
        # have the same effect after a straight path of 10 m.
        sigmas = np.array([0.5] * 3 + [1.0] * 3) * self.drift
        return way[:, None, None] * np.diag(sigmas**2)

    def _between(self, values: Array, time_s: Array) -> Array:
        """(M, ...) values (F, ...) interpolated linearly at times (M,), and constant before the
        first and after the last.
        """
        before, part = self._place(time_s)
        part = part.reshape(-1, *[1] * (values.ndim - 1))
        return (1 - part) * values[before] + part * values[before + 1]

    def _place(self, time_s: Array) -> tuple[Index, Array]:
        """(M,) index of the pose before each of the times (M,), and the relative position between
        it and the next, 0 to 1.
        """
        before = np.clip(np.searchsorted(self.time_s, time_s) - 1, 0, len(self) - 2)
        first, last = self.time_s[before], self.time_s[before + 1]
        return before, np.clip((time_s - first) / (last - first), 0.0, 1.0)


@dataclass(frozen=True)
class Carried:
    """Poses of the carriers of cameras at N times, with covariances: one row per time."""

    carrier: Index
    """(V,) index of the carrier of each view among B; -1 for a fixed camera."""
    wTb: Array
    """(N, B, 4, 4) world from carrier, metres."""
    covariance: Array
    """(N, B, 6, 6) as in `Trajectory`."""

    @classmethod
    def of(cls, trajectories: Iterable[Trajectory], carrier: Index, time_s: Array) -> "Carried":
        """The poses of the carriers at N times `time_s` (N,)."""
        every = tuple(trajectories)
        poses = np.stack([each.at(time_s) for each in every], axis=1)
        return cls(carrier, poses, np.stack([each.covariance_at(time_s) for each in every], axis=1))

    def rows(self, index: Index) -> "Carried":
        """The carriers in some of the rows."""
        return Carried(self.carrier, self.wTb[index], self.covariance[index])
