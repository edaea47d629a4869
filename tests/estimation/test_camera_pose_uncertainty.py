"""Errors of poses of cameras that move reach the joints' covariances."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from shapepose_fg.body.fitting.fitter import JointTargets
from shapepose_fg.core.camera import Rig, Views
from shapepose_fg.core.observations import Observations
from shapepose_fg.core.trajectory import Trajectory
from shapepose_fg.estimation.camera_pose_uncertainty import carried_covariance
from shapepose_fg.estimation.gated_views import ObservationConfig, linearise

CONFIG = ObservationConfig(kernel="none")
POSE = gtsam.Pose3(gtsam.Rot3.Ypr(0.7, 0.2, -0.1), np.array([1.0, -0.5, 0.3]))
ROOT = np.random.default_rng(3).normal(0, [0.004] * 3 + [0.012] * 3, (6, 6))
COVARIANCE = ROOT.T @ ROOT


def on_robot(rig: Rig, first: int) -> Rig:
    """The cameras from `first` on are carried by a robot at POSE, known to COVARIANCE."""
    wTb = POSE.matrix()
    path = Trajectory(
        "robot", np.array([0.0, 1.0]), np.stack([wTb] * 2), np.stack([COVARIANCE] * 2)
    )
    cameras = [
        replace(each, carrier="robot", bTc=np.linalg.inv(wTb) @ each.wTc) if view >= first else each
        for view, each in enumerate(rig.cameras)
    ]
    return replace(rig, cameras=tuple(cameras), trajectories=(path,))


def seen(rig: Rig, people: np.ndarray) -> tuple[Observations, np.ndarray]:
    """What all cameras see, and sigmas of 5 px."""
    xy = np.moveaxis(rig.at(np.zeros(len(rig))).project(people)[0], 0, 2)
    return Observations(xy, np.ones(xy.shape[:3]), people), np.full(xy.shape[:3], 5.0)


def added(rig: Rig, people: np.ndarray) -> np.ndarray:
    observations, sigmas = seen(rig, people)
    views = Views.of(rig, np.zeros((len(people), len(rig))))
    evidence = linearise(observations, sigmas, people, views, CONFIG)
    nothing = JointTargets(np.zeros(people.shape), np.zeros((*people.shape, 3)))
    return carried_covariance(evidence, nothing, sigmas, views, CONFIG)


def test_joints_that_only_one_robot_sees_move_with_it(five_cameras, two_people):
    found = added(on_robot(five_cameras, 0), two_people)
    for person, joint in ((0, 0), (1, 17)):
        H = np.zeros((3, 6), order="F")
        POSE.transformFrom(
            POSE.transformTo(two_people[person, joint]), H, np.zeros((3, 3), order="F")
        )
        # Of a joint that nothing is said of the rest is made up: a millionth of the information
        # here.
        np.testing.assert_allclose(found[person, joint], H @ COVARIANCE @ H.T, rtol=1e-3, atol=1e-9)


def test_nothing_is_added_where_cameras_stand_still(five_cameras, two_people):
    assert not added(on_robot(five_cameras, 5), two_people).any()


@pytest.mark.slow
@pytest.mark.parametrize("first", [2, 4])
def test_of_fixed_cameras_and_a_robot_it_is_what_poses_drawn_from_their_covariance_make(
    five_cameras, two_people, first
):
    rig, rng = on_robot(five_cameras, first), np.random.default_rng(0)
    observations, sigmas = seen(rig, two_people)
    time_s, ends = np.zeros((2, 5)), []
    for error in rng.multivariate_normal(np.zeros(6), COVARIANCE, 400, method="cholesky"):
        moved = POSE.retract(error).matrix()
        wrong = replace(
            rig, trajectories=(replace(rig.trajectories[0], wTb=np.stack([moved] * 2)),)
        )
        views, points = Views.of(wrong, time_s), two_people
        for _ in range(2):
            points = linearise(observations, sigmas, points, views, CONFIG).target
        ends.append(points - two_people)
    away = np.array(ends)
    sampled = np.einsum("snji,snjk->njik", away, away) / len(away)
    # 400 draws: variances within 4 standard deviations of 7 %.
    scale = np.trace(sampled, axis1=2, axis2=3)[..., None, None]
    np.testing.assert_allclose(added(rig, two_people) / scale, sampled / scale, atol=0.28)
    np.testing.assert_allclose(
        (added(rig, two_people) / scale).mean((0, 1)), (sampled / scale).mean((0, 1)), atol=0.1
    )
