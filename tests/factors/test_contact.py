"""A standing foot: residual, Jacobian, and what several of them leave of a walk."""

import gtsam
import numpy as np
import pytest

from factors import assert_jacobian, assert_zero_at_truth, joint_keys, standing_factors

KEYS = joint_keys(0, 4, np.arange(4))
DT = np.array([0.1, 0.2, 0.4])


def values(points) -> gtsam.Values:
    result = gtsam.Values()
    for key, point in zip(KEYS.tolist(), points, strict=True):
        result.insert(key, np.asarray(point, dtype=float))
    return result


def test_residual_is_the_step():
    (factor,) = standing_factors(KEYS[:1], KEYS[1:2], DT[:1], [0.01])
    still, moved = values(np.ones((4, 3))), values([[1, 1, 1], [1.1, 1, 0.8], [1, 1, 1], [1, 1, 1]])
    assert_zero_at_truth(factor, still)
    np.testing.assert_allclose(factor.unwhitenedError(moved), [0.1, 0, -0.2], atol=1e-12)
    assert_jacobian(factor, moved)
    # The variance of a step is the density times its time.
    np.testing.assert_allclose(factor.error(moved), 0.5 * (0.1**2 + 0.2**2) / (0.01 * 0.1))


def test_variance_grows_as_that_of_a_walk():
    q = np.array([1e-4, 1e-3, 1e-2])
    graph = gtsam.NonlinearFactorGraph()
    graph.push_back(
        gtsam.PriorFactorPoint3(
            int(KEYS[0]), np.zeros(3), gtsam.noiseModel.Isotropic.Sigma(3, 0.01)
        )
    )
    for factor in standing_factors(KEYS[:-1], KEYS[1:], DT, q):
        graph.push_back(factor)
    found = gtsam.Marginals(graph, values(np.zeros((4, 3)))).marginalCovariance(int(KEYS[3]))
    np.testing.assert_allclose(found, (0.01**2 + (q * DT).sum()) * np.eye(3), atol=1e-9)


@pytest.mark.parametrize(
    ("dt", "density"), [([0.0], [1.0]), ([0.1], [0.0]), ([0.1], [np.inf]), ([0.1, 0.1], [1.0])]
)
def test_refuses_steps_that_are_none(dt, density):
    with pytest.raises(ValueError, match="must be"):
        standing_factors(KEYS[:1], KEYS[1:2], dt, density)
