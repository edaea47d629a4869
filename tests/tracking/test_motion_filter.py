"""The Kalman filter of joints: against the same numbers by hand."""

import numpy as np

from factors import CONSTANT_VELOCITY
from shapepose_fg.tracking.motion_filter import JointStates

PSD = np.array([4.0, 9.0])


def states(seed=0):
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(3, 2, 6, 6))
    return JointStates(rng.normal(size=(3, 2, 6)), A @ A.swapaxes(-1, -2) + np.eye(6))


def test_a_step_ahead_is_constant_velocity_with_white_acceleration():
    before, h = states(), 0.1
    after = before.predicted(h, CONSTANT_VELOCITY, PSD)
    np.testing.assert_allclose(after.position, before.position + h * before.velocity)
    np.testing.assert_allclose(after.velocity, before.velocity)
    F = np.kron(np.array([[1.0, h], [0.0, 1.0]]), np.eye(3))
    Q = np.kron(9.0 * np.array([[h**3 / 3, h**2 / 2], [h**2 / 2, h]]), np.eye(3))
    np.testing.assert_allclose(after.covariance[1, 1], F @ before.covariance[1, 1] @ F.T + Q)


def test_a_step_back_returns_to_where_it_came_from_less_certain():
    before = states()
    there_and_back = before.predicted(0.2, CONSTANT_VELOCITY, PSD).predicted(-0.2, CONSTANT_VELOCITY, PSD)
    np.testing.assert_allclose(there_and_back.mean, before.mean, atol=1e-12)
    grown = there_and_back.covariance - before.covariance
    assert (np.linalg.eigvalsh(grown) > -1e-9).all() and np.trace(grown, axis1=2, axis2=3).min() > 0


def test_an_update_is_the_information_filter_s_also_for_a_ray():
    before = states(1)
    ray = np.diag([2.0, 3.0, 0.0])  # nothing along z
    place = before.position + np.array([0.3, -0.2, 0.7])
    after = before.updated(
        np.broadcast_to(ray, (3, 2, 3, 3)), np.einsum("ij,...j->...i", ray, place - before.position)
    )
    full = np.zeros((6, 6))
    full[:3, :3] = ray
    precision = np.linalg.inv(before.covariance[2, 0])
    covariance = np.linalg.inv(precision + full)
    mean = covariance @ (precision @ before.mean[2, 0] + full @ np.append(place[2, 0], np.zeros(3)))
    np.testing.assert_allclose(after.covariance[2, 0], covariance, atol=1e-10)
    np.testing.assert_allclose(after.mean[2, 0], mean, atol=1e-10)
