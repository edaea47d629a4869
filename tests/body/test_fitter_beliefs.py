import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from shapepose_fg.body.fitting.baseline import LevenbergMarquardtFitter
from shapepose_fg.body.fitting.fitter import BodyFit, JointTargets
from shapepose_fg.body.fitting.leave_one_out import LIMB_M, joint_posterior
from shapepose_fg.body.fitting.pose_prior import PosePrior
from shapepose_fg.body.model.body_model import BodyModel, BodyParameters
from shapepose_fg.skeleton import BODY_25

MODEL_SIGMA_M = 0.02
NOISE_M = 0.01
COUNT = 160


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    """Small matrices in several threads wait for each other where other work runs on the same cores."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def people() -> tuple[np.ndarray, np.ndarray]:
    """Joints of bodies drawn from the priors as this detector sees them (COUNT, 25, 3), and with noise."""
    rng = np.random.default_rng(0)
    orient = Rotation.from_euler("z", rng.uniform(-np.pi, np.pi, (COUNT, 1)))
    orient = (orient * Rotation.from_rotvec([np.pi / 2, 0, 0])).as_rotvec()
    poses = PosePrior.default().sample(rng, COUNT)
    parts = (rng.normal(size=(COUNT, 10)), orient, poses, rng.uniform(-3, 3, (COUNT, 3)))
    body = BodyModel.default().to(torch.float64).keypoints(BodyParameters(*map(torch.from_numpy, parts)))
    truth = body.numpy() + rng.normal(0, MODEL_SIGMA_M, (COUNT, 25, 3))
    return truth, truth + rng.normal(0, NOISE_M, truth.shape)


def make_targets(xyz: np.ndarray, without: tuple[int, ...] = ()) -> JointTargets:
    information = np.broadcast_to(np.eye(3) / NOISE_M**2, (*xyz.shape, 3)).copy()
    information[:, list(without)] = 0
    return JointTargets(xyz, information)


@pytest.fixture(scope="module")
def fitter() -> LevenbergMarquardtFitter:
    return LevenbergMarquardtFitter()


@pytest.fixture(scope="module")
def fit(fitter, people) -> BodyFit:
    return fitter.fit(make_targets(people[1]))


def mahalanobis(error: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    return np.einsum("...i,...ij,...j->...", error, np.linalg.inv(covariance), error)


def test_taking_a_target_out_of_a_linear_problem_is_exact():
    rng = np.random.default_rng(0)
    J = torch.from_numpy(rng.normal(size=(2, 4, 3, 6)) * 0.01)
    root = torch.from_numpy(np.tile(np.diag([50.0, 40.0, 30.0]), (2, 4, 1, 1)))
    root[0, 1] = torch.diag(torch.tensor([50.0, 40.0, 0.0]))  # a ray
    root[1, 2] = 0
    residual = torch.from_numpy(rng.normal(size=(2, 4, 3)) * 0.01)
    rows = (root @ J).flatten(1, 2)
    hessian = rows.mT @ rows + torch.eye(6)
    half = torch.linalg.solve_triangular(torch.linalg.cholesky(hessian), J.flatten(1, 2).mT, upper=False)
    xyz = torch.zeros(2, 4, 3, dtype=torch.float64)
    result = joint_posterior(xyz, half, residual, root)
    for row in range(2):
        for joint in range(4):
            L = root[row, joint] @ root[row, joint]
            without = hessian[row] - J[row, joint].mT @ L @ J[row, joint]
            C = J[row, joint] @ torch.linalg.inv(without) @ J[row, joint].mT
            sag = torch.trace(J[row, joint] @ torch.linalg.inv(hessian[row]) @ J[row, joint].mT) / (2 * LIMB_M)
            torch.testing.assert_close(result.left_out_covariance[row, joint], C + sag**2 * torch.eye(3))
            # Without its own pull the optimum moves by H^-1 J^T L r.
            moved = J[row, joint] @ torch.linalg.solve(without, J[row, joint].mT @ L @ residual[row, joint])
            torch.testing.assert_close(result.left_out_xyz[row, joint], moved)


def test_left_out_beliefs_match_a_refit_without_the_joint(fitter, people, fit):
    for name, within_m, ratio in (("Neck", 0.003, 1.05), ("LHip", 0.005, 1.1), ("RAnkle", 0.005, 1.1),
                                  ("RElbow", 0.03, 1.3), ("LWrist", 0.1, 1.5)):  # fmt: skip
        joint = BODY_25.index(name)
        refit = fitter.fit(make_targets(people[1], without=(joint,)))
        moved = refit.joints[:, joint] - fit.prior_xyz[:, joint]
        # A first-order step along a sphere: limbs that may swing far end a little off it.
        assert np.quantile(np.linalg.norm(moved, axis=-1), 0.8) < within_m, name
        ours = np.trace(fit.prior_covariance[:, joint], axis1=-2, axis2=-1)
        theirs = np.trace(refit.prior_covariance[:, joint], axis1=-2, axis2=-1)
        assert 1 / ratio < np.median(ours / theirs) < ratio, name


def test_an_unseen_joint_has_nothing_to_leave_out(fitter, people):
    joint = BODY_25.index("LWrist")
    refit = fitter.fit(make_targets(people[1], without=(joint,)))
    np.testing.assert_allclose(refit.prior_xyz[:, joint], refit.joints[:, joint], atol=1e-9)
    model_error = MODEL_SIGMA_M**2 * np.eye(3)
    np.testing.assert_allclose(
        refit.prior_covariance[:, joint], refit.covariance[:, joint] + model_error, atol=1e-12
    )


def test_a_joints_own_target_does_not_come_back_to_it(fitter, people, fit):
    joint = BODY_25.index("RKnee")
    xyz = people[1].copy()
    xyz[:, joint, 0] += 0.02
    pushed = fitter.fit(make_targets(xyz))
    followed = np.median((pushed.joints - fit.joints)[:, joint, 0])
    echoed = np.median((pushed.prior_xyz - fit.prior_xyz)[:, joint, 0])
    assert followed > 0.004  # the body goes along
    assert abs(echoed) < 0.15 * followed  # what it says of the knee stays, but for curvature


def test_beliefs_are_calibrated_on_bodies_from_the_priors(people, fit):
    """Squared Mahalanobis distances are chi-squared with 3 degrees of freedom: mean 3, median 2.37."""
    squared = mahalanobis(fit.prior_xyz - people[0], fit.prior_covariance)
    assert 2.3 < squared.mean() < 3.6
    assert 1.9 < np.median(squared) < 2.8
    by_joint = np.median(squared, axis=0)
    assert (by_joint > 1.3).all() and (by_joint < 4.0).all()


@pytest.mark.parametrize(
    "hidden", [("RWrist",), ("LElbow", "LWrist"), ("RAnkle", "RBigToe", "RSmallToe", "RHeel")]
)
def test_beliefs_are_calibrated_for_hidden_joints(fitter, people, hidden):
    joints = tuple(BODY_25.index(name) for name in hidden)
    fit = fitter.fit(make_targets(people[1], without=joints))
    index = list(joints)
    squared = mahalanobis((fit.prior_xyz - people[0])[:, index], fit.prior_covariance[:, index])
    assert 1.4 < np.median(squared) < 3.5
    assert squared.mean() < 6  # swinging limbs are not Gaussian: the tail is heavier


def test_covariances_are_symmetric_and_positive(fit):
    for covariance in (fit.covariance, fit.prior_covariance):
        np.testing.assert_allclose(covariance, covariance.swapaxes(-1, -2), atol=1e-12)
        assert np.linalg.eigvalsh(covariance).min() > 0
    # The belief without a target cannot be surer than the belief with it.
    more = np.linalg.eigvalsh(fit.prior_covariance - fit.covariance)
    assert more.min() > 0
