"""How well the body knows joints without a target, for every fitter that ships."""

from collections.abc import Sequence

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from shapepose_fg.body.fitting.fitter import BodyFit, BodyFitter, JointTargets
from shapepose_fg.body.fitting.fitters import SmplFitter, make_fitter
from shapepose_fg.body.fitting.priors import PosePrior
from shapepose_fg.body.model.body_model import BodyModel, BodyParameters
from shapepose_fg.core.skeleton import BODY_25
from tests.marks import slow

MODEL_SIGMA_M = 0.02
NOISE_M = 0.01
COUNT = 160
FITTERS = {"plain": SmplFitter, "learned": make_fitter}
"""Every fitter that ships."""


def draw(count: int, rows_each: int = 1) -> np.ndarray:
    """Joints (count * rows_each, 25, 3) of people of poses and shapes from the priors, in a z-up
    world.
    """
    rng, rows = np.random.default_rng(0), count * rows_each
    orient = Rotation.from_euler("z", rng.uniform(-np.pi, np.pi, (rows, 1)))
    orient = (orient * Rotation.from_rotvec([np.pi / 2, 0, 0])).as_rotvec()
    poses, betas = (
        PosePrior.default().sample(rng, rows),
        np.repeat(rng.normal(size=(count, 10)), rows_each, axis=0),
    )
    parts = (betas, orient, poses, rng.uniform(-3, 3, (rows, 3)))
    return BodyModel.default().keypoints(BodyParameters(*(parts)))


@pytest.fixture(scope="module")
def people() -> tuple[np.ndarray, np.ndarray]:
    """Joints of bodies drawn from the priors as this detector sees them (COUNT, 25, 3), and with
    noise.
    """
    rng = np.random.default_rng(1)
    truth = draw(COUNT) + rng.normal(0, MODEL_SIGMA_M, (COUNT, 25, 3))
    return truth, truth + rng.normal(0, NOISE_M, truth.shape)


def make_targets(
    xyz: np.ndarray, without: Sequence[int] = (), sigma_m: float = NOISE_M
) -> JointTargets:
    information = np.broadcast_to(np.eye(3) / sigma_m**2, (*xyz.shape, 3)).copy()
    information[:, list(without)] = 0
    return JointTargets(xyz, information)


@pytest.fixture(scope="module", params=["learned", *slow("plain")])
def fitter(request) -> BodyFitter:
    return FITTERS[request.param]()


@pytest.fixture(scope="module")
def fit(fitter, people) -> BodyFit:
    return fitter.fit(make_targets(people[1]))


def mahalanobis(error: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    return np.einsum("...i,...ij,...j->...", error, np.linalg.inv(covariance), error)


@pytest.mark.slow
@pytest.mark.parametrize(
    "hidden", [("RWrist",), ("LElbow", "LWrist"), ("RAnkle", "RBigToe", "RSmallToe", "RHeel")]
)
def test_covariances_are_calibrated_for_hidden_joints(fitter, people, hidden):
    joints = tuple(BODY_25.index(name) for name in hidden)
    fit = fitter.fit(make_targets(people[1], without=joints))
    index = list(joints)
    covariance = fit.covariance[fit.ok][:, index] + MODEL_SIGMA_M**2 * np.eye(3)
    squared = mahalanobis((fit.joints - people[0])[fit.ok][:, index], covariance)
    assert 0.8 < np.median(squared) < 3.5
    assert squared.mean() < 6  # swinging limbs are not Gaussian: the tail is heavier


def test_covariances_are_symmetric_and_positive(fit):
    covariance = fit.covariance[fit.ok]
    np.testing.assert_allclose(covariance, covariance.swapaxes(-1, -2), atol=1e-9)
    assert np.linalg.eigvalsh(covariance).min() > 0
