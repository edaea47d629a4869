"""Trajectories of moving cameras: odometry, corrected by the people that the cameras see.

People are tracked with the poses corrected so far; each window's people and poses are solved
jointly (`estimation/trajectory_graph.py`), and last the poses of the whole recording in one graph,
in which each window's people are replaced by their marginal on the poses.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import gtsam
import numpy as np

from factors import gaussian
from shapepose_fg.core.arrays import Array
from shapepose_fg.core.camera import Rig
from shapepose_fg.core.decompositions import rotation_angle
from shapepose_fg.core.errors import naming
from shapepose_fg.core.frame_times import segments
from shapepose_fg.core.observations import Observations
from shapepose_fg.core.storage.kept_arrays import ANEW, KeptArrays
from shapepose_fg.core.trajectory import Trajectory
from shapepose_fg.estimation.trajectory_graph import (
    CameraFactors,
    Mounted,
    TrajectoryGraph,
    poses_of,
    symmetric,
)
from shapepose_fg.pipeline.solved_windows import SolvedWindows
from shapepose_fg.pipeline.windows import Span

_KEPT = "trajectories"
"""Prefix of the names under which a run stores trajectories, followed by their number."""


def unrefined(rig: Rig) -> bool:
    """Whether there are moving cameras with unrefined trajectories."""
    return rig.moves and not all(each.refined for each in rig.trajectories)


def kept_rig(kept: KeptArrays, rig: Rig) -> Rig | None:
    """The rig with the trajectories that a run has stored; None if there are none."""
    if not rig.moves:
        return None
    found = []
    for number, trajectory in enumerate(rig.trajectories):
        name = f"{_KEPT}-{number}"
        if len(kept.names(name)) == 0:
            return None
        with naming(kept.place(name), ANEW):
            arrays = {each: kept.array(name, each) for each in ("time_s", "wTb", "covariance")}
            found.append(replace(trajectory, **arrays, refined=True))
    return replace(rig, trajectories=tuple(found))


def keep(kept: KeptArrays, rig: Rig) -> None:
    """Store the trajectories for `kept_rig`."""
    for number, each in enumerate(rig.trajectories):
        kept.keep(
            f"{_KEPT}-{number}",
            {"time_s": each.time_s, "wTb": each.wTb, "covariance": each.covariance_at(each.time_s)},
        )


def refine(
    windows: SolvedWindows,
    camera_factors: CameraFactors | None = None,
    report: Callable[[int], object] = lambda done: None,
) -> Rig:
    """The rig of `windows` with trajectories refined by the people of the recording, and their
    covariances. `report` gets the number of frames that are done.
    """
    rig, time_s = windows.setup.rig, windows.times.of_views(len(windows.setup.rig))
    frames = np.arange(windows.frames.start, windows.frames.stop)
    if len(frames) < 2:
        return replace(
            rig, trajectories=tuple(replace(each, refined=True) for each in rig.trajectories)
        )
    whole = Mounted(rig, frames, time_s[frames])
    poses, of_people = whole.odometry.copy(), list[gtsam.NonlinearFactor]()
    still = (rig.carrier < 0).any()
    if still or len(rig.trajectories) > 1 or camera_factors is not None:
        passing = _Pass(windows, time_s, camera_factors)
        for graph in passing.graphs():
            own = graph.mounted.frames - frames[0]
            poses[own[0] :] = passing.corrected(whole.odometry[own[0] :])
            poses[own] = graph.poses
            of_people += graph.of_poses()
            report(int(own[-1]) + 1)
    poses, covariance = _smoothed(whole, poses, of_people)
    refined = [
        _refined(trajectory, whole.time_s, poses[:, n], whole.odometry[:, n], covariance[:, n])
        for n, trajectory in enumerate(rig.trajectories)
    ]
    return replace(rig, trajectories=tuple(refined))


def about(given: Rig, refined: Rig) -> list[dict[str, Any]]:
    """The entry of run.json about trajectories: cameras, length, corrections, standard
    deviations.
    """
    entries = []
    for number, (old, new) in enumerate(zip(given.trajectories, refined.trajectories, strict=True)):
        cameras = [
            name for name, on in zip(given.names, given.carrier, strict=True) if on == number
        ]
        was, covariance = old.at(new.time_s), new.covariance_at(new.time_s)
        moved = np.linalg.norm(new.wTb[:, :3, 3] - was[:, :3, 3], axis=1)
        turned = rotation_angle(new.wTb[:, :3, :3] @ was[:, :3, :3].mT)
        variance = np.einsum("tii->ti", covariance)
        entries.append(
            {
                "carrier": new.name,
                "cameras": cameras,
                "refined": new.refined,
                "way_m": round(
                    float(np.linalg.norm(np.diff(new.wTb[:, :3, 3], axis=0), axis=1).sum()), 3
                ),
                "moved_mm": round(1e3 * float(moved.max()), 1),
                "turned_deg": round(float(np.degrees(turned.max())), 3),
                "sigma_mm": round(1e3 * float(np.sqrt(np.median(variance[:, 3:].mean(axis=1)))), 1),
                "sigma_deg": round(
                    float(np.degrees(np.sqrt(np.median(variance[:, :3].mean(axis=1))))), 3
                ),
            }
        )
    return entries


@dataclass
class _Pass:
    """One pass through the recording, window by window."""

    windows: SolvedWindows
    """The recording."""
    time_s: Array
    """(T, V) exposure times of the frames by view, seconds."""
    camera_factors: CameraFactors | None
    """The user's own factors on camera poses."""
    correction: Array = field(init=False)
    """(B, 4, 4) current correction of each carrier: from its odometry pose to its pose in the
    world."""
    _before: gtsam.NonlinearFactorGraph | None = None
    """Marginal on the last poses of the last window; None before the first."""

    def __post_init__(self) -> None:
        self.correction = np.tile(np.eye(4), (len(self.windows.setup.rig.trajectories), 1, 1))

    def corrected(self, odometry: Array) -> Array:
        """(T, B, 4, 4) odometry poses with the current correction."""
        return self.correction @ odometry

    def graphs(self) -> Iterator[TrajectoryGraph]:
        """Yield the solved graph of people and poses for each window."""
        windows, setup = self.windows, self.windows.setup
        engine, last = setup.engine(windows.notebook), None
        for segment in segments(windows.frames, windows.cuts):
            state = engine.start()
            for start in range(segment.start, segment.stop, setup.config.batch_frames):
                batch = range(start, min(start + setup.config.batch_frames, segment.stop))
                reader = replace(windows, setup=replace(setup, rig=self._rig()))
                given = [reader.read(frame) for frame in batch]
                with windows.notebook.stage("trajectories"):
                    spans, state = engine.follow(state, given, last=batch.stop == segment.stop)
                    for span in spans:
                        graph = self._solved(span, last)
                        last = int(graph.mounted.frames[-1])
                        yield graph

    def _rig(self) -> Rig:
        """The rig with the current correction."""
        rig = self.windows.setup.rig
        moved = [
            replace(each, wTb=correction @ each.wTb)
            for each, correction in zip(rig.trajectories, self.correction, strict=True)
        ]
        return replace(rig, trajectories=tuple(moved))

    def _solved(self, span: Span, last: int | None) -> TrajectoryGraph:
        """Solve a window's own frames, and the `last` one before them, with known poses."""
        setup = self.windows.setup
        own = span.decided[span.start : span.stop]
        frames = np.array([*([] if last is None else [last]), *(frame.frame for frame, _ in own)])
        mounted = Mounted(setup.rig, frames, self.time_s[frames])
        anchors = gtsam.NonlinearFactorGraph() if self._before is None else self._before
        for carrier in range(len(setup.rig.trajectories)):
            for factor in (
                mounted.steps(carrier) + mounted.known(carrier)[0 if last is None else 1 :]
            ):
                anchors.push_back(factor)
        graph = TrajectoryGraph(
            mounted,
            Observations.concatenate([rows for _, rows in own]),
            self.corrected(mounted.odometry),
            setup.config.observations,
            setup.skeleton.joints,
            self.camera_factors,
        )
        graph.solve(anchors)
        self.correction = graph.poses[-1] @ np.linalg.inv(mounted.odometry[-1])
        self._before = _known(graph, anchors)
        return graph


def _known(
    graph: TrajectoryGraph, anchors: gtsam.NonlinearFactorGraph
) -> gtsam.NonlinearFactorGraph:
    """Marginal of a solved window on its last poses, independently for each carrier."""
    both, values = gtsam.NonlinearFactorGraph(anchors), gtsam.Values()
    for factor in graph.of_poses():
        both.push_back(factor)
    for key, pose in zip(graph.keys.ravel().tolist(), graph.poses.reshape(-1, 4, 4), strict=True):
        values.insert(key, gtsam.Pose3(pose))
    marginals, known = gtsam.Marginals(both, values), gtsam.NonlinearFactorGraph()
    for key in graph.keys[-1].tolist():
        noise = gaussian(symmetric(marginals.marginalCovariance(key)))
        known.addPriorPose3(key, values.atPose3(key), noise)
    return known


def _smoothed(
    whole: Mounted, poses: Array, of_people: list[gtsam.NonlinearFactor]
) -> tuple[Array, Array]:
    """(T, B, 4, 4) poses of all frames in one graph, starting at `poses`, and covariances (T, B, 6,
    6).
    """
    graph, values, keys = gtsam.NonlinearFactorGraph(), gtsam.Values(), whole.keys()
    for key, pose in zip(keys.ravel().tolist(), poses.reshape(-1, 4, 4), strict=True):
        values.insert(key, gtsam.Pose3(pose))
    for carrier in range(keys.shape[1]):
        for factor in whole.steps(carrier) + whole.known(carrier):
            graph.push_back(factor)
    for factor in of_people:
        graph.push_back(factor)
    parameters = gtsam.LevenbergMarquardtParams.CeresDefaults()
    parameters.setOrdering(gtsam.Ordering(keys.ravel().tolist()))
    solved = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()
    marginals = gtsam.Marginals(graph, solved)
    covariance = np.array([marginals.marginalCovariance(key) for key in keys.ravel().tolist()])
    return poses_of(solved, keys), symmetric(covariance).reshape(*keys.shape, 6, 6)


def _refined(
    given: Trajectory, time_s: Array, poses: Array, odometry: Array, covariance: Array
) -> Trajectory:
    """The trajectory through `poses` (T, 4, 4) at the frames' times, and along the odometry between
    them.
    """
    middle = time_s.mean(axis=1)
    first, last = np.searchsorted(given.time_s, [time_s.min(), time_s.max()])
    own = given.time_s[max(first - 1, 0) : last + 1]
    # Odometry poses that coincide with a frame are replaced by the frame's.
    place = np.clip(np.searchsorted(middle, own), 1, len(middle) - 1)
    # Time within which a pose of the odometry coincides with a frame, s, and is dropped.
    near = np.minimum(np.abs(middle[place] - own), np.abs(middle[place - 1] - own)) < 1e-4
    times = np.sort(np.concatenate([own[~near], middle]))
    correction = Trajectory(given.name, middle, poses @ np.linalg.inv(odometry))
    covariances = Trajectory(given.name, middle, poses, covariance).covariance_at(times)
    return replace(
        given,
        time_s=times,
        wTb=correction.at(times) @ given.at(times),
        covariance=covariances,
        refined=True,
    )
