import gtsam
import numpy as np
import pytest
from gtsam import noiseModel

from factors import (
    DEFAULT_WIDTH_SIGMA,
    diagonal,
    gaussian,
    isotropic,
    isotropic_models,
    kernel_weight,
    robust_kernel,
    sigma_px,
)

NAMES = ["huber", "cauchy", "geman_mcclure", "tukey"]


def test_sigma_is_the_size_in_the_image_plus_the_grid():
    # 3 cm at 3 m with a focal length of 400 px are 4 px; with a floor of 3 px in quadrature: 5 px.
    assert sigma_px(1.0, 3.0, 400.0, sigma_m=0.03, floor_px=3.0) == pytest.approx(5.0)


def test_confidence_multiplies_the_squared_error():
    full, quarter = sigma_px(np.array([1.0, 0.25]), 3.0, 400.0)
    assert quarter == pytest.approx(2 * full)
    r = np.array([3.0, 4.0])
    costs = [
        gtsam.PriorFactorPoint2(1, np.zeros(2), isotropic(2, s)).error(_at(r))
        for s in (full, quarter)
    ]
    assert costs[1] == pytest.approx(0.25 * costs[0])


@pytest.mark.parametrize(
    "bad", [(0.0, 3, 400), (0.5, 0, 400), (0.5, -1, 400), (np.nan, 3, 400), (0.5, 3, 0)]
)
def test_what_has_no_weight_is_refused(bad):
    with pytest.raises(ValueError, match="positive and finite"):
        sigma_px(*bad)


@pytest.mark.parametrize("name", NAMES)
def test_the_kernels_weight_at_its_width(name):
    """Weights at a whitened residual of twice the width, from the kernels' formulas."""
    k = 1.7
    expected = {"huber": 1 / 2, "cauchy": 1 / 5, "geman_mcclure": 1 / 25, "tukey": 0.0}[name]
    kernel = robust_kernel(name, k)
    assert kernel.weight(2 * k) == pytest.approx(expected)
    assert kernel.weight(0.0) == pytest.approx(1.0)


@pytest.mark.parametrize("name", NAMES)
def test_the_default_width_keeps_95_percent_on_gaussian_pixels(name):
    """Asymptotic efficiency of the M-estimator of location in 2D: E[div psi]²/4 / (E|psi|²/2)."""
    r = np.linspace(0, 9, 20001)[1:]
    density = r * np.exp(-(r**2) / 2)
    density /= np.trapezoid(density, r)
    kernel = robust_kernel(name)
    weight = np.array([kernel.weight(x) for x in r])
    divergence = np.trapezoid((2 * weight + np.gradient(weight, r) * r) * density, r)
    spread = np.trapezoid(weight**2 * r**2 * density, r)
    # Widths are given to two digits after the point.
    assert (divergence / 2) ** 2 / (spread / 2) == pytest.approx(0.95, abs=2e-3)


@pytest.mark.parametrize("name", NAMES)
def test_a_kernel_counts_standard_deviations_not_pixels(name):
    """Ten times the residual at ten times the sigma costs the same."""
    kernel = robust_kernel(name)
    r = np.array([5.0, -9.0])
    small = gtsam.PriorFactorPoint2(1, np.zeros(2), isotropic(2, 2.0, kernel)).error(_at(r))
    large = gtsam.PriorFactorPoint2(1, np.zeros(2), isotropic(2, 20.0, kernel)).error(_at(10 * r))
    assert small == pytest.approx(large)
    assert small == pytest.approx(kernel.loss(np.linalg.norm(r) / 2.0))


@pytest.mark.parametrize("name", NAMES)
def test_a_kernel_lets_an_outlier_go(name):
    """Nine priors at 0 and one at 100 sigma: the mean would be 10 away."""
    graph = gtsam.NonlinearFactorGraph()
    for i in range(10):
        mean = np.array([100.0 * (i == 9), 0, 0])
        graph.add(gtsam.PriorFactorPoint3(1, mean, isotropic(3, 1.0, robust_kernel(name))))
    start = gtsam.Values()
    start.insert(1, np.array([0.3, 0.2, 0.1]))
    x = gtsam.LevenbergMarquardtOptimizer(graph, start).optimize().atPoint3(1)
    # Huber's outlier pulls with its width: 1.5 sigma against nine springs of one.
    assert np.linalg.norm(x) < (
        DEFAULT_WIDTH_SIGMA["huber"] / 9 + 1e-3 if name == "huber" else 0.01
    )


def test_none_is_plain_least_squares():
    assert robust_kernel(None) is None
    assert not isinstance(isotropic(2, 1.0, None), noiseModel.Robust)


def test_an_unknown_kernel_or_width_is_refused():
    with pytest.raises(ValueError, match="huber, cauchy, geman_mcclure, tukey"):
        robust_kernel("hubert")
    for width in (0.0, -1.0, np.nan):
        with pytest.raises(ValueError, match="positive"):
            robust_kernel("huber", width)


def test_the_batch_is_the_single_one_many_times():
    kernel = robust_kernel("cauchy")
    sigmas = np.array([0.5, 2.0, 7.0])
    for sigma, model in zip(sigmas, isotropic_models(2, sigmas, kernel), strict=True):
        np.testing.assert_allclose(model.noise().sigmas(), isotropic(2, sigma).sigmas())
    assert [m.sigmas()[0] for m in isotropic_models(3, sigmas)] == sigmas.tolist()


def test_noise_that_gtsam_would_turn_into_nan_is_refused():
    for sigma in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(ValueError, match="positive"):
            isotropic(3, sigma)
        with pytest.raises(ValueError, match="positive"):
            diagonal([1.0, sigma])
        with pytest.raises(ValueError, match="positive"):
            isotropic_models(2, [1.0, sigma])
    with pytest.raises(ValueError, match="positive definite"):
        gaussian(np.diag([1.0, -1.0, 1.0]))
    with pytest.raises(ValueError, match="positive definite"):
        gaussian(np.zeros((3, 3)))
    with pytest.raises(ValueError, match="not symmetric"):
        gaussian([[1.0, 0.5], [0.0, 1.0]])
    with pytest.raises(ValueError, match="not finite"):
        gaussian(np.full((2, 2), np.nan))


def test_gaussian_noise_measures_mahalanobis():
    covariance = np.array([[2.0, 0.5], [0.5, 1.0]])
    r = np.array([1.0, -2.0])
    cost = gtsam.PriorFactorPoint2(1, np.zeros(2), gaussian(covariance)).error(_at(r))
    assert cost == pytest.approx(0.5 * r @ np.linalg.solve(covariance, r))


def _at(point):
    values = gtsam.Values()
    values.insert(1, point)
    return values


@pytest.mark.parametrize("name", NAMES)
def test_kernel_weights_for_arrays_are_those_of_gtsam(name):
    norms = np.linspace(0.0, 12.0, 60)
    for width in (None, 0.8):
        kernel = robust_kernel(name, width)
        expected = [kernel.weight(norm) for norm in norms]
        np.testing.assert_allclose(
            kernel_weight(name, norms, width), expected, rtol=1e-12, atol=1e-15
        )
    assert kernel_weight(None, norms).tolist() == [1.0] * 60
