"""Two people, two fixed cameras and a robot with two more, whose odometry drifts; the truth is
known.
"""

from dataclasses import dataclass, replace
from typing import Any, cast

import gtsam
import numpy as np
import pytest
from numpy.typing import NDArray

from factors import KeySpace, camera_key, diagonal, odometry_factors
from shapepose_fg.core.camera import Camera, Rig
from shapepose_fg.core.detections import Detections, Recording
from shapepose_fg.core.frame_times import FrameTimes
from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.core.storage.kept_arrays import InMemory
from shapepose_fg.core.trajectory import Trajectory
from shapepose_fg.estimation.joined_graph import JoinedPeople
from shapepose_fg.pipeline.config import PipelineConfig
from shapepose_fg.pipeline.pipeline import reconstruct, refine_trajectories
from shapepose_fg.pipeline.trajectories import keep, kept_rig, unrefined
from shapepose_fg.simulation.scene import UP, look_at
from tests.conftest import STANDING, detect_exactly

T, FPS = 60, 25.0
TIMES = FrameTimes.from_fps(FPS, T)
K = np.array([[900.0, 0, 640], [0, 900, 360], [0, 0, 1]])


def camera(name: str, angle: float, distance: float = 3.5, height: float = 2.0) -> Camera:
    eye = np.array([distance * np.cos(angle), distance * np.sin(angle), height])
    return Camera(name, K, look_at(eye, np.array([0, 0, 0.9]), UP), (1280, 720))


def pose(angle: NDArray[np.float64]) -> NDArray[np.float64]:
    """(F, 4, 4) where the robot is on its circle around the people, which it faces."""
    wTb = np.tile(np.eye(4), (len(angle), 1, 1))
    c, s = np.cos(angle + np.pi), np.sin(angle + np.pi)
    wTb[:, :2, :2] = np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], axis=1)
    wTb[:, :2, 3] = 3 * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    return wTb


def drifting(wTb: NDArray[np.float64], seed: int, drift: float) -> NDArray[np.float64]:
    """The same as an odometry has it whose steps are wrong by `drift`, scale and turns."""
    rng, out = np.random.default_rng(seed), [wTb[0]]
    scale = 1 + drift
    for step in np.linalg.inv(wTb[:-1]) @ wTb[1:]:
        way = np.linalg.norm(step[:3, 3])
        error = rng.normal(0, drift * np.sqrt(way), 6) * [0.3, 0.3, 0.5, 0.7, 0.7, 0.3]
        step[:3, 3] *= scale
        out.append(out[-1] @ step @ gtsam.Pose3.Expmap(error).matrix())
    return np.array(out)


@dataclass(frozen=True)
class Scene:
    """A recording before a robot, and the truth."""

    recording: Recording
    rig: Rig
    """With the robot's odometry."""
    true: Trajectory
    people: NDArray[np.float64]
    """(T, 2, 25, 3) metres."""

    def with_path(self, wTb: NDArray[np.float64], **more) -> Rig:
        """The rig with another trajectory."""
        return replace(self.rig, trajectories=(replace(self.true, wTb=wTb, **more),))

    def error_m(self, joints: NDArray[np.float64]) -> float:
        """Mean distance of joints (T, 2, 25, 3) from the truth."""
        return float(np.nanmean(np.linalg.norm(joints - self.people, axis=-1)))


def scene(
    fixed: int = 2, seed: int = 0, drift: float = 0.03, noise_px: float = 3.0, still: bool = False
) -> Scene:
    """People who walk past each other; detections with independent errors."""
    rng, t = np.random.default_rng(seed), TIMES.time_s
    walk = np.stack([0.5 * np.sin(1.1 * t), 0.4 * np.cos(0.9 * t), 0 * t], axis=-1)
    people = np.stack(
        [
            STANDING + np.array([0.5, 0, 0]) + walk[:, None],
            STANDING + np.array([-0.5, 0.3, 0]) - walk[:, None],
        ],
        axis=1,
    )
    time_s = np.arange(-0.1, t[-1] + 0.15, 0.02)
    true = Trajectory("robot", time_s, pose(2.0 + (0 if still else 0.5) * time_s))
    sides = []
    for name, y in (("cam2", 0.3), ("cam3", -0.3)):
        bTc = np.array([[0, 0, 1, 0.1], [-1, 0, 0, y], [0, -1, 0, 1.2], [0, 0, 0, 1.0]])
        sides.append(Camera(name, K, true.wTb[0] @ bTc, (1280, 720), carrier="robot", bTc=bTc))
    rig = Rig(
        (*(camera(f"cam{n}", 1.3 * n) for n in range(fixed)), *sides), "z", trajectories=(true,)
    )
    frames = list[Detections]()
    for frame, now in enumerate(t.tolist()):
        seen = detect_exactly(rig.at(np.full(len(rig), now)), people[frame])
        frames.append(replace(seen, xy=seen.xy + rng.normal(0, noise_px, seen.xy.shape)))
    odometry = replace(true, wTb=drifting(true.wTb, seed, drift), drift=drift)
    return Scene(Recording(BODY_25, frames), replace(rig, trajectories=(odometry,)), true, people)


def by_truth(made: Scene, people) -> NDArray[np.float64]:
    """(T, 2, 25, 3) joints of a result, each of the person whom it is nearest to; NaN where there
    is none.
    """
    joints = np.full(made.people.shape, np.nan)
    for row, frame in enumerate(people.frame.tolist()):
        near = (
            np.linalg.norm(people.joints[row] - made.people[frame], axis=-1).mean(axis=-1).argmin()
        )
        joints[frame, near] = people.joints[row]
    return joints


def camera_error(made: Scene, rig: Rig) -> NDArray[np.float64]:
    """(T, 6) of the robot's poses, turn then way along its own axes, rad and m."""
    steps = np.linalg.inv(rig.trajectories[0].at(TIMES.time_s)) @ made.true.at(TIMES.time_s)
    return np.array([gtsam.Pose3.Logmap(gtsam.Pose3(each)) for each in steps])


@pytest.fixture(scope="module")
def drifted() -> Scene:
    return scene()


@pytest.fixture(scope="module")
def refined(drifted) -> Rig:
    return refine_trajectories(drifted.recording, drifted.rig, times=TIMES)


@pytest.fixture(scope="module")
def as_given(drifted) -> Reconstruction:
    """People with the odometry taken as it is."""
    rig = drifted.with_path(drifted.rig.trajectories[0].wTb, refined=True)
    return reconstruct(drifted.recording, rig, times=TIMES)


@pytest.mark.slow
def test_people_correct_the_odometry_and_say_how_surely(drifted, refined):
    before, after = camera_error(drifted, drifted.rig), camera_error(drifted, refined)
    rms = [np.sqrt((each**2).mean(axis=0)) for each in (before, after)]
    assert np.linalg.norm(rms[1][3:]) < 0.6 * np.linalg.norm(rms[0][3:])
    assert np.linalg.norm(rms[1][:3]) < 0.6 * np.linalg.norm(rms[0][:3])
    covariance = refined.trajectories[0].covariance_at(TIMES.time_s)
    nees = np.einsum("ti,ti->t", after, np.linalg.solve(covariance, after[..., None])[..., 0])
    # Errors here are independent, real ones last: believed is less than is known. 16.8 is the 99 %
    # point.
    assert (nees < 16.8).all() and np.sqrt(
        covariance[:, 3:, 3:].trace(axis1=1, axis2=2)
    ).max() < 0.1


@pytest.mark.slow
def test_it_is_continuous_over_windows(drifted, refined):
    config = replace(PipelineConfig(), batch_frames=24)
    rig = refine_trajectories(drifted.recording, drifted.rig, config, times=TIMES)
    step = np.linalg.norm(np.diff(camera_error(drifted, rig), axis=0)[:, 3:], axis=1)
    given = np.linalg.norm(np.diff(camera_error(drifted, drifted.rig), axis=0)[:, 3:], axis=1)
    # From frame to frame the odometry says best how far it went: nowhere a jump.
    assert step.max() < given.max() + 0.004
    apart = (
        rig.trajectories[0].at(TIMES.time_s)[:, :3, 3]
        - refined.trajectories[0].at(TIMES.time_s)[:, :3, 3]
    )
    # Who is whom was decided with other corrections: 5 mm, and sigmas are 10 to 20.
    assert np.linalg.norm(apart, axis=1).max() < 0.005


@pytest.mark.slow
def test_people_are_nearer_to_the_truth_than_with_odometry_taken_as_it_is(
    drifted, refined, as_given
):
    people = reconstruct(drifted.recording, refined, times=TIMES)
    assert len(people) == 2 * T
    assert drifted.error_m(by_truth(drifted, people)) < 0.85 * drifted.error_m(
        by_truth(drifted, as_given)
    )
    error = (
        people.joints
        - drifted.people[
            people.frame, np.where(people.person == people.person.min(), *_order(drifted, people))
        ]
    )
    nees = np.einsum(
        "nji,nji->nj", error, np.linalg.solve(people.covariance, error[..., None])[..., 0]
    )
    assert 0.90 <= (nees < 7.81).mean() <= 1.0


def _order(made: Scene, people) -> tuple[int, int]:
    """Which of the true people the first identity is, and the other."""
    first = people.joints[people.person == people.person.min()][0]
    near = int(np.linalg.norm(first - made.people[0], axis=-1).mean(axis=-1).argmin())
    return near, 1 - near


@pytest.mark.slow
def test_people_join_a_graph_of_somebodys_own(drifted, as_given):
    def key(carrier: str, frame: int) -> int:
        assert carrier == "robot"
        return gtsam.symbol("x", frame)

    path, every = drifted.rig.trajectories[0], 5
    taken = drifted.with_path(path.wTb, refined=True)
    frames, space, graph, values = (
        range(0, T, every),
        KeySpace("p"),
        gtsam.NonlinearFactorGraph(),
        gtsam.Values(),
    )
    at, keys = path.at(TIMES.time_s[frames]), [key("robot", frame) for frame in frames]
    graph.addPriorPose3(keys[0], gtsam.Pose3(at[0]), diagonal([0.02] * 3 + [0.05] * 3))
    for factor in odometry_factors(keys, at, path.drifted(at, TIMES.time_s[frames])):
        graph.push_back(factor)
    for one, pose in zip(keys, at, strict=True):
        values.insert(one, gtsam.Pose3(pose))
    given = as_given.rows(as_given.frame % every == 0)
    joined = JoinedPeople(taken, space, key, step_s=every / FPS)
    for frame, new in joined.increments(given):
        assert frame in frames
        graph.push_back(new.graph)
        values.insert(new.values)
    found = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    true = drifted.true.at(TIMES.time_s[frames])
    before = np.linalg.norm(at[:, :3, 3] - true[:, :3, 3], axis=1)
    after = [
        np.linalg.norm(found.atPose3(one).translation() - T[:3, 3])
        for one, T in zip(keys, true, strict=True)
    ]
    assert np.mean(after) < 0.75 * before.mean()
    joints = np.full(given.joints.shape, np.nan)
    for row, (who, frame) in enumerate(
        zip(given.person.tolist(), given.frame.tolist(), strict=True)
    ):
        for joint, place in enumerate(space.positions(who, np.arange(25), frame).tolist()):
            joints[row, joint] = found.atPoint3(place) if found.exists(place) else np.nan
    assert np.isfinite(joints).mean() > 0.95
    error = drifted.error_m(by_truth(drifted, replace(given, joints=joints)))
    assert error < 0.9 * drifted.error_m(by_truth(drifted, given))


@pytest.mark.slow
def test_a_robot_that_stands_still_is_as_fixed_cameras_are():
    made = scene(still=True, drift=1e-6)
    poses = made.true.wTb
    still = made.rig.at(np.zeros(4))
    fixed, moving = (
        reconstruct(made.recording, rig, times=TIMES, frames=range(24))
        for rig in (still, made.with_path(poses, refined=True))
    )
    # Per-frame cameras round otherwise; nothing else differs.
    np.testing.assert_array_equal(moving.person, fixed.person)
    np.testing.assert_allclose(moving.joints, fixed.joints, atol=1e-4)
    np.testing.assert_allclose(moving.covariance, fixed.covariance, rtol=0.05, atol=1e-7)


@pytest.mark.slow
def test_without_a_fixed_camera_people_are_where_they_are_before_the_robot():
    made = scene(fixed=0)
    rig = refine_trajectories(made.recording, made.rig, times=TIMES)
    odometry = made.rig.trajectories[0].at(TIMES.time_s)
    # Nothing but the odometry says where the robot is: its poses stay, and their covariance grows
    # with the way.
    np.testing.assert_allclose(rig.trajectories[0].at(TIMES.time_s), odometry, atol=1e-6)
    sigma = np.sqrt(
        rig.trajectories[0].covariance_at(TIMES.time_s)[:, 3:, 3:].trace(axis1=1, axis2=2)
    )
    assert sigma[0] < 1e-3 and (np.diff(sigma) > 0).all() and sigma[-1] > 0.02
    people = reconstruct(made.recording, rig, times=TIMES)
    to_truth = made.true.at(TIMES.time_s) @ np.linalg.inv(odometry)
    joints = by_truth(made, replace(people, joints=_moved(people.joints, to_truth[people.frame])))
    assert made.error_m(joints) < 0.05
    # In the world they are as unsure as the robot is, and more.
    last = people.frame == T - 1
    assert np.sqrt(people.covariance[last].trace(axis1=2, axis2=3)).min() > sigma[-1]


NOWHERE = gtsam.Pose3(gtsam.Rot3(), np.full(3, np.nan))


def _moved(points: NDArray[np.float64], poses: NDArray[np.float64]) -> NDArray[np.float64]:
    return points @ poses[:, :3, :3].mT + poses[:, None, :3, 3]


@pytest.mark.slow
def test_factors_of_your_own_on_poses_count(drifted):
    def surveyed(graph, keys):
        """A landmark says to a millimetre where the robot is in frame 30."""
        if 30 in graph.mounted.frames:
            key = camera_key(0, 30)
            assert key in keys
            where = gtsam.Pose3(drifted.true.at(TIMES.time_s[[30]])[0])
            yield gtsam.PriorFactorPose3(key, where, diagonal([1e-3] * 6))

    rig = refine_trajectories(drifted.recording, drifted.rig, times=TIMES, camera_factors=surveyed)
    assert np.linalg.norm(camera_error(drifted, rig)[30, 3:]) < 0.004


def test_factors_on_poses_that_cannot_count_are_refused(drifted):
    key = camera_key(0, 3)
    exact, lost = gtsam.noiseModel.Constrained.All(6), camera_key(0, 99999)
    for wrong, words in (
        ([gtsam.PriorFactorPose3(key, gtsam.Pose3(), exact)], "has a sigma of 0"),
        ([gtsam.PriorFactorPose3(lost, gtsam.Pose3(), diagonal([0.1] * 6))], "not in this window"),
        ([gtsam.PriorFactorPoint3(key, np.zeros(3), diagonal([0.1] * 3))], "cannot be computed"),
        ([gtsam.PriorFactorPose3(key, NOWHERE, diagonal([0.1] * 6))], "is not finite"),
        (None, "returned a NoneType"),
    ):
        with pytest.raises(ValueError, match=f"<lambda>.*{words}"):
            refine_trajectories(
                drifted.recording,
                drifted.rig,
                times=TIMES,
                camera_factors=cast(Any, lambda graph, keys, wrong=wrong: wrong),
            )


@pytest.mark.slow
def test_a_run_keeps_its_trajectories(refined):
    kept = InMemory()
    assert kept_rig(kept, refined) is None
    keep(kept, refined)
    again = kept_rig(kept, refined)
    assert again is not None and not unrefined(again)
    # Samples of the odometry fall on frames but for rounding: each moment is there once.
    assert np.diff(again.trajectories[0].time_s).min() > 1e-4
    np.testing.assert_array_equal(again.trajectories[0].wTb, refined.trajectories[0].wTb)
    np.testing.assert_array_equal(
        again.trajectories[0].covariance, refined.trajectories[0].covariance
    )


def test_a_trajectory_of_another_clock_is_refused(drifted):
    path = drifted.rig.trajectories[0]
    rig = replace(drifted.rig, trajectories=(replace(path, time_s=path.time_s + 1.7e9),))
    with pytest.raises(
        ValueError,
        match="camera cam2 has no pose at the time of any picture: robot runs from 17000000",
    ):
        refine_trajectories(drifted.recording, rig, times=TIMES)


@pytest.mark.slow
def test_pictures_outside_the_trajectory_are_not_used(drifted):
    short = drifted.true
    early = short.time_s < TIMES.time_s[40]
    rig = replace(
        drifted.rig,
        trajectories=(
            replace(short, time_s=short.time_s[early], wTb=short.wTb[early], refined=True),
        ),
    )
    people = reconstruct(drifted.recording, rig, times=TIMES, frames=range(36, 44))
    assert people.observations is not None
    used = np.asarray(people.observations.used.any(axis=1))
    assert used[people.frame < 40].all() and not used[people.frame >= 40][:, 2:].any()
    assert used[people.frame >= 40][:, :2].all()
