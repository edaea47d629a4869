"""Poses over time, and rigs of a moment: two cameras on one robot go where it goes."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from shapepose_fg.core.camera import Rig, Views
from shapepose_fg.core.frame_times import FrameTimes
from shapepose_fg.core.trajectory import LONGEST_GAP_S, Trajectory
from shapepose_fg.core.trust import without_poses


def turned(degrees: float, x: float, y: float = 0.0) -> NDArray[np.float64]:
    """A pose (4, 4) turned about z, at (x, y, 0)."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[c, -s, 0, x], [s, c, 0, y], [0, 0, 1, 0], [0, 0, 0, 1.0]])


ROBOT = Trajectory(
    "robot", np.array([0.0, 0.4, 0.8]), np.stack([turned(0, 0), turned(90, 1), turned(90, 1, 2)])
)


@pytest.fixture(scope="session")
def with_robot(five_cameras) -> Rig:
    """Three cameras that stand still, and two on one robot, half a metre apart."""
    sides = (
        replace(camera, carrier="robot", bTc=turned(5, 0, y))
        for camera, y in zip(five_cameras.cameras[3:], (0.25, -0.25), strict=True)
    )
    return replace(five_cameras, cameras=(*five_cameras.cameras[:3], *sides), trajectories=(ROBOT,))


def test_between_two_poses_it_goes_straight_and_turns_about_one_axis():
    np.testing.assert_allclose(
        ROBOT.at(np.array([0.1, 0.4, 0.6])),
        [turned(22.5, 0.25), turned(90, 1), turned(90, 1, 1)],
        atol=1e-12,
    )
    np.testing.assert_allclose(
        ROBOT.at(np.array([-1.0, 9.0])), [turned(0, 0), turned(90, 1, 2)], atol=1e-12
    )


def test_covariances_are_interpolated():
    variances = np.array([1.0, 3.0, 3.0])[:, None, None] * np.eye(6)
    known = replace(ROBOT, covariance=variances)
    np.testing.assert_allclose(known.covariance_at(np.array([0.2])), [2 * np.eye(6)])
    assert not ROBOT.covariance_at(np.zeros(3)).any()


def test_an_odometry_drifts_with_its_way_and_not_with_how_often_it_is_read():
    once = ROBOT.drifted(ROBOT.at(np.array([0.4, 0.8])), np.array([0.4, 0.8])).sum(axis=0)
    often = np.linspace(0.4, 0.8, 41)
    np.testing.assert_allclose(ROBOT.drifted(ROBOT.at(often), often).sum(axis=0), once, rtol=1e-6)
    # 2 m straight on and 0.4 s: 1 % of the root of 2.02 m.
    assert np.sqrt(once[3, 3]) == pytest.approx(0.01 * np.sqrt(2.02))


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"time_s": np.array([0.0, 0.4, 0.4])}, "times must increase, but do not at pose 2"),
        ({"wTb": np.stack([2 * np.eye(4)] * 3)}, "orthonormal"),
        ({"wTb": np.zeros((2, 4, 4))}, r"wTb \(F, 4, 4\)"),
        ({"drift": 0.0}, "drift must be above 0"),
        ({"covariance": -np.tile(np.eye(6), (3, 1, 1))}, "no negative eigenvalue"),
    ],
)
def test_refuses_what_is_no_trajectory(change, says):
    with pytest.raises(ValueError, match=f"trajectory robot: .*{says}"):
        replace(ROBOT, **change)


def test_a_rig_of_a_moment_has_its_cameras_on_the_robot(with_robot, five_cameras):
    time_s = np.array([0.4, 0.4, 0.4, 0.4, 0.1])
    there = with_robot.at(time_s)
    assert with_robot.moves and not there.moves and not five_cameras.moves
    assert five_cameras.at(time_s) is five_cameras
    np.testing.assert_array_equal(there.cTw[:3], five_cameras.cTw[:3])
    np.testing.assert_allclose(there.cameras[3].wTc, turned(90, 1) @ turned(5, 0, 0.25), atol=1e-12)
    np.testing.assert_allclose(
        there.cameras[4].wTc, turned(22.5, 0.25) @ turned(5, 0, -0.25), atol=1e-12
    )


def test_views_of_rows_are_those_of_their_moments(with_robot, two_people):
    time_s = np.random.default_rng(0).uniform(0, 0.8, (2, 5))
    views = Views.of(with_robot, time_s)
    for row in range(2):
        xy, _ = with_robot.at(time_s[row]).project(two_people[row])
        np.testing.assert_allclose(
            views.pixels(two_people)[0][row], np.moveaxis(xy, 0, 1), atol=1e-8
        )
    assert views.carried is not None
    np.testing.assert_array_equal(views.carried.carrier, [-1, -1, -1, 0, 0])
    with pytest.raises(ValueError, match="give time_s"):
        Views.of(with_robot)


def test_a_camera_names_a_trajectory_that_there_is(with_robot):
    with pytest.raises(ValueError, match="camera cam3: there is no trajectory 'robot'"):
        replace(with_robot, trajectories=())


def test_pictures_before_behind_and_in_gaps_of_a_trajectory_have_no_pose(with_robot):
    poses = np.stack([turned(0, x) for x in range(4)])
    gap = replace(ROBOT, time_s=np.array([0.1, 0.2, 0.3 + LONGEST_GAP_S, 1.0]), wTb=poses)
    times = FrameTimes(np.arange(12) / 10)
    spells = without_poses(replace(with_robot, trajectories=(gap,)), times)
    assert spells == tuple((view, *span) for view in (3, 4) for span in ((0, 1), (3, 8), (11, 12)))
