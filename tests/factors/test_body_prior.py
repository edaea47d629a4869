import gtsam
import numpy as np
import pytest

from factors import (
    assert_jacobian,
    assert_zero_at_truth,
    body_prior_factor,
    body_prior_factors,
    isotropic,
    joint_keys,
    robust_kernel,
)

MEAN = np.array([0.3, -0.2, 1.4])
COVARIANCE = np.array([[4.0, 1.0, 0.5], [1.0, 3.0, -0.5], [0.5, -0.5, 2.0]]) * 1e-4


def _at(point, key=1):
    values = gtsam.Values()
    values.insert(key, np.asarray(point))
    return values


def test_zero_at_truth_and_joint_minus_mean_elsewhere():
    factor = body_prior_factor(1, MEAN, COVARIANCE)
    assert_zero_at_truth(factor, _at(MEAN))
    np.testing.assert_allclose(
        factor.unwhitenedError(_at(MEAN + np.array([0.1, 0.2, 0.3]))), [0.1, 0.2, 0.3]
    )


@pytest.mark.parametrize("kernel", [None, "huber", "cauchy"])
def test_the_jacobian_is_the_numeric_one(kernel):
    assert_jacobian(
        body_prior_factor(1, MEAN, COVARIANCE, kernel=robust_kernel(kernel)), _at(MEAN + 0.02)
    )


def test_the_cost_is_half_the_mahalanobis_distance():
    r = np.array([0.02, -0.01, 0.03])
    factor = body_prior_factor(1, MEAN, COVARIANCE)
    assert factor.error(_at(MEAN + r)) == pytest.approx(0.5 * r @ np.linalg.solve(COVARIANCE, r))


def test_it_is_the_native_prior():
    native = gtsam.PriorFactorPoint3(1, MEAN, isotropic(3, 0.05))
    assert body_prior_factor(1, MEAN, sigma_m=0.05).equals(native, 1e-12)
    assert body_prior_factor(1, MEAN, 0.05**2 * np.eye(3)).error(_at(MEAN + 0.1)) == pytest.approx(
        native.error(_at(MEAN + 0.1))
    )


def test_two_priors_meet_at_their_weighted_mean():
    other = MEAN + np.array([0.1, 0.0, -0.1])
    graph = gtsam.NonlinearFactorGraph()
    graph.add(body_prior_factor(1, MEAN, COVARIANCE))
    graph.add(body_prior_factor(1, other, sigma_m=0.01))
    solution = gtsam.LevenbergMarquardtOptimizer(graph, _at(MEAN)).optimize()
    A, B = np.linalg.inv(COVARIANCE), np.eye(3) / 0.01**2
    np.testing.assert_allclose(
        solution.atPoint3(1), np.linalg.solve(A + B, A @ MEAN + B @ other), atol=1e-7
    )
    covariance = gtsam.Marginals(graph, solution).marginalCovariance(1)
    np.testing.assert_allclose(covariance, np.linalg.inv(A + B), rtol=1e-9)


def test_a_batch_is_the_single_factor_many_times():
    rng = np.random.default_rng(0)
    keys, means = joint_keys(2, np.arange(5), 3), rng.normal(size=(5, 3))
    root = rng.normal(size=(5, 3, 3))
    covariances = root @ root.transpose(0, 2, 1) + 0.1 * np.eye(3)
    kernel = robust_kernel("huber")
    for i, factor in enumerate(body_prior_factors(keys, means, covariances, kernel)):
        single = body_prior_factor(int(keys[i]), means[i], covariances[i], kernel=kernel)
        assert factor.equals(single, 1e-12)
        assert list(factor.keys()) == [keys[i]]
        values = _at(means[i] + 1.0, int(keys[i]))
        assert factor.error(values) == pytest.approx(single.error(values))
    assert body_prior_factors([], np.zeros((0, 3)), np.zeros((0, 3, 3))) == []


def test_misuse_says_what_is_wrong():
    with pytest.raises(ValueError, match="exactly one"):
        body_prior_factor(1, MEAN)
    with pytest.raises(ValueError, match="exactly one"):
        body_prior_factor(1, MEAN, COVARIANCE, sigma_m=0.1)
    with pytest.raises(ValueError, match="finite metres"):
        body_prior_factor(1, [0.0, np.nan, 1.0], sigma_m=0.1)
    with pytest.raises(ValueError, match="covariance 1 is not positive definite"):
        body_prior_factors([1, 2], np.zeros((2, 3)), np.stack([np.eye(3), np.diag([1.0, 1, 0])]))
    with pytest.raises(ValueError, match="no prior to such a joint"):
        body_prior_factors([1], np.full((1, 3), np.nan), np.eye(3)[None])
    with pytest.raises(ValueError, match=r"means \(D, 3\)"):
        body_prior_factors([1], np.zeros((2, 3)), np.eye(3)[None])
