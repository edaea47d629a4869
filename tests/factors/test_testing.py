import gtsam
import numpy as np
import pytest

from factors import assert_jacobian, assert_zero_at_truth, diagonal, isotropic, robust_kernel


def _bone(length, model, wrong=1.0):
    """A bone length as a user may write it: r = |a - b| - length; `wrong` scales its Jacobian."""

    def error(this, values, jacobians):
        first, second = this.keys()
        a, b = values.atPoint3(first), values.atPoint3(second)
        distance = np.linalg.norm(a - b)
        if jacobians is not None:
            jacobians[0] = wrong * ((a - b) / distance)[None]
            jacobians[1] = ((b - a) / distance)[None]
        return np.array([distance - length])

    return gtsam.CustomFactor(model, [1, 2], error)


@pytest.fixture
def values():
    values = gtsam.Values()
    values.insert(1, np.array([0.1, 0.2, 1.3]))
    values.insert(2, np.array([0.3, -0.1, 1.1]))
    return values


@pytest.mark.parametrize("kernel", [None, "huber", "cauchy"])
def test_a_users_own_factor_passes(values, kernel):
    assert_jacobian(_bone(0.3, isotropic(1, 0.02, robust_kernel(kernel))), values)


@pytest.mark.parametrize("kernel", [None, "huber", "cauchy"])
def test_a_wrong_jacobian_is_found(values, kernel):
    with pytest.raises(AssertionError, match="Jacobian is off by"):
        assert_jacobian(_bone(0.3, isotropic(1, 0.02, robust_kernel(kernel)), wrong=1.001), values)


def test_the_native_bone_length_agrees_with_the_users(values):
    """RangeFactor3 between two points: same residual, same Jacobian."""
    native = gtsam.RangeFactor3(1, 2, 0.3, isotropic(1, 0.02))
    own = _bone(0.3, isotropic(1, 0.02))
    assert_jacobian(native, values)
    for a, b in zip(
        native.linearize(values).jacobian(), own.linearize(values).jacobian(), strict=True
    ):
        np.testing.assert_allclose(a, b, rtol=1e-12)


def test_variables_that_are_not_points(values):
    """Tangent spaces of six dimensions, noise that differs by axis."""
    values.insert(5, gtsam.Pose3(gtsam.Rot3.Ypr(0.4, 0.2, -0.1), np.array([1.0, 2, 3])))
    values.insert(6, gtsam.Pose3(gtsam.Rot3.Ypr(0.1, 0.5, -0.3), np.array([2.0, 1, 3])))
    noise = diagonal(np.arange(1, 7) / 10)
    assert_jacobian(gtsam.BetweenFactorPose3(5, 6, gtsam.Pose3(), noise), values)


def test_a_factor_without_a_noise_model(values):
    assert_jacobian(gtsam.PriorFactorPoint3(1, np.zeros(3)), values)


def test_zero_at_truth(values):
    a, b = values.atPoint3(1), values.atPoint3(2)
    assert_zero_at_truth(_bone(np.linalg.norm(a - b), isotropic(1, 0.02)), values)
    with pytest.raises(AssertionError, match="not zero"):
        assert_zero_at_truth(_bone(0.3, isotropic(1, 0.02)), values)


def test_a_residual_without_weight_says_so(values):
    factor = gtsam.PriorFactorPoint3(
        1, np.full(3, 50.0), isotropic(3, 0.01, robust_kernel("tukey"))
    )
    with pytest.raises(AssertionError, match="no weight"):
        assert_jacobian(factor, values)
