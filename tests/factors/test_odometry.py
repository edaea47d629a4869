import gtsam
import numpy as np
import pytest

from factors import (
    assert_jacobian,
    assert_zero_at_truth,
    camera_key,
    camera_keys,
    joint_key,
    make_calibration,
    odometry_factors,
    posed_projection_factor,
    posed_projection_factors,
)

POSES = np.stack(
    [
        gtsam.Pose3.Expmap(np.array(each)).matrix()
        for each in ([0.1, 0.2, -0.3, 1, 2, 3], [0.3, 0.1, 0.2, 2, 2, 1.0])
    ]
)


def values_at(poses: np.ndarray) -> gtsam.Values:
    values = gtsam.Values()
    for key, pose in zip(camera_keys(2, [5, 6]).tolist(), poses, strict=True):
        values.insert(key, gtsam.Pose3(pose))
    return values


def test_steps_are_zero_at_the_odometry_in_whatever_world_and_have_the_jacobian_of_differences():
    (step,) = odometry_factors(camera_keys(2, [5, 6]), POSES, np.tile(0.01 * np.eye(6), (1, 1, 1)))
    assert list(step.keys()) == [camera_key(2, 5), camera_key(2, 6)]
    elsewhere = gtsam.Pose3.Expmap(np.array([1.0, -0.5, 0.3, 7, 8, 9])).matrix()
    assert_zero_at_truth(step, values_at(POSES))
    assert_zero_at_truth(step, values_at(elsewhere @ POSES))
    off = POSES.copy()
    off[1] = off[1] @ gtsam.Pose3.Expmap(np.array([0.1, -0.2, 0.15, 0.3, 0.2, -0.1])).matrix()
    assert_jacobian(step, values_at(off))


def test_refuses_shapes_and_covariances_that_are_none():
    with pytest.raises(ValueError, match=r"covariances \(T - 1, 6, 6\)"):
        odometry_factors(camera_keys(2, [5, 6]), POSES, np.zeros((2, 6, 6)))
    with pytest.raises(ValueError, match="not positive definite"):
        odometry_factors(camera_keys(2, [5, 6]), POSES, np.zeros((1, 6, 6)))


def test_many_carried_cameras_are_as_one_by_one():
    K = np.array([[900.0, 0, 640], [0, 910, 360], [0, 0, 1]])
    lens, sensor = make_calibration(K), gtsam.Pose3.Expmap(np.array([0.1, 0.0, 0.2, 0.1, 0, 0]))
    keys, xy = (
        [joint_key(0, j, 5) for j in range(3)],
        np.array([[600.0, 300], [700, 400], [650, 350]]),
    )
    poses = [camera_key(2, 5)] * 3
    many = posed_projection_factors(
        [lens], [0, 0, 0], poses, [sensor] * 3, keys, xy, [2.0, 3.0, 4.0]
    )
    values = values_at(POSES)
    for n, (factor, key) in enumerate(zip(many, keys, strict=True)):
        values.insert(
            key, (gtsam.Pose3(POSES[0]) * sensor).transformFrom(np.array([0.1 * n, -0.1, 4.0 + n]))
        )
        one = posed_projection_factor(lens, xy[n], 2.0 + n, poses[0], key, body_T_sensor=sensor)
        assert factor.equals(one, 1e-12)
        assert_jacobian(factor, values)
    with pytest.raises(ValueError, match=r"xy \(D, 2\)"):
        posed_projection_factors([lens], [0], poses, [sensor] * 3, keys, xy, [2.0, 3.0, 4.0])
