"""Increments for your own graph from reconstructed people: joints with their observations, frame by
frame.
"""

from collections.abc import Callable, Iterator

import gtsam
import numpy as np

from factors import (
    DEFAULT_WIDTH_SIGMA,
    Increment,
    KeySpace,
    PeopleInGraph,
    PosedCamera,
    Sighting,
    make_calibration,
    make_camera,
    reported_factor,
    robust_kernel,
)
from shapepose_fg.core.arrays import Array
from shapepose_fg.core.camera import Rig, Views
from shapepose_fg.core.decompositions import raise_eigenvalues
from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.estimation.camera_pose_uncertainty import reported_with_poses
from shapepose_fg.estimation.gated_views import ObservationConfig, observation_sigmas
from shapepose_fg.estimation.motion_densities import MotionModel
from shapepose_fg.estimation.trajectory_graph import Mounted, dilution

_MAP_S = 15.0
"""Time over which landmarks keep a map consistent, s, longer than a detector's errors are
correlated."""
PoseKey = Callable[[str, int], int]
"""Function from a trajectory's name and a frame to the key of its `Pose3`, world from carrier."""


class JoinedPeople:
    """Converts rows of results, as they arrive, into factors and initial values for a graph with
    camera poses.
    """

    def __init__(
        self,
        rig: Rig,
        space: KeySpace,
        pose_key: PoseKey,
        *,
        step_s: float,
        config: ObservationConfig | None = None,
        link_s: float = 0.25,
    ) -> None:
        """`rig` is that of the reconstruction; its cameras with a `carrier` get their poses from
        your graph, all others are static. `step_s` is the interval between the given frames: as
        detectors' errors are correlated, closer frames have a smaller weight, and joint
        covariances, given the poses, are too wide. `link_s` as in `PeopleInGraph`.
        """
        self._rig, self._pose_key = rig, pose_key
        self._config = ObservationConfig() if config is None else config
        self._together, name = dilution(step_s, _MAP_S), self._config.robust_kernel
        scale = np.sqrt(self._together)
        # A correlated error is not an outlier: in pixels the kernel's width is that for the
        # detector's own sigma.
        kernel = robust_kernel(name, None if name is None else DEFAULT_WIDTH_SIGMA[name] / scale)
        self._people = PeopleInGraph(space, kernel=kernel, link_s=link_s)
        self._lenses = [make_calibration(camera.K) for camera in rig.cameras]
        self._still = [make_camera(camera.K, camera.wTc) for camera in rig.cameras]

    def increments(self, people: Reconstruction) -> Iterator[tuple[int, Increment]]:
        """Yield frame number and increment for each frame of `people`, in order; `people` must have
        observations.

        Besides the joints that constrain poses, there are the reported ones (`KeySpace.reported`),
        which include body, motion and all frames, and move with your poses. Raises ValueError if
        observations or times are missing.
        """
        if len(people) == 0:
            return
        if people.observations is None or not np.isfinite(people.time_s).all():
            raise ValueError(
                "people need observations and times: reconstruct over time, and keep "
                "observations.npz"
            )
        table, motion = people.observations, MotionModel.load(tuple(people.joint_names.tolist()))
        # Scaled like the observations, so that joints are smoothed as if errors were independent in
        # each frame.
        density = self._together * motion.density(
            np.linalg.norm(np.nan_to_num(people.velocity), axis=-1)
        )
        rows = table.observations(people.joints, people.time_s)
        views = Views.of(self._rig, rows.time_s)
        seen = rows, people.joints, views, self._config, people.joint_names.tolist()
        sigmas = np.sqrt(self._together) * observation_sigmas(*seen)
        # Observation at the row's time, by the camera at its own exposure pose.
        xy = np.where(
            table.used[..., None], views.pixels(people.joints)[0] - table.residual_px, np.nan
        )
        goes = reported_with_poses(*seen) if views.carried is not None else None
        for frame in np.unique(people.frame).tolist():
            in_frame = np.flatnonzero(people.frame == frame)
            cameras = self._cameras(frame, rows.time_s[in_frame[0]])
            made = self._people.add(
                Sighting(
                    int(people.person[n]), frame, float(people.time_s[n]), people.joints[n], xy[n],
                    sigmas[n], density[n], cameras,
                )
                for n in in_frame.tolist()
            )  # fmt: skip
            for n in in_frame.tolist():
                self._report(people, n, views, None if goes is None else goes[n], made)
            yield frame, made

    def _report(
        self, people: Reconstruction, n: int, views: Views, goes: Array | None, made: Increment
    ) -> None:
        """Add the reported joints of a row."""
        person, frame, time_s = int(people.person[n]), int(people.frame[n]), float(people.time_s[n])
        X, C = people.joints[n], people.covariance[n]
        keys = self._people.space.reported(person, np.arange(len(X)), frame)
        for j in np.flatnonzero(
            np.isfinite(X).all(axis=-1) & np.isfinite(C).all(axis=(-2, -1))
        ).tolist():
            key, own, poses = int(keys[j]), C[j], []
            if goes is not None and views.carried is not None:
                carried = views.carried
                moves = np.linalg.norm(goes[j], axis=(1, 2))
                for b in np.argsort(-moves, kind="stable")[:2][np.sort(-moves)[:2] < 0].tolist():
                    name = self._rig.trajectories[b].name
                    poses.append(
                        (self._pose_key(name, frame), gtsam.Pose3(carried.wTb[n, b]), goes[j, b])
                    )
                    # Your graph adds the uncertainty of poses; at least a tenth of the variance is
                    # the joint's own.
                    own = own - goes[j, b] @ carried.covariance[n, b] @ goes[j, b].T
                own = raise_eigenvalues(own, np.trace(C[j]) / 30)
            made.graph.push_back(reported_factor(key, X[j], own, poses))
            made.values.insert(key, X[j])
            made.times_s[key] = time_s

    def _cameras(self, frame: int, time_s: Array) -> list[gtsam.PinholeCameraCal3_S2 | PosedCamera]:
        """The cameras of a frame with exposure times `time_s` (V,)."""
        sensors = Mounted(self._rig, np.array([frame]), time_s[None]).sensors[0]
        cameras: list[gtsam.PinholeCameraCal3_S2 | PosedCamera] = list(self._still)
        for view in np.flatnonzero(self._rig.carrier >= 0).tolist():
            key = self._pose_key(self._rig.trajectories[self._rig.carrier[view]].name, frame)
            cameras[view] = PosedCamera(self._lenses[view], key, gtsam.Pose3(sensors[view]))
        return cameras
