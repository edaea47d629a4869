"""Rotations against scipy's, and their Jacobians against differences."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from shapepose_fg.body.model.rotation import (
    exp_so3,
    hat,
    log_so3,
    right_jacobian_inverse,
)

ANGLES = (0.0, 1e-12, 1e-7, 1e-4, 0.0999, 0.1001, 1.0, 3.0, np.pi - 1e-4, np.pi - 1e-9)


def axis_angles() -> np.ndarray:
    axes = np.random.default_rng(0).normal(size=(40, 3))
    axes = np.concatenate(
        (axes / np.linalg.norm(axes, axis=1, keepdims=True), np.eye(3), -np.eye(3))
    )
    return (np.array(ANGLES)[:, None, None] * axes).reshape(-1, 3)


def test_exp_equals_scipy():
    vectors = axis_angles() * np.array([1.0, 2.5]).reshape(2, 1, 1)  # beyond pi, too
    expected = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape(2, -1, 3, 3)
    np.testing.assert_allclose(exp_so3(vectors), expected, atol=1e-14)


def test_log_undoes_exp():
    vectors = axis_angles()
    np.testing.assert_allclose(log_so3(exp_so3(vectors)), vectors, atol=1e-13)


def test_log_of_half_a_turn():
    axes = np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1], [0.6, 0, 0.8], [-0.6, 0.8, 0]])
    R = 2 * axes[:, :, None] * axes[:, None] - np.eye(3)
    found = log_so3(R)
    np.testing.assert_allclose(np.linalg.norm(found, axis=-1), np.pi, atol=1e-15)
    np.testing.assert_allclose(exp_so3(found), R, atol=1e-15)


def test_log_norm_is_at_most_pi():
    R = exp_so3(np.random.default_rng(0).normal(0, 3, (1000, 3)))
    assert np.linalg.norm(log_so3(R), axis=-1).max() <= np.pi * (1 + 1e-15)


def test_right_jacobian_inverse_is_the_derivative():
    vectors, step = axis_angles(), 1e-6
    vectors = vectors[np.linalg.norm(vectors, axis=1) < 3.1]  # farther on, a step may go past pi
    inverse = right_jacobian_inverse(vectors)
    for c, e in enumerate(np.eye(3) * step):
        ahead, behind = (log_so3(exp_so3(vectors) @ exp_so3(sign * e)) for sign in (1, -1))
        np.testing.assert_allclose(inverse[..., c], (ahead - behind) / (2 * step), atol=1e-8)


@pytest.mark.parametrize("shape", [(3,), (2, 4, 3)])
def test_batch_dimensions(shape):
    vectors = np.ones(shape)
    for function in (hat, exp_so3, right_jacobian_inverse):
        assert function(vectors).shape == (*shape, 3)
    assert log_so3(exp_so3(vectors)).shape == shape
