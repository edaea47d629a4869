"""Adds people to a factor graph of your own, frame by frame, as increments for ISAM2 or a fixed-lag
smoother.

A joint has a position and a velocity in each frame. Detections are robust projection factors: on
the joint only, if the camera is fixed; on the joint and a pose variable of your graph, if that pose
carries the camera. Between frames joints follow white noise on acceleration (`factors.motion`).
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
"""Prior standard deviation of a new joint around its initial position, m. It is much weaker than
two cameras. It is needed because ISAM2 reports a singular system for a joint that one camera sees
and that is weakly constrained along the ray: it did with 10 m, and not with 3 m."""


@dataclass(frozen=True)
class PosedCamera:
    """A camera on a pose variable of your graph."""

    calibration: gtsam.Cal3_S2
    """Intrinsics; image points are undistorted."""
    pose_key: int
    """Key of a `Pose3`: world from camera, or world from the camera's carrier."""
    body_T_sensor: gtsam.Pose3 = field(default_factory=gtsam.Pose3)
    """Pose of the camera on its carrier (carrier from camera)."""


@dataclass(frozen=True)
class Sighting:
    """Detections of one person in one frame, by V cameras."""

    person: int
    """Number of the person, for keys."""
    frame: int
    """Number of the frame, for keys."""
    time_s: float
    """Time of the frame, seconds."""
    joints: Array
    """(J, 3) initial positions of the joints, metres in the world; a joint with NaN is left out."""
    xy: Array
    """(J, V, 2) detections, undistorted pixels; NaN if the camera did not detect the joint."""
    sigmas_px: Array
    """(J, V) standard deviation of the detections per axis, pixels."""
    density: Array
    """(J,) power spectral density of the joints' accelerations, m²/s³."""
    cameras: Sequence[gtsam.PinholeCameraCal3_S2 | PosedCamera]
    """The V cameras, as of this frame."""

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
    """The factors and variables that one frame adds to a graph."""

    graph: gtsam.NonlinearFactorGraph = field(default_factory=gtsam.NonlinearFactorGraph)
    """New factors."""
    values: gtsam.Values = field(default_factory=gtsam.Values)
    """Initial values of the new variables."""
    times_s: dict[int, float] = field(default_factory=dict)
    """Time of each new variable, seconds, by key: required by fixed-lag smoothers."""

    @property
    def timestamps(self) -> gtsam.FixedLagSmootherKeyTimestampMap:
        """`times_s` in the type that GTSAM's fixed-lag smoothers take."""
        stamps = gtsam.FixedLagSmootherKeyTimestampMap()
        for key, time_s in self.times_s.items():
            stamps.insert((key, time_s))
        return stamps


def reported_factor(
    key: int, place: Array, covariance: Array, poses: Sequence[tuple[int, gtsam.Pose3, Array]] = ()
) -> gtsam.NonlinearFactor:
    """Joint position that was estimated outside of your graph, and its dependence on poses of your
    graph.

    The joint is at `place` (3,), metres, with `covariance` (3, 3), m², given the poses with which
    it was estimated. Each entry of `poses` has a key, that pose, and the (3, 6) derivative of the
    joint with respect to rotation and translation along the axes of the pose. The factor is linear,
    and does not constrain the poses alone. ValueError for more than two poses.
    """
    if len(poses) > 2:
        raise ValueError(f"a joint may be attached to at most two poses, got {len(poses)}")
    if not poses:
        return gtsam.PriorFactorPoint3(key, place, gaussian(covariance))
    root = np.linalg.inv(np.linalg.cholesky(covariance))
    point, terms = gtsam.Values(), [(key, root)]
    point.insert(key, place)
    for pose_key, pose, goes in poses:
        point.insert(pose_key, pose)
        terms.append((pose_key, -root @ goes))
    make: Any = gtsam.JacobianFactor  # its constructors take keys and matrices alternately
    linear = make(
        *(each for term in terms for each in term), np.zeros(3), gtsam.noiseModel.Unit.Create(3)
    )
    return gtsam.LinearContainerFactor(linear, point)


class PeopleInGraph:
    """Makes increments. Its only state is the last frame and time of each joint of each person."""

    def __init__(
        self, space: KeySpace, *, kernel: Kernel | None = None, link_s: float = 0.25
    ) -> None:
        """Keys are taken from `space`. If a joint was not seen for longer than `link_s`, seconds,
        no motion factor connects it with its previous state. `link_s` must be shorter than the lag
        of a smoother, which has marginalised older states.
        """
        if not (np.isfinite(link_s) and link_s > 0):
            raise ValueError(f"link_s must be positive, got {link_s}")
        self.space, self._kernel, self._link_s = space, kernel, link_s
        self._last: dict[int, tuple[Array, NDArray[np.int64]]] = {}

    def add(self, sightings: Iterable[Sighting]) -> Increment:
        """The factors and initial values of a frame: one `Sighting` for each person, later than all
        previous ones.

        Joints that no camera saw are left out.
        """
        made = Increment()
        for one in sightings:
            self._add(one, made)
        self._last = {
            person: (time_s, frame)
            for person, (time_s, frame) in self._last.items()
            if not made.times_s or time_s.max() > max(made.times_s.values()) - self._link_s
        }
        return made

    def _add(self, one: Sighting, made: Increment) -> None:
        J = len(one.joints)
        placed = np.asarray(np.isfinite(one.joints).all(axis=-1))
        seen = np.isfinite(one.xy).all(axis=-1) & placed[:, None]
        last_s, last_frame = self._last.setdefault(
            one.person, (np.full(J, -np.inf), np.zeros(J, dtype=np.int64))
        )
        if not one.time_s > last_s.max(initial=-np.inf):
            raise ValueError(
                f"person {one.person}: frames must be in order of time, but {one.time_s} s is not"
            )
        linked = one.time_s - last_s <= self._link_s
        present = np.flatnonzero(seen.any(axis=1))
        x, v = (
            keys(one.person, np.arange(J), one.frame)
            for keys in (self.space.positions, self.space.velocities)
        )
        near, start = isotropic(3, _START_M), isotropic(3, CONSTANT_VELOCITY.start[0])
        for joint in present.tolist():
            position, velocity = int(x[joint]), int(v[joint])
            if linked[joint]:
                before = one.person, joint, int(last_frame[joint])
                states = (
                    [self.space.positions(*before), position],
                    [self.space.velocities(*before), velocity],
                )
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
        last_s[present], last_frame[present] = one.time_s, one.frame

    def _seen(
        self, one: Sighting, seen: NDArray[np.bool_], x: NDArray[np.int64]
    ) -> list[gtsam.NoiseModelFactor]:
        posed = {n: each for n, each in enumerate(one.cameras) if isinstance(each, PosedCamera)}
        still = {n: each for n, each in enumerate(one.cameras) if not isinstance(each, PosedCamera)}
        carried = np.array([n in posed for n in range(len(one.cameras))], dtype=bool)
        joint, view = np.nonzero(seen & ~carried)
        place = np.searchsorted(list(still), view)
        xy, sigmas = one.xy, one.sigmas_px
        factors = projection_factors(
            list(still.values()),
            place,
            x[joint],
            xy[joint, view],
            sigmas[joint, view],
            self._kernel,
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
