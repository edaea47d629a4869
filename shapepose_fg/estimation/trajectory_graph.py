"""Poses of camera carriers from the people in a window: joints and poses in one factor graph.

Joints of a frame are points; every detection is a robust projection factor: for a static camera on
the joint, for a carried one on the joint and its carrier's pose. Odometry factors connect
consecutive poses. `pipeline.trajectories` keeps each window's marginal on the poses, with joints
eliminated, for the whole recording.
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
    format_key,
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
from shapepose_fg.estimation.camera_pose_uncertainty import POSES_LAST_S
from shapepose_fg.estimation.frame_graph import UNDETERMINED_M
from shapepose_fg.estimation.gated_views import (
    ObservationConfig,
    linearise,
    observation_sigmas,
    triangulate,
)
from shapepose_fg.estimation.user_factors import (
    UserFactor,
    items_of,
    name_of,
    refuse_unsuitable,
)

CameraFactors = Callable[["TrajectoryGraph", NDArray[np.int64]], Iterable[gtsam.NonlinearFactor]]
"""Function that makes your own factors on poses, from a window's keys (T, B), T frames and B
carriers."""
_REACHES_M = (0.5, 0.15, 0.15)
"""Maximum distance of a used detection from its joint, by round, m; the odometry may be wrong at
first."""
WEAKEST_M = 0.15
"""Maximum standard deviation, in the worst direction, of a joint used for camera poses, m."""
_SAME_PERSON = 2.5
"""Number of joints of a person in a view that count as one, because their errors are correlated."""
_ERRORS = ((0.45, 3.5), (0.25, 0.25), (0.30, 1e-9))
"""Shares of a detector's errors, and their time constants, s: measured on simulated recordings,
whose detector has Shelf's statistics (0.8 after a frame, 0.35 after a second, 0.1 after four)."""
_AVERAGED_S = 1.0
"""Time, s, over which an odometry of 1 % is more accurate than people's constraints on a pose;
errors average out over it."""
_GAUGE = np.diag([1e-5**2] * 3 + [1e-4**2] * 3)
"""Without a static camera, the world is the first carrier's initial frame; this is its prior
covariance."""
_LEAST = np.diag([1e-6**2] * 3 + [1e-5**2] * 3)
"""Minimum covariance of an odometry step, for carriers at rest; rad² and m²."""


def dilution(step_s: float, over_s: float = _AVERAGED_S) -> float:
    """Number of correlated detection errors that count as one independent error.

    Errors are correlated between joints, and between frames, which are `step_s` apart. `over_s` is
    the time within which odometry gives relative poses more accurately than people do.
    """
    lags = np.arange(1, max(int(over_s / step_s), 1) + 1) * step_s
    return float(correlated(0.0) + 2 * correlated(lags).sum())


def correlated(apart_s: NDArray[np.floating] | float) -> Array:
    """(...) correlation of a detector's errors in frames `apart_s` (...), seconds, apart, times the
    number of joints of a person in a view that count as one.
    """
    shares = [share * np.exp(-np.abs(apart_s) / lasts) for share, lasts in _ERRORS]
    return _SAME_PERSON * np.sum(shares, axis=0)


@dataclass(frozen=True)
class Mounted:
    """Cameras of T frames on their carriers, with the odometry."""

    rig: Rig
    """The cameras, with the given trajectories."""
    frames: Whole
    """(T,) frames, ascending."""
    time_s: Array
    """(T, V) exposure time of each view, seconds."""

    @cached_property
    def odometry(self) -> Array:
        """(T, B, 4, 4) world from carrier at the frames' times, as given."""
        return np.stack(
            [each.at(self.time_s.mean(axis=1)) for each in self.rig.trajectories], axis=1
        )

    @cached_property
    def sensors(self) -> Array:
        """(T, V, 4, 4) carrier, at its frame's time, from camera, at its own time; identity for
        static cameras.
        """
        sensors, on = np.tile(np.eye(4), (*self.time_s.shape, 1, 1)), self.rig.carrier
        own = self.rig.poses(self.time_s)[:, on >= 0]
        sensors[:, on >= 0] = np.linalg.inv(self.odometry[:, on[on >= 0]]) @ own
        return sensors

    def keys(self) -> NDArray[np.int64]:
        """(T, B) key of each pose, `Pose3`, world from carrier: `factors.camera_key(carrier,
        frame)`.
        """
        return np.stack(
            [camera_keys(each, self.frames) for each in range(self.odometry.shape[1])], axis=1
        )

    def views(self, poses: Array, at: Index) -> Views:
        """The cameras of N rows at frames `at` (N,), indices in `frames`, with carriers
        at `poses`.
        """
        on, wTc = self.rig.carrier, np.stack([camera.wTc for camera in self.rig.cameras])
        wTc = np.tile(wTc, (len(at), 1, 1, 1))
        wTc[:, on >= 0] = poses[at][:, on[on >= 0]] @ self.sensors[at][:, on >= 0]
        cTw = np.ascontiguousarray(np.linalg.inv(wTc)[..., :3, :], dtype=np.float64)
        return Views(self.rig.K, cTw, self.rig.image_sizes)

    def steps(self, carrier: int) -> list[gtsam.NonlinearFactor]:
        """Odometry factors of one carrier, frame by frame."""
        poses, trajectory = self.odometry[:, carrier], self.rig.trajectories[carrier]
        covariances = trajectory.drifted(poses, self.time_s.mean(axis=1)) + _LEAST
        return odometry_factors(self.keys()[:, carrier], poses, covariances)

    def known(self, carrier: int) -> list[gtsam.NonlinearFactor]:
        """Priors on one carrier's poses: its start, and poses from SLAM every few seconds."""
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
            at = np.unique(np.floor((middle - middle[0]) / POSES_LAST_S), return_index=True)[
                1
            ].tolist()
            covariances = trajectory.covariance_at(middle)
        poses = self.odometry[:, carrier]
        return [
            gtsam.PriorFactorPose3(
                int(keys[n]), gtsam.Pose3(poses[n]), gaussian(symmetric(covariances[n]) + _LEAST)
            )
            for n in at
        ]


class TrajectoryGraph:
    """Poses of the carriers of cameras in T frames, with the joints that constrain them."""

    def __init__(
        self,
        mounted: Mounted,
        rows: Observations,
        start: Array,
        config: ObservationConfig,
        joints: Sequence[str],
        camera_factors: CameraFactors | None = None,
    ) -> None:
        """`rows` are N people in the frames of `mounted`, with carriers initially at `start` (T, B,
        4, 4).
        """
        self.mounted = mounted
        """Frames, cameras, odometry."""
        self.rows = rows
        """The observed people."""
        self.keys = mounted.keys()
        """(T, B) keys of the poses."""
        self.poses = start.copy()
        """(T, B, 4, 4) the solution, world from carrier."""
        self.graph = gtsam.NonlinearFactorGraph()
        """Factors of people, and your own, on poses and joints, without odometry."""
        self.values = gtsam.Values()
        """Poses, and the joints in the graph."""
        self._config, self._names, self._own = config, joints, camera_factors
        self._at = np.searchsorted(mounted.frames, rows.frame)
        self._joint_keys = np.zeros(rows.confidence.shape[:2], dtype=np.int64)
        for track in np.unique(rows.track).tolist():
            of_track = rows.track == track
            frames = rows.frame[of_track, None]
            self._joint_keys[of_track] = joint_keys(
                track, np.arange(rows.confidence.shape[1]), frames
            )
        self._lenses = [make_calibration(camera.K) for camera in mounted.rig.cameras]
        self._still = [make_camera(camera.K, camera.wTc) for camera in mounted.rig.cameras]

    def solve(self, anchors: gtsam.NonlinearFactorGraph) -> None:
        """Solve poses and joints jointly, by Levenberg-Marquardt; `anchors` are odometry and
        earlier marginals.
        """
        for reach_m in _REACHES_M:
            joints = self._build(reach_m)
            if len(joints) == 0 and self._own is None:
                return
            both = gtsam.NonlinearFactorGraph(anchors)
            both.push_back(self.graph)
            self.values = optimised(both, self.values, [*joints, *self.keys.ravel().tolist()])
            self.poses = poses_of(self.values, self.keys)

    def of_poses(self) -> list[gtsam.NonlinearFactor]:
        """Marginal of the graph on the poses, linearised at the solution, with all joints
        eliminated.
        """
        joints = sorted(set(self.graph.keyVector()) - set(self.keys.ravel().tolist()))
        if self.graph.size() == 0:
            return []
        linear = self.graph.linearize(self.values)
        _, rest = linear.eliminatePartialSequential(gtsam.Ordering(joints))
        values = gtsam.Values()
        for key, pose in zip(self.keys.ravel().tolist(), self.poses.reshape(-1, 4, 4), strict=True):
            values.insert(key, gtsam.Pose3(pose))
        factors = (rest.at(n) for n in range(rest.size()))
        return [
            gtsam.LinearContainerFactor(each, values)
            for each in factors
            if each is not None and each.size() > 0
        ]

    def _build(self, reach_m: float) -> list[int]:
        """Build graph and values at the current poses; returns the keys of the joints used."""
        rows, mounted, config = self.rows, self.mounted, self._config
        self.graph, self.values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        for key, pose in zip(self.keys.ravel().tolist(), self.poses.reshape(-1, 4, 4), strict=True):
            self.values.insert(key, gtsam.Pose3(pose))
        chosen, points, sigmas = self._chosen(reach_m)
        row, joint, view = np.nonzero(chosen)
        at, on = self._at[row], mounted.rig.carrier[view]
        step_s = (
            float(np.median(np.diff(mounted.time_s.mean(axis=1))))
            if len(mounted.frames) > 1
            else 1.0
        )
        scale = np.sqrt(dilution(step_s))
        # A correlated error is not an outlier: the kernel's width in pixels is unchanged.
        name = config.robust_kernel
        kernel = robust_kernel(name, None if name is None else DEFAULT_WIDTH_SIGMA[name] / scale)
        keys, xy, sigma = self._joint_keys[row, joint], rows.xy[chosen], scale * sigmas[chosen]
        still, moving = on < 0, np.flatnonzero(on >= 0)
        seen = projection_factors(
            self._still, view[still], keys[still], xy[still], sigma[still], kernel
        )
        sensors = list(map(gtsam.Pose3, mounted.sensors[at[moving], view[moving]]))
        poses = self.keys[at[moving], on[moving]]
        seen += posed_projection_factors(
            self._lenses,
            view[moving],
            poses,
            sensors,
            keys[moving],
            xy[moving],
            sigma[moving],
            kernel,
        )
        deque(map(self.graph.add, seen), maxlen=0)
        used = chosen.any(axis=2)
        joints = self._joint_keys[used].tolist()
        deque(map(self.values.insert, joints, points[used]), maxlen=0)
        near = isotropic(3, UNDETERMINED_M)
        deque(map(self.graph.addPriorPoint3, joints, points[used], [near] * len(joints)), maxlen=0)
        if self._own is not None:
            self._add_own(self._own)
        return joints

    def _add_own(self, function: CameraFactors) -> None:
        """Add the user's factors; ValueError for one that cannot be used, naming the function."""
        name = name_of(function)
        for factor in items_of(function(self, self.keys), name):
            refuse_unsuitable(factor, name)
            each = UserFactor(factor, tuple(factor.keys()), name)
            for key in each.keys:
                if not self.values.exists(key):
                    raise ValueError(
                        f"your factor ({name}) uses {format_key(key)}, which is not in this "
                        "window: use its `keys`, or joints in `graph.values`"
                    )
            if problem := each.problem(self.values):
                raise ValueError(problem)
            self.graph.add(factor)

    def _chosen(self, reach_m: float) -> tuple[Mask, Array, Array]:
        """(N, J, V) observations that constrain camera poses, and the joints (N, J, 3), metres, and
        sigmas (N, J, V), pixels.

        A joint does if two cameras that are not rigidly connected see it.
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
            chosen = rows.seen & (away_m < reach_m) & (evidence.sigma_m < WEAKEST_M)[..., None]
        on = self.mounted.rig.carrier
        groups = np.sum(
            [chosen[..., on == each].any(axis=-1) for each in np.unique(on).tolist()], axis=0
        )
        return chosen & (groups >= 2)[..., None], evidence.target, sigmas


def optimised(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, order: Sequence[int]
) -> gtsam.Values:
    """The solution by Levenberg-Marquardt; `order` are the keys in order of elimination."""
    # Ceres' damping uses each parameter's own information, since radians, metres and pixels are
    # mixed.
    parameters = gtsam.LevenbergMarquardtParams.CeresDefaults()
    parameters.setMaxIterations(10)
    parameters.setRelativeErrorTol(1e-4)
    parameters.setOrdering(gtsam.Ordering(order))
    return gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()


def poses_of(values: gtsam.Values, keys: NDArray[np.int64]) -> Array:
    """(..., 4, 4) the poses of `keys` (...)."""
    poses = [values.atPose3(key).matrix() for key in keys.ravel().tolist()]
    return np.array(poses).reshape(*keys.shape, 4, 4)


def symmetric(covariance: Array) -> Array:
    """Return the covariance made exactly symmetric: rounding errors are removed."""
    return (covariance + covariance.swapaxes(-1, -2)) / 2
