"""Linear factors on any number of points, against least squares by NumPy."""

import gtsam
import numpy as np
import pytest

from factors import assert_jacobian, assert_zero_at_truth, linear_factor, load_graph, save_graph


def values_of(points) -> gtsam.Values:
    values = gtsam.Values()
    for key, point in enumerate(points):
        values.insert(key, np.asarray(point, dtype=float))
    return values


@pytest.mark.parametrize("count", range(1, 8))
@pytest.mark.parametrize("rows", [1, 2, 3, 6])
def test_residual_and_jacobian_are_those_of_the_formula(count, rows):
    rng = np.random.default_rng(10 * count + rows)
    A, z, sigma = (
        rng.normal(size=(count, rows, 3)),
        rng.normal(size=rows),
        rng.uniform(0.5, 2.0, rows),
    )
    x = rng.normal(size=(count, 3))
    factor = linear_factor(range(count), A, z, sigma)
    residual = (np.einsum("kmi,ki->m", A, x) - z) / sigma
    assert factor.error(values_of(x)) == pytest.approx(0.5 * residual @ residual)
    assert list(factor.keys()) == list(range(count))
    assert_jacobian(factor, values_of(x))


def test_constant_acceleration_over_four_frames():
    """The third difference is zero for a parabola, and a solver finds it through points that are
    none.
    """
    t = np.arange(4.0)[:, None]
    parabola = t**2 * [1.0, 0.0, -2.0] + t * [0.3, 1.0, 0.0] + [0.0, 0.0, 1.0]
    smooth = linear_factor(range(4), (-1, 3, -3, 1), sigma=0.01)
    assert_zero_at_truth(smooth, values_of(parabola))
    assert_jacobian(smooth, values_of(parabola + 0.1))
    noisy = parabola + np.random.default_rng(0).normal(0, 0.05, (4, 3))
    graph = gtsam.NonlinearFactorGraph()
    for key, point in enumerate(noisy):
        graph.push_back(
            gtsam.PriorFactorPoint3(key, point, gtsam.noiseModel.Isotropic.Sigma(3, 0.05))
        )
    graph.push_back(smooth)
    found = gtsam.LevenbergMarquardtOptimizer(graph, values_of(noisy)).optimize()
    D = np.array([-1.0, 3.0, -3.0, 1.0])
    H = np.eye(4) / 0.05**2 + np.outer(D, D) / 0.01**2
    expected = np.linalg.solve(H, noisy / 0.05**2)
    np.testing.assert_allclose([found.atPoint3(key) for key in range(4)], expected, atol=1e-6)


def test_it_is_written_and_read_back(tmp_path):
    graph, values = gtsam.NonlinearFactorGraph(), values_of(np.ones((5, 3)))
    graph.push_back(linear_factor(range(5), [1, -4, 6, -4, 1], [0.1, 0.0, 0.2], 0.3))
    save_graph(tmp_path / "graph.json", graph, values)
    again, _ = load_graph(tmp_path / "graph.json")
    assert again.error(values) == pytest.approx(graph.error(values))


def test_a_factor_without_a_point_of_linearisation_is_found_out():
    unit = gtsam.noiseModel.Unit.Create(3)
    bare = gtsam.LinearContainerFactor(gtsam.JacobianFactor(0, np.eye(3), np.ones(3), unit))
    with pytest.raises(AssertionError, match="linear_factor"):
        assert_zero_at_truth(bare, values_of([np.zeros(3)]))


@pytest.mark.parametrize(
    ("words", "arguments"),
    {
        "one for each of 2 keys": ([1, 2], [1.0]),
        "distinct keys": ([1, 1], [1.0, 2.0]),
        "as many rows": ([1, 2], [np.eye(3), np.ones((2, 3))]),
        "measured must be": ([1], [1.0], np.zeros(2)),
        "sigma must be positive": ([1], [1.0], 0.0, 0.0),
        "must be finite": ([1], [np.nan]),
    }.items(),
)
def test_what_does_not_fit_is_refused(words, arguments):
    with pytest.raises(ValueError, match=words):
        linear_factor(*arguments)
