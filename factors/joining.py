"""People in a graph of yours, frame by frame: what ISAM2 or a fixed-lag smoother takes in an update.

A joint has a position and a velocity in each frame. Cameras that see it are robust projection factors: of a
camera that stands still on the joint alone, of one that your graph carries on the joint and a pose of yours.
Between frames joints move by white noise on acceleration (`factors.motion`).
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from factors.key_space import KeySpace
from factors.motion import CONSTANT_VELOCITY, motion_factors
from factors.noise import Kernel, gaussian, isotropic
from factors.projection import posed_projection_factors, projection_factors

Array = NDArray[np.float64]

_START_M = 1.0
"""A new joint is so near to where it is said to be: far less is known so than from two cameras. ISAM2 calls a
joint singular that one camera sees and that is hardly held along the ray: at 10 m it did, at 3 m no more."""


@dataclass(frozen=True)
class PosedCamera:
    """A camera whose pose is a variable of yours."""

    calibration: gtsam.Cal3_S2
    """Its lens; points are undistorted."""
    pose_key: int
    """`Pose3`, world from camera, or from what carries it."""
    body_T_sensor: gtsam.Pose3 = field(default_factory=gtsam.Pose3)
    """Carrier from camera."""


@dataclass(frozen=True)
class Sighting:
    """What V cameras saw of one person in one frame."""

    person: int
    """Who."""
    frame: int
    """Its number, for keys."""
    time_s: float
    """When, seconds."""
    joints: Array
    """(J, 3) where the joints are about, metres in the world; NaN: leave this one out."""
    xy: Array
    """(J, V, 2) where each camera saw them, undistorted pixels; NaN: it did not."""
    sigmas_px: Array
    """(J, V) standard deviation of these places per axis, pixels."""
    density: Array
    """(J,) power spectral density of their accelerations, m²/s³."""
    cameras: Sequence[gtsam.PinholeCameraCal3_S2 | PosedCamera]
    """The V cameras, as they are in this frame."""

    def __post_init__(self) -> None:
        J, V = len(self.joints), len(self.cameras)
        shapes = [np.shape(each) for each in (self.joints, self.xy, self.sigmas_px, self.density)]
        if shapes != [(J, 3), (J, V, 2), (J, V), (J,)]:
            raise ValueError(
                "joints must be (J, 3), xy (J, V, 2), sigmas_px (J, V), density (J,), got"
                f" {shapes} and {V} cameras"
            )


@dataclass
class Increment:
    """What a frame adds to a graph."""

    graph: gtsam.NonlinearFactorGraph = field(default_factory=gtsam.NonlinearFactorGraph)
    """New factors."""
    values: gtsam.Values = field(default_factory=gtsam.Values)
    """Start values of the new variables."""
    times_s: dict[int, float] = field(default_factory=dict)
    """When each new variable is of, seconds: what a fixed-lag smoother asks for."""

    @property
    def timestamps(self) -> gtsam.FixedLagSmootherKeyTimestampMap:
        """`times_s` as GTSAM's smoothers take it."""
        stamps = gtsam.FixedLagSmootherKeyTimestampMap()
        for key, time_s in self.times_s.items():
            stamps.insert((key, time_s))
        return stamps


def reported_factor(
    key: int, place: Array, covariance: Array, poses: Sequence[tuple[int, gtsam.Pose3, Array]] = ()
) -> gtsam.NonlinearFactor:
    """A joint as it was found by other means than your graph, and how it goes with poses of yours.

    It is at `place` (3,) to `covariance` (3, 3) m² if each pose, by its key, is what it was taken for; with a turn
    and a way of one along its axes it goes by (3, 6) of that. The factor is linear, and of the poses alone it says
    nothing. ValueError for more than two poses.
    """
    if len(poses) > 2:
        raise ValueError(f"a joint goes with two poses at the most, got {len(poses)}")
    if not poses:
        return gtsam.PriorFactorPoint3(key, place, gaussian(covariance))
    root = np.linalg.inv(np.linalg.cholesky(covariance))
    here, terms = gtsam.Values(), [(key, root)]
    here.insert(key, place)
    for pose_key, pose, goes in poses:
        here.insert(pose_key, pose)
        terms.append((pose_key, -root @ goes))
    make: Any = gtsam.JacobianFactor  # its constructors take keys and matrices in turn
    linear = make(*(each for term in terms for each in term), np.zeros(3), gtsam.noiseModel.Unit.Create(3))
    return gtsam.LinearContainerFactor(linear, here)


class PeopleInGraph:
    """Makes increments; keeps of each person when each joint was there last, and nothing else."""

    def __init__(self, space: KeySpace, *, kernel: Kernel | None = None, link_s: float = 0.25) -> None:
        """Keys come from `space`. A joint that was away for longer than `link_s` begins anew: that must be less
        than the lag of a smoother, which has let go of what is older.
        """
        if not (np.isfinite(link_s) and link_s > 0):
            raise ValueError(f"link_s must be positive, got {link_s}")
        self.space, self._kernel, self._link_s = space, kernel, link_s
        self._last: dict[int, tuple[Array, NDArray[np.int64]]] = {}

    def add(self, sightings: Iterable[Sighting]) -> Increment:
        """The factors and start values of a frame: of each person a `Sighting`, later than those before.

        Joints that no camera saw are left out.
        """
        made = Increment()
        for one in sightings:
            self._add(one, made)
        self._last = {
            who: (time_s, frame)
            for who, (time_s, frame) in self._last.items()
            if not made.times_s or time_s.max() > max(made.times_s.values()) - self._link_s
        }
        return made

    def _add(self, one: Sighting, made: Increment) -> None:
        J = len(one.joints)
        placed = np.asarray(np.isfinite(one.joints).all(axis=-1))
        seen = np.isfinite(one.xy).all(axis=-1) & placed[:, None]
        last_s, last_frame = self._last.setdefault(one.person, (np.full(J, -np.inf), np.zeros(J, dtype=np.int64)))
        if not one.time_s > last_s.max(initial=-np.inf):
            raise ValueError(f"person {one.person}: frames must rise in time, {one.time_s} s comes too late")
        linked = one.time_s - last_s <= self._link_s
        there = np.flatnonzero(seen.any(axis=1))
        x, v = (
            keys(one.person, np.arange(J), one.frame) for keys in (self.space.positions, self.space.velocities)
        )
        near, start = isotropic(3, _START_M), isotropic(3, CONSTANT_VELOCITY.start[0])
        for joint in there.tolist():
            position, velocity = int(x[joint]), int(v[joint])
            if linked[joint]:
                before = one.person, joint, int(last_frame[joint])
                states = [self.space.positions(*before), position], [self.space.velocities(*before), velocity]
                times_s = [last_s[joint], one.time_s]
                made.graph.push_back(motion_factors(*states, times_s, one.density[joint])[0])
            else:
                made.graph.addPriorPoint3(position, one.joints[joint], near)
                made.graph.addPriorPoint3(velocity, np.zeros(3), start)
            made.values.insert(position, one.joints[joint])
            made.values.insert(velocity, np.zeros(3))
            made.times_s |= {position: one.time_s, velocity: one.time_s}
        for factor in self._seen(one, seen, x):
            made.graph.push_back(factor)
        last_s[there], last_frame[there] = one.time_s, one.frame

    def _seen(self, one: Sighting, seen: NDArray[np.bool_], x: NDArray[np.int64]) -> list[gtsam.NoiseModelFactor]:
        posed = {n: each for n, each in enumerate(one.cameras) if isinstance(each, PosedCamera)}
        still = {n: each for n, each in enumerate(one.cameras) if not isinstance(each, PosedCamera)}
        carried = np.array([n in posed for n in range(len(one.cameras))], dtype=bool)
        joint, view = np.nonzero(seen & ~carried)
        place = np.searchsorted(list(still), view)
        xy, sigmas = one.xy, one.sigmas_px
        factors = projection_factors(
            list(still.values()), place, x[joint], xy[joint, view], sigmas[joint, view], self._kernel
        )
        joint, view = np.nonzero(seen & carried)
        on = [posed[each] for each in view.tolist()]
        return factors + posed_projection_factors(
            [each.calibration for each in posed.values()],
            np.searchsorted(list(posed), view),
            np.array([each.pose_key for each in on], dtype=np.int64),
            [each.body_T_sensor for each in on],
            x[joint],
            xy[joint, view],
            sigmas[joint, view],
            self._kernel,
        )
