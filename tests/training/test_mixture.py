"""Mixtures learnt from rows with gaps: known truth comes back, and mirror images are as likely as the rows."""

import numpy as np
import pytest

from shapepose_fg.body.training.mixture import Mirror, MixtureConfig, fit_mixture

MIRROR = Mirror(np.array([1, 0, 2]), np.array([1.0, 1.0, -1.0]))
"""Two values that change places and one that changes its sign."""
COVARIANCE = np.array([[1.0, 0.3, 0.2], [0.3, 0.8, -0.1], [0.2, -0.1, 0.5]])


def draw(count: int, gaps: float) -> tuple[np.ndarray, np.ndarray]:
    """Rows around (6, 0, 2) and which of their values are seen; the first always is."""
    rng = np.random.default_rng(0)
    values = rng.multivariate_normal([6.0, 0.0, 2.0], COVARIANCE, count)
    seen = rng.random((count, 3)) >= gaps
    seen[:, 0] = True
    return np.where(seen, values, 0.0), seen


def fit(values, seen, components):
    config = MixtureConfig(components, shrink=1.0)
    return fit_mixture(values, seen, np.ones(len(values)), MIRROR, config, np.random.default_rng(0))


@pytest.mark.parametrize("gaps", [0.0, 0.3])
def test_a_pair_of_components_is_the_cloud_and_its_mirror_image(gaps):
    mixture = fit(*draw(4000, gaps), 2)
    order = np.argsort(-mixture.means[:, 0])  # the cloud itself first
    # Standard errors are 0.016 for means and 0.03 for covariances, more where values are missing: 4 of them.
    np.testing.assert_allclose(mixture.means[order[0]], [6, 0, 2], atol=0.08)
    np.testing.assert_allclose(mixture.means[order[1]], [0, 6, -2], atol=0.08)
    np.testing.assert_allclose(mixture.covariances[order[0]], COVARIANCE, atol=0.12)
    np.testing.assert_allclose(mixture.weights, 0.5)


@pytest.mark.parametrize("components", [1, 2, 4])
def test_a_row_is_as_likely_as_its_mirror_image(components):
    values, seen = draw(500, 0.3)
    mixture = fit(values, seen, components)
    assert len(mixture.weights) == components and mixture.weights.sum() == pytest.approx(1)
    ours, mirrored = mixture.log_density(values, seen), mixture.log_density(MIRROR.rows(values), MIRROR.seen(seen))
    np.testing.assert_allclose(mirrored, ours, atol=1e-6)  # rounding


def test_one_component_has_the_moments_of_rows_and_mirror_images():
    values, seen = draw(500, 0.0)
    mixture = fit(values, seen, 1)
    both = np.concatenate([values, MIRROR.rows(values)])
    np.testing.assert_allclose(mixture.means[0], both.mean(axis=0), atol=1e-9)
    np.testing.assert_allclose(mixture.covariances[0], np.cov(both.T, bias=True), atol=1e-5)  # 1e-6 is added


def test_odd_numbers_of_components_are_refused():
    with pytest.raises(ValueError, match="1 or even"):
        MixtureConfig(3)
