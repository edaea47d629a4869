from dataclasses import replace

import numpy as np
import pytest

from shapepose_fg.body.fitting.priors import PosePrior
from shapepose_fg.core.skeleton import SMPL_24


@pytest.fixture(scope="module")
def prior() -> PosePrior:
    return PosePrior.default()


def angle(joint: str, axis: int) -> int:
    return 3 * (SMPL_24.index(joint) - 1) + axis


def test_mean_pose_stands_with_arms_down_and_joints_bent_the_right_way(prior):
    mean = prior.mean
    assert 0.3 < mean[angle("left_knee", 0)] < 1.2 and 0.3 < mean[angle("right_knee", 0)] < 1.2
    assert mean[angle("left_elbow", 1)] < -0.5 and mean[angle("right_elbow", 1)] > 0.5
    assert mean[angle("left_shoulder", 2)] < -0.7 and mean[angle("right_shoulder", 2)] > 0.7
    assert np.abs(mean[[angle("spine2", axis) for axis in range(3)]]).max() < 0.2


def test_left_and_right_are_mirror_images(prior):
    swap = {"left": "right", "right": "left"}
    sides = [name.partition("_") for name in SMPL_24[1:]]
    swapped = ["".join((swap.get(side, side), *rest)) for side, *rest in sides]
    order = np.array([[angle(name, axis) for axis in range(3)] for name in swapped]).ravel()
    sign = np.tile([1.0, -1.0, -1.0], 23)
    np.testing.assert_allclose(prior.mean[order] * sign, prior.mean, atol=1e-6)
    np.testing.assert_allclose(
        prior.covariance[np.ix_(order, order)] * np.outer(sign, sign), prior.covariance, atol=1e-6
    )


def test_every_angle_has_play_and_none_is_free(prior):
    sigma = np.sqrt(np.diag(prior.covariance))
    assert sigma.min() > 0.05 and sigma.max() < 1.2
    assert (
        np.sqrt(np.linalg.eigvalsh(prior.covariance)[0]) > 0.04
        and np.linalg.cond(prior.covariance) < 1e4
    )


def test_samples_have_the_moments_and_obey_the_limits(prior):
    draw = prior.sample(np.random.default_rng(0), 4000)
    assert draw.shape == (4000, 23, 3)
    flat = draw.reshape(4000, 69)
    assert (flat >= prior.lower).all() and (flat <= prior.upper).all()
    free = np.isinf(prior.lower) & np.isinf(prior.upper)
    sigma = np.sqrt(np.diag(prior.covariance))
    # The mean of 4,000 draws is within 4 sigma / sqrt(4000); their sigma within 10 %, for tails are
    # heavy.
    assert (np.abs(flat.mean(axis=0) - prior.mean)[free] < 4 * sigma[free] / np.sqrt(4000)).all()
    np.testing.assert_allclose(flat.std(axis=0)[free], sigma[free], rtol=0.1)


def test_regression_and_marginal_are_those_of_the_gaussian(prior):
    given, asked = np.arange(0, 60), np.arange(60, 69)
    P = np.linalg.inv(prior.covariance)
    # Rows of the precision give the same regression: -P_aa^-1 P_ag.
    expected = -np.linalg.solve(P[np.ix_(asked, asked)], P[np.ix_(asked, given)])
    np.testing.assert_allclose(prior.regression(given, asked), expected, atol=1e-8)
    marginal = P[np.ix_(given, given)] + P[np.ix_(given, asked)] @ expected
    np.testing.assert_allclose(prior.marginal_precision(given), marginal, rtol=1e-6, atol=1e-6)


def test_widened(prior):
    np.testing.assert_allclose(prior.widened(2.0).covariance, 4 * prior.covariance)


def test_provenance_carries_the_acknowledgement(prior):
    assert "obtained from mocap.cs.cmu.edu" in prior.provenance
    assert "NSF EIA-0196217" in prior.provenance
    assert "60 61" in prior.provenance  # not used


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"mean": np.zeros(72)}, "mean must be"),
        ({"mean": np.full(69, np.nan)}, "not finite"),
        ({"covariance": np.triu(np.ones((69, 69)))}, "symmetric"),
        ({"covariance": np.ones((69, 69))}, "positive definite"),
        ({"lower": np.zeros(69), "upper": np.zeros(69)}, "below"),
    ],
)
def test_bad_priors_are_refused(prior, change, message):
    with pytest.raises(ValueError, match=message):
        replace(prior, **change)
