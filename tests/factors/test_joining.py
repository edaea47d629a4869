"""Two people in the SLAM graph of a robot, by ISAM2 and by a fixed-lag smoother; the truth is
known.
"""

from dataclasses import dataclass
from itertools import pairwise

import gtsam
import numpy as np
import pytest

from factors import (
    KeySpace,
    PeopleInGraph,
    PosedCamera,
    Sighting,
    diagonal,
    make_calibration,
    make_camera,
    odometry_factors,
    reported_factor,
)

K = np.array([[900.0, 0, 640], [0, 900, 360], [0, 0, 1]])
LENS, T, STEP_S, NOISE_PX = make_calibration(K), 25, 0.2, 8.0
AHEAD = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
SENSOR = gtsam.Pose3(gtsam.Rot3(AHEAD), np.array([0.1, 0, 1.3]))
SPACE = KeySpace("p")
START = diagonal([0.02] * 3 + [0.05] * 3)


def X(frame: int) -> int:
    return gtsam.symbol("x", frame)


def facing(angle: float, distance: float) -> gtsam.Pose3:
    """A carrier on a circle around the people, whom it faces."""
    at = distance * np.array([np.cos(angle), np.sin(angle), 0])
    return gtsam.Pose3(gtsam.Rot3.Yaw(angle + np.pi), at)


@dataclass
class World:
    """A robot with one camera before two people, two cameras on the walls, and what each of them
    measured.
    """

    true: list[gtsam.Pose3]
    odometry: np.ndarray
    joints: np.ndarray
    """(T, 2, J, 3) metres."""
    xy: np.ndarray
    """(T, 2, J, 3 cameras, 2) pixels; the robot's is the last."""
    guess: np.ndarray
    walls: list[gtsam.Pose3]


def world(seed: int) -> World:
    rng = np.random.default_rng(seed)
    t = np.arange(T) * STEP_S
    true = [facing(2.0 + 0.15 * now, 3.0) for now in t]
    start = gtsam.Pose3.Expmap(rng.normal(0, 1, 6) * np.array([0.02] * 3 + [0.05] * 3))
    poses = [true[0].compose(start)]
    for before, after in pairwise(true):
        error = gtsam.Pose3.Expmap(rng.normal(0, 1, 6) * np.array([0.003] * 3 + [0.006] * 3))
        poses.append(poses[-1].compose(before.between(after)).compose(error))
    body = rng.uniform([-0.3, -0.3, 0.1], [0.3, 0.3, 1.7], (12, 3))
    walk = 0.5 * np.stack([np.sin(0.9 * t), np.cos(0.7 * t), 0 * t], axis=-1)
    apart = np.array([0.6, 0.1, 0])
    joints = np.stack([body + apart + walk[:, None], body - apart - walk[:, None]], axis=1)
    walls = [
        facing(angle, 3.5).compose(gtsam.Pose3(gtsam.Rot3(AHEAD), np.array([0, 0, 2.0])))
        for angle in (0.3, 1.7)
    ]
    xy = np.empty((T, 2, 12, 3, 2))
    for frame in range(T):
        for view, pose in enumerate([*walls, true[frame].compose(SENSOR)]):
            camera = gtsam.PinholeCameraCal3_S2(pose, LENS)
            xy[frame, :, :, view] = [[camera.project(x) for x in one] for one in joints[frame]]
    xy += rng.normal(0, NOISE_PX, xy.shape)
    guess = joints + rng.normal(0, 0.05, joints.shape)
    return World(true, np.array([each.matrix() for each in poses]), joints, xy, guess, walls)


def sightings(made: World, frame: int, robot) -> list[Sighting]:
    cameras = [*(make_camera(K, pose.matrix()) for pose in made.walls), robot]
    sigmas, density = np.full((12, 3), NOISE_PX), np.full(12, 0.3)
    return [
        Sighting(
            who,
            frame,
            frame * STEP_S,
            made.guess[frame, who],
            made.xy[frame, who],
            sigmas,
            density,
            cameras,
        )
        for who in range(2)
    ]


def run(made: World, solver, *, slam: bool = True, people: bool = True, poses=None) -> gtsam.Values:
    """All frames, one update each; `poses` of a robot that is taken to be there."""
    joined = PeopleInGraph(SPACE, link_s=0.3)
    steps = odometry_factors(
        [X(n) for n in range(T)],
        made.odometry,
        np.tile(np.diag([0.003**2] * 3 + [0.006**2] * 3), (T - 1, 1, 1)),
    )
    at = gtsam.Pose3(made.odometry[0])
    for frame in range(T):
        graph, values, stamps = gtsam.NonlinearFactorGraph(), gtsam.Values(), {}
        if slam:
            if frame == 0:
                graph.addPriorPose3(X(0), at, START)
            else:
                graph.push_back(steps[frame - 1])
                at = solver.calculateEstimatePose3(X(frame - 1)).compose(
                    steps[frame - 1].measured()
                )
            values.insert(X(frame), at)
            stamps[X(frame)] = frame * STEP_S
        if people:
            robot = PosedCamera(LENS, X(frame), SENSOR)
            if poses is not None:
                robot = gtsam.PinholeCameraCal3_S2(poses[frame].compose(SENSOR), LENS)
            new = joined.add(sightings(made, frame, robot))
            graph.push_back(new.graph)
            values.insert(new.values)
            stamps |= new.times_s
        update(solver, graph, values, stamps)
    return solver.calculateEstimate()


def update(solver, graph, values, times_s) -> None:
    if isinstance(solver, gtsam.ISAM2):
        solver.update(graph, values)
        solver.update()
        return
    stamps = gtsam.FixedLagSmootherKeyTimestampMap()
    for key, time_s in times_s.items():
        stamps.insert((key, time_s))
    solver.update(graph, values, stamps)


def camera_errors(made: World, values: gtsam.Values) -> np.ndarray:
    """(T, 2) metres and radians."""
    off = [
        gtsam.Pose3.Logmap(made.true[n].between(values.atPose3(X(n))))
        for n in range(T)
        if values.exists(X(n))
    ]
    return np.array([(np.linalg.norm(each[3:]), np.linalg.norm(each[:3])) for each in off])


def joint_errors(made: World, values: gtsam.Values) -> np.ndarray:
    """Metres, of all joints that are there."""
    keys = [
        (n, who, SPACE.positions(who, np.arange(12), n).tolist())
        for n in range(T)
        for who in range(2)
    ]
    return np.array(
        [
            np.linalg.norm(values.atPoint3(key) - made.joints[n, who, joint])
            for n, who, each in keys
            for joint, key in enumerate(each)
            if values.exists(key)
        ]
    )


def cholesky() -> gtsam.ISAM2:
    return gtsam.ISAM2(gtsam.ISAM2Params())


def test_people_and_slam_together_are_better_than_either_alone():
    """In the mean of three worlds: by chance either alone may be as good in one."""
    before, after, people, both_people = [], [], [], []
    for seed in range(6880, 6883):
        made = world(seed)
        slam = run(made, cholesky(), people=False)
        both = run(made, cholesky())
        poses = [slam.atPose3(X(n)) for n in range(T)]
        alone = run(made, cholesky(), slam=False, poses=poses)
        before.append(camera_errors(made, slam))
        after.append(camera_errors(made, both))
        people.append(joint_errors(made, alone).mean())
        both_people.append(joint_errors(made, both).mean())
        assert len(joint_errors(made, both)) == T * 2 * 12
    root = [np.sqrt((np.concatenate(each) ** 2).mean(axis=0)) for each in (before, after)]
    assert (root[1] < 0.6 * root[0]).all(), root
    assert np.mean(both_people) < 0.7 * np.mean(people)


def test_a_fixed_lag_smoother_holds_what_is_within_its_lag():
    """The cameras' last places, in the mean of three worlds."""
    before, after = [], []
    for seed in range(6880, 6883):
        made = world(seed)
        smoother = gtsam.IncrementalFixedLagSmoother(1.0)
        values = run(made, smoother)
        assert values.size() < 8 * 2 * 12 * 2  # of 25 frames the last five or six
        before.append(camera_errors(made, run(made, cholesky(), people=False))[-1, 0])
        after.append(camera_errors(made, values)[-1, 0])
        assert joint_errors(made, values).mean() < 0.03
    assert np.mean(after) < np.mean(before)


def test_one_camera_and_holes_leave_no_system_singular():
    """Cholesky as ISAM2 does it by default refuses what is hardly determined."""
    made = world(6881)
    made.xy[:, 0, :, :2] = np.nan  # the robot alone sees the first person
    made.xy[8:12] = np.nan  # nobody sees anybody, for longer than links last
    made.xy[3, 1, 5] = np.nan
    values = run(made, cholesky())
    errors = camera_errors(made, values)
    assert np.isfinite(errors).all() and errors[:, 0].max() < 0.3
    assert not values.exists(int(SPACE.positions(1, 0, 10)))
    assert not values.exists(int(SPACE.positions(1, 5, 3))) and values.exists(
        int(SPACE.positions(1, 5, 4))
    )


def test_a_reported_joint_goes_with_a_pose_and_tells_nothing_of_it():
    rng = np.random.default_rng(0)
    pose, joint = facing(0.4, 3.0), np.array([0.2, -0.3, 1.1])
    wide, own = diagonal([0.01] * 3 + [0.05] * 3), np.diag([1.0, 4.0, 2.0]) * 1e-4
    goes = np.zeros((3, 6), order="F")
    pose.transformFrom(pose.transformTo(joint), goes, np.zeros((3, 3), order="F"))
    key = int(SPACE.reported(7, 3, 5))
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    moved = pose.retract(0.01 * rng.normal(size=6))
    graph.addPriorPose3(X(0), moved, wide)
    graph.push_back(reported_factor(key, joint, own, [(X(0), pose, goes)]))
    values.insert(X(0), pose)
    values.insert(key, joint)
    solved = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    assert solved.atPose3(X(0)).equals(moved, 1e-6)
    np.testing.assert_allclose(
        solved.atPoint3(key), moved.transformFrom(pose.transformTo(joint)), atol=2e-3
    )  # it is linear: 1 cm and half a degree at 3 m
    marginals = gtsam.Marginals(graph, solved)
    of_pose = marginals.marginalCovariance(X(0))
    np.testing.assert_allclose(of_pose, wide.covariance(), rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(
        marginals.marginalCovariance(key), own + goes @ of_pose @ goes.T, rtol=0.1, atol=1e-5
    )
    assert SPACE.format(key) == "reported position(person 7, joint 3, frame 5)"
    still = reported_factor(key, joint, own)
    assert isinstance(still, gtsam.PriorFactorPoint3) and still.error(values) == 0
    with pytest.raises(ValueError, match="at most two poses"):
        reported_factor(key, joint, own, [(X(n), pose, goes) for n in range(3)])


def test_what_is_given_wrongly_is_refused():
    joined, made = PeopleInGraph(SPACE), world(6880)
    robot = PosedCamera(LENS, X(0), SENSOR)
    joined.add(sightings(made, 1, robot))
    with pytest.raises(
        ValueError, match=r"person 0: frames must be in order of time, but 0.0 s is not"
    ):
        joined.add(sightings(made, 0, robot))
    with pytest.raises(ValueError, match=r"joints must be \(J, 3\)"):
        one = sightings(made, 2, robot)[0]
        Sighting(0, 2, 0.4, one.joints, one.xy[:, :2], one.sigmas_px, one.density, one.cameras)
    with pytest.raises(ValueError, match="link_s must be positive"):
        PeopleInGraph(SPACE, link_s=0.0)


def test_factors_at_the_truth_have_no_error():
    made = world(6880)
    made.guess = made.joints
    robot = PosedCamera(LENS, X(0), SENSOR)
    for who in range(2):
        for view, pose in enumerate([*made.walls, made.true[0].compose(SENSOR)]):
            camera = gtsam.PinholeCameraCal3_S2(pose, LENS)
            made.xy[0, who, :, view] = [camera.project(x) for x in made.joints[0, who]]
    new = PeopleInGraph(SPACE).add(sightings(made, 0, robot))
    new.values.insert(X(0), made.true[0])
    assert new.graph.error(new.values) == pytest.approx(0, abs=1e-12)
    # Three cameras on each of 12 joints of two people, and where and how fast a new joint is.
    assert new.graph.size() == 2 * 12 * (3 + 2) and len(new.times_s) == 2 * 12 * 2
