"""Poses of what carries cameras, from the people in a window: joints and poses together in one factor graph.

Joints of a frame are points; every camera that sees one is a projection factor, robust: of a camera that stands
still on the joint, of one that is carried on the joint and its carrier's pose. Between the poses are the steps of
the odometry. `Trajectories` keeps what each window says of the poses, its joints eliminated, for the whole
recording.
"""

from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

import gtsam
import numpy as np
from numpy.typing import NDArray

from factors import (
    DEFAULT_WIDTH_SIGMA,
    camera_keys,
    gaussian,
    isotropic,
    joint_keys,
    make_calibration,
    make_camera,
    odometry_factors,
    posed_projection_factors,
    projection_factors,
    robust_kernel,
)
from shapepose_fg.core.arrays import Array, Index, Mask, Whole
from shapepose_fg.core.camera import Rig, Views
from shapepose_fg.core.observations import Observations
from shapepose_fg.estimation.carried_error import POSES_LAST_S
from shapepose_fg.estimation.linearisation import ObservationConfig, linearise, observation_sigmas, triangulate

CameraFactors = Callable[["TrajectoryGraph", NDArray[np.int64]], Iterable[gtsam.NonlinearFactor]]
"""Your own factors on poses, made from a window's keys (T, B), T frames and B carriers."""
_REACHES_M = (0.5, 0.15, 0.15)
"""How far, round by round, a detection may be from a joint and still counts: at first an odometry may be off."""
_WEAKEST_M = 0.15
"""A joint that its views place worse than this, in its worst direction, says nothing of cameras."""
_SAME_PERSON = 2.5
"""Joints of one person in one view err together: what so many say is one."""
_ERRORS = ((0.45, 3.5), (0.25, 0.25))
"""Shares of a detector's errors that last, and how long, seconds; all as in `calibration/refinement.py`."""
_AVERAGED_S = 1.0
"""Time for which an odometry of 1 % is better than what people say of a pose: over this, errors would average
out."""
_ANYWHERE_M = 10.0
"""Joints are about there: without it one that ends behind its cameras would make the system singular."""
_GAUGE = np.diag([1e-5**2] * 3 + [1e-4**2] * 3)
"""Where no camera stands still, the world is that in which the first carrier starts."""
_LEAST = np.diag([1e-6**2] * 3 + [1e-5**2] * 3)
"""A carrier that stands still in an odometry that says so; rad and m."""


def dilution(step_s: float, over_s: float = _AVERAGED_S) -> float:
    """How many of the errors of one detection, of joints and of frames `step_s` apart, are one error, where poses
    up to `over_s` apart are known against each other better than by people.
    """
    lags = np.arange(1, max(int(over_s / step_s), 1) + 1) * step_s
    lasting = sum(share * np.exp(-lags / lasts).sum() for share, lasts in _ERRORS)
    return float(_SAME_PERSON * (1 + 2 * lasting))


@dataclass(frozen=True)
class Mounted:
    """How the cameras of T frames stand on their carriers, and what the odometry says of these."""

    rig: Rig
    """The cameras, with the trajectories as they were given."""
    frames: Whole
    """(T,) rising."""
    time_s: Array
    """(T, V) when each view was taken."""

    @cached_property
    def odometry(self) -> Array:
        """(T, B, 4, 4) world from carrier at the frames' times, as given."""
        return np.stack([each.at(self.time_s.mean(axis=1)) for each in self.rig.trajectories], axis=1)

    @cached_property
    def sensors(self) -> Array:
        """(T, V, 4, 4) from carrier, at its frame's time, to camera, at its own; unit where it stands still."""
        sensors, on = np.tile(np.eye(4), (*self.time_s.shape, 1, 1)), self.rig.carrier
        own = self.rig.poses(self.time_s)[:, on >= 0]
        sensors[:, on >= 0] = np.linalg.inv(self.odometry[:, on[on >= 0]]) @ own
        return sensors

    def keys(self) -> NDArray[np.int64]:
        """(T, B) key of each pose, `Pose3`, world from carrier: `factors.camera_key(carrier, frame)`."""
        return np.stack([camera_keys(each, self.frames) for each in range(self.odometry.shape[1])], axis=1)

    def views(self, poses: Array, at: Index) -> Views:
        """The cameras of N rows at frames `at` (N,), places in `frames`, when the carriers are at `poses`."""
        on, wTc = self.rig.carrier, np.stack([camera.wTc for camera in self.rig.cameras])
        wTc = np.tile(wTc, (len(at), 1, 1, 1))
        wTc[:, on >= 0] = poses[at][:, on[on >= 0]] @ self.sensors[at][:, on >= 0]
        cTw = np.ascontiguousarray(np.linalg.inv(wTc)[..., :3, :], dtype=np.float64)
        return Views(self.rig.K, cTw, self.rig.image_sizes)

    def steps(self, carrier: int) -> list[gtsam.NonlinearFactor]:
        """The odometry of one carrier, frame by frame."""
        poses, trajectory = self.odometry[:, carrier], self.rig.trajectories[carrier]
        covariances = trajectory.drifted(poses, self.time_s.mean(axis=1)) + _LEAST
        return odometry_factors(self.keys()[:, carrier], poses, covariances)

    def known(self, carrier: int) -> list[gtsam.NonlinearFactor]:
        """What is known of one carrier's poses: where it starts; where SLAM has it, every few seconds."""
        trajectory, keys, middle = (
            self.rig.trajectories[carrier],
            self.keys()[:, carrier],
            self.time_s.mean(axis=1),
        )
        covariance, at = trajectory.start_covariance(), [0]
        if carrier == 0 and (self.rig.carrier >= 0).all() and trajectory.covariance is None:
            covariance = _GAUGE
        covariances = np.tile(covariance, (len(keys), 1, 1))
        if trajectory.covariance is not None:
            at = np.unique(np.floor((middle - middle[0]) / POSES_LAST_S), return_index=True)[1].tolist()
            covariances = trajectory.covariance_at(middle)
        poses = self.odometry[:, carrier]
        return [
            gtsam.PriorFactorPose3(
                int(keys[n]), gtsam.Pose3(poses[n]), gaussian(symmetric(covariances[n]) + _LEAST)
            )
            for n in at
        ]


class TrajectoryGraph:
    """The carriers of cameras in T frames, and the joints that tell where these are."""

    def __init__(
        self,
        mounted: Mounted,
        rows: Observations,
        start: Array,
        config: ObservationConfig,
        joints: Sequence[str],
        camera_factors: CameraFactors | None = None,
    ) -> None:
        """`rows` are N people of the frames of `mounted`, whose carriers are about at `start` (T, B, 4, 4)."""
        self.mounted = mounted
        """Frames, cameras, odometry."""
        self.rows = rows
        """Who was seen."""
        self.keys = mounted.keys()
        """(T, B) keys of the poses."""
        self.poses = start.copy()
        """(T, B, 4, 4) the solution, world from carrier."""
        self.graph = gtsam.NonlinearFactorGraph()
        """What people, and factors of your own, say of poses and joints: no odometry."""
        self.values = gtsam.Values()
        """Poses, and the joints that are in the graph."""
        self._config, self._names, self._own = config, joints, camera_factors
        self._at = np.searchsorted(mounted.frames, rows.frame)
        self._joint_keys = np.zeros(rows.confidence.shape[:2], dtype=np.int64)
        for track in np.unique(rows.track).tolist():
            mine = rows.track == track
            frames = rows.frame[mine, None]
            self._joint_keys[mine] = joint_keys(track, np.arange(rows.confidence.shape[1]), frames)
        self._lenses = [make_calibration(camera.K) for camera in mounted.rig.cameras]
        self._still = [make_camera(camera.K, camera.wTc) for camera in mounted.rig.cameras]

    def solve(self, anchors: gtsam.NonlinearFactorGraph) -> None:
        """Poses and joints together, by Levenberg-Marquardt; `anchors` are odometry and what was known before."""
        for reach_m in _REACHES_M:
            joints = self._build(reach_m)
            if len(joints) == 0 and self._own is None:
                return
            both = gtsam.NonlinearFactorGraph(anchors)
            both.push_back(self.graph)
            # Ceres's way damps each parameter by its own information: radians and metres stand side by side.
            parameters = gtsam.LevenbergMarquardtParams.CeresDefaults()
            parameters.setMaxIterations(10)
            parameters.setRelativeErrorTol(1e-4)
            parameters.setOrdering(gtsam.Ordering([*joints, *self.keys.ravel().tolist()]))
            self.values = gtsam.LevenbergMarquardtOptimizer(both, self.values, parameters).optimize()
            self.poses = poses_of(self.values, self.keys)

    def of_poses(self) -> list[gtsam.NonlinearFactor]:
        """What the graph says of the poses alone, linear around the solution, all joints eliminated."""
        joints = sorted(set(self.graph.keyVector()) - set(self.keys.ravel().tolist()))
        if self.graph.size() == 0:
            return []
        linear = self.graph.linearize(self.values)
        _, rest = linear.eliminatePartialSequential(gtsam.Ordering(joints))
        here = gtsam.Values()
        for key, pose in zip(self.keys.ravel().tolist(), self.poses.reshape(-1, 4, 4), strict=True):
            here.insert(key, gtsam.Pose3(pose))
        factors = (rest.at(n) for n in range(rest.size()))
        return [
            gtsam.LinearContainerFactor(each, here) for each in factors if each is not None and each.size() > 0
        ]

    def _build(self, reach_m: float) -> list[int]:
        """Make graph and values around the present poses; returns the keys of the joints that are in it."""
        rows, mounted, config = self.rows, self.mounted, self._config
        self.graph, self.values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        for key, pose in zip(self.keys.ravel().tolist(), self.poses.reshape(-1, 4, 4), strict=True):
            self.values.insert(key, gtsam.Pose3(pose))
        chosen, points, sigmas = self._chosen(reach_m)
        row, joint, view = np.nonzero(chosen)
        at, on = self._at[row], mounted.rig.carrier[view]
        step_s = float(np.median(np.diff(mounted.time_s.mean(axis=1)))) if len(mounted.frames) > 1 else 1.0
        scale = np.sqrt(dilution(step_s))
        # A lasting error is no outlier: in pixels the kernel is as wide as before.
        name = config.robust_kernel
        kernel = robust_kernel(name, None if name is None else DEFAULT_WIDTH_SIGMA[name] / scale)
        keys, xy, sigma = self._joint_keys[row, joint], rows.xy[chosen], scale * sigmas[chosen]
        still, moving = on < 0, np.flatnonzero(on >= 0)
        seen = projection_factors(self._still, view[still], keys[still], xy[still], sigma[still], kernel)
        sensors = list(map(gtsam.Pose3, mounted.sensors[at[moving], view[moving]]))
        poses = self.keys[at[moving], on[moving]]
        seen += posed_projection_factors(
            self._lenses, view[moving], poses, sensors, keys[moving], xy[moving], sigma[moving], kernel
        )
        deque(map(self.graph.add, seen), maxlen=0)
        there = chosen.any(axis=2)
        joints = self._joint_keys[there].tolist()
        deque(map(self.values.insert, joints, points[there]), maxlen=0)
        near = isotropic(3, _ANYWHERE_M)
        deque(map(self.graph.addPriorPoint3, joints, points[there], [near] * len(joints)), maxlen=0)
        for factor in self._own(self, self.keys) if self._own is not None else ():
            self.graph.add(factor)
        return joints

    def _chosen(self, reach_m: float) -> tuple[Mask, Array, Array]:
        """(N, J, V) the observations that tell of poses, and the joints (N, J, 3) and sigmas (N, J, V) in pixels.

        A joint tells of them if two see it that do not move together.
        """
        rows, views = self.rows, self.mounted.views(self.poses, self._at)
        placed = Observations(rows.xy, rows.confidence, np.full(rows.initial.shape, np.nan))
        points = triangulate(placed, views, self._config)
        sigmas = observation_sigmas(rows, points, views, self._config, self._names)
        evidence = linearise(rows, sigmas, points, views, self._config)
        evidence = linearise(rows, sigmas, evidence.target, views, self._config)
        depth = views.pixels(evidence.target)[1]
        away_m = np.linalg.norm(evidence.residual_px, axis=-1) * depth / views.focal[:, None]
        with np.errstate(invalid="ignore"):
            chosen = rows.seen & (away_m < reach_m) & (evidence.sigma_m < _WEAKEST_M)[..., None]
        on = self.mounted.rig.carrier
        groups = np.sum([chosen[..., on == each].any(axis=-1) for each in np.unique(on).tolist()], axis=0)
        return chosen & (groups >= 2)[..., None], evidence.target, sigmas


def poses_of(values: gtsam.Values, keys: NDArray[np.int64]) -> Array:
    """(..., 4, 4) the poses of `keys` (...)."""
    poses = [values.atPose3(key).matrix() for key in keys.ravel().tolist()]
    return np.array(poses).reshape(*keys.shape, 4, 4)


def symmetric(covariance: Array) -> Array:
    """Return a covariance without what rounding left on one side of the diagonal."""
    return (covariance + covariance.swapaxes(-1, -2)) / 2
