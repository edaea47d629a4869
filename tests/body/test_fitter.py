import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from shapepose_fg.body.fitting import optimisers
from shapepose_fg.body.fitting.fitter import (
    BodyConfig,
    BodyFit,
    FitStatus,
    JointTargets,
    check_fitter,
)
from shapepose_fg.body.fitting.fitters import SmplFitter
from shapepose_fg.body.fitting.priors import PosePrior
from shapepose_fg.body.model.body_model import BodyModel, BodyParameters
from shapepose_fg.core.skeleton import BODY_25

WRIST, ELBOW, ANKLE = BODY_25.index("RWrist"), BODY_25.index("RElbow"), BODY_25.index("LAnkle")


def draw_joints(count: int, seed: int = 0) -> np.ndarray:
    """BODY_25 joints (count, 25, 3) of random people standing in a z-up world, any heading."""
    rng = np.random.default_rng(seed)
    heading = Rotation.from_euler("z", rng.uniform(-np.pi, np.pi, (count, 1)))
    orient = (heading * Rotation.from_rotvec([np.pi / 2, 0, 0])).as_rotvec()
    betas = np.clip(rng.normal(size=(count, 10)), -2, 2)
    poses, transl = PosePrior.default().sample(rng, count), rng.uniform(-3, 3, (count, 3))
    parameters = BodyParameters(*((betas, orient, poses, transl)))
    return BodyModel.default().keypoints(parameters)


def make_targets(xyz: np.ndarray, sigma_m: float) -> JointTargets:
    return JointTargets(xyz.copy(), np.broadcast_to(np.eye(3) / sigma_m**2, (*xyz.shape, 3)).copy())


def distance_mm(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return 1000 * np.linalg.norm(a - b, axis=-1)


@pytest.fixture(scope="module")
def fitter() -> SmplFitter:
    return SmplFitter()


@pytest.fixture(scope="module")
def joints() -> np.ndarray:
    return draw_joints(48)


def test_noiseless_joints_come_back_to_the_millimetre(joints, monkeypatch):
    # Targets believed to 1 mm leave the priors no say; a quarter of a millimetre is left of them.
    monkeypatch.setattr(optimisers, "TOLERANCE", 1e-4)
    fit = SmplFitter(config=BodyConfig(model_sigma_m=1e-3)).fit(make_targets(joints, 1e-3))
    assert fit.ok.all()
    assert np.median(distance_mm(fit.joints, joints)) < 1.0
    assert np.median(fit.residual_m) < 1e-3


def test_fit_averages_noise_out(fitter, joints):
    noise = np.random.default_rng(1).normal(0, 0.02, joints.shape)
    fit = fitter.fit(make_targets(joints + noise, 0.02))
    # 20 mm an axis is 32 mm in length; 25 joints hang together in fewer than 75 ways.
    assert distance_mm(fit.joints, joints).mean() < 0.8 * distance_mm(noise, 0).mean()


def test_parameters_are_the_body_that_has_the_joints(fitter, joints):
    fit = fitter.fit(make_targets(joints, 0.01))
    parts = (fit.betas, fit.global_orient, fit.body_pose, fit.transl)
    parameters = BodyParameters(*(parts))
    keypoints = BodyModel.default().keypoints(parameters)
    assert distance_mm(fit.joints, keypoints).max() < 0.01  # single precision


def test_hidden_forearm_is_filled_in_at_its_length(fitter, joints):
    targets = make_targets(joints, 0.01)
    targets.information[:, [ELBOW, WRIST]] = 0
    targets.xyz[:, [ELBOW, WRIST]] = np.nan  # nobody looks at a joint without information
    fit = fitter.fit(targets)
    assert fit.ok.all()
    length = np.linalg.norm(fit.joints[:, WRIST] - fit.joints[:, ELBOW], axis=-1)
    truth = np.linalg.norm(joints[:, WRIST] - joints[:, ELBOW], axis=-1)
    assert np.abs(length - truth).mean() < 0.015  # the other bones tell the size
    seen = np.setdiff1d(np.arange(25), [ELBOW, WRIST])
    assert distance_mm(fit.joints[:, seen], joints[:, seen]).mean() < 10
    assert (
        np.median(distance_mm(fit.joints[:, WRIST], joints[:, WRIST])) < 300
    )  # a guess, but on the right side
    sigma = np.sqrt(np.trace(fit.covariance, axis1=-2, axis2=-1) / 3)
    assert (sigma[:, WRIST] > 3 * sigma[:, BODY_25.index("LWrist")]).all()


def test_a_ray_holds_a_joint_across_but_not_along(fitter, joints):
    camera = joints.mean(axis=1) + np.array([4.0, 0.0, 0.5])
    ray = joints[:, WRIST] - camera
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    across = np.eye(3) - ray[:, :, None] * ray[:, None]
    targets = make_targets(joints, 0.01)
    targets.information[:, WRIST] = across / 0.01**2
    targets.xyz[:, WRIST] += 0.7 * ray  # its place along the ray means nothing
    fit = fitter.fit(targets)
    assert fit.ok.all()
    error = fit.joints[:, WRIST] - joints[:, WRIST]
    along = np.abs(np.einsum("bx,bx->b", error, ray))
    assert (
        np.median(np.linalg.norm(error - np.einsum("bx,bx,by->by", error, ray, ray), axis=1))
        < 0.015
    )
    assert np.median(along) < 0.15  # the body's bones, not the ray, say how far
    variance_along = np.einsum("bx,bxy,by->b", ray, fit.covariance[:, WRIST], ray)
    rest = (np.trace(fit.covariance[:, WRIST], axis1=-2, axis2=-1) - variance_along) / 2
    assert (variance_along > rest).mean() > 0.9


def test_an_outlier_bends_nothing_else(fitter, joints):
    targets = make_targets(joints, 0.01)
    clean = fitter.fit(targets)
    targets.xyz[:, ANKLE] += [0.0, 0.0, 0.6]
    fit = fitter.fit(targets)
    others = np.setdiff1d(np.arange(25), ANKLE)
    assert np.median(distance_mm(fit.joints[:, others], clean.joints[:, others])) < 2
    # The foot of the same leg tells where the ankle is.
    assert np.median(distance_mm(fit.joints[:, ANKLE], joints[:, ANKLE])) < 40


def degenerate_targets(joints: np.ndarray) -> tuple[JointTargets, list[FitStatus]]:
    """One row per way to be unusable, and its status."""
    targets = make_targets(joints[:8], 0.01)
    xyz, information = targets.xyz, targets.information
    information[0] = 0
    information[1, 3:] = 0
    leg = [BODY_25.index(name) for name in ("RHip", "RKnee", "RAnkle", "RHeel")]
    information[2, np.setdiff1d(np.arange(25), leg)] = 0
    xyz[2, leg] = np.arange(4)[:, None] * [0.0, 0.01, -0.4]
    xyz[3] = [1.0, 2.0, 1.0]
    ray = np.diag([1.0, 1.0, 0.0]) / 0.01**2
    information[4] = ray
    xyz[5, 7, 1] = np.nan
    information[6, 2, 0, 0] = np.inf
    information[7, 2] = -np.eye(3)
    return targets, [FitStatus.TOO_FEW_JOINTS] * 5 + [FitStatus.INVALID_TARGETS] * 3


def test_degenerate_rows_get_a_name_and_no_nan_in_parameters(fitter, joints):
    targets, expected = degenerate_targets(joints)
    good = make_targets(joints[8:10], 0.01)
    both = JointTargets(
        np.concatenate([targets.xyz, good.xyz]),
        np.concatenate([targets.information, good.information]),
    )
    fit = fitter.fit(both)
    assert fit.status.tolist() == [*expected, FitStatus.OK, FitStatus.OK]
    for name in ("betas", "global_orient", "body_pose", "transl"):
        assert not np.any(getattr(fit, name)[:8])
    for name in ("joints", "covariance", "residual_m"):
        assert np.isnan(getattr(fit, name)[:8]).all()
        assert np.isfinite(getattr(fit, name)[8:]).all()
    assert distance_mm(fit.joints[8:], fitter.fit(good).joints).max() < 1


def test_no_rows_is_no_people(fitter):
    fit = fitter.fit(JointTargets(np.zeros((0, 25, 3)), np.zeros((0, 25, 3, 3))))
    assert len(fit) == 0 and fit.joints.shape == (0, 25, 3)


def test_unfinished_rows_say_so(joints, monkeypatch):
    monkeypatch.setattr(optimisers, "MAX_ITERATIONS", 1)
    fit = SmplFitter().fit(make_targets(joints, 0.001))
    stuck = fit.status == FitStatus.NOT_CONVERGED
    assert stuck.mean() > 0.8
    assert np.isnan(fit.joints[stuck]).all() and not fit.body_pose[stuck].any()


@pytest.mark.slow
def test_alone_in_a_batch_and_in_any_order_is_the_same(fitter, joints):
    noise = np.random.default_rng(2).normal(0, 0.01, joints.shape)
    targets = make_targets(joints + noise, 0.01)
    together = fitter.fit(targets)
    order = np.random.default_rng(3).permutation(len(joints))
    shuffled = fitter.fit(JointTargets(targets.xyz[order], targets.information[order]))
    assert distance_mm(shuffled.joints, together.joints[order]).max() < 1
    for row in range(0, len(joints), 8):
        alone = fitter.fit(JointTargets(targets.xyz[[row]], targets.information[[row]]))
        # Rounding differs with the batch, and a row stops within 0.1 sigma of its optimum: under 1
        # mm.
        assert distance_mm(alone.joints[0], together.joints[row]).max() < 1
        np.testing.assert_allclose(
            alone.covariance[0], together.covariance[row], rtol=0.02, atol=1e-6
        )


@pytest.mark.slow
def test_turning_and_moving_the_world_changes_nothing_else(fitter, joints):
    targets = make_targets(joints, 0.01)
    fit = fitter.fit(targets)
    R = Rotation.from_euler("xyz", [0.4, -1.0, 2.0]).as_matrix()
    shift = np.array([5000.0, -3000.0, 100.0])
    moved = fitter.fit(JointTargets(joints @ R.T + shift, targets.information))
    assert distance_mm(moved.joints, fit.joints @ R.T + shift).max() < 1
    np.testing.assert_allclose(moved.covariance, R @ fit.covariance @ R.T, rtol=0.05, atol=2e-6)


@pytest.mark.slow
def test_warm_start_is_quicker_and_ends_at_the_same_place(joints, monkeypatch):
    fitter, evaluations = SmplFitter(), []
    solve, linearise = fitter.optimiser.solve, fitter.energy.linearise
    monkeypatch.setattr(
        fitter.optimiser, "solve", lambda *args: evaluations.append(0) or solve(*args)
    )

    def counted(free, *rest):
        if evaluations:
            evaluations[-1] += len(free)
        return linearise(free, *rest)

    monkeypatch.setattr(fitter.energy, "linearise", counted)
    rng = np.random.default_rng(4)
    first = fitter.fit(make_targets(joints + rng.normal(0, 0.01, joints.shape), 0.01))
    targets = make_targets(joints + rng.normal(0, 0.01, joints.shape), 0.01)
    evaluations.clear()
    cold = fitter.fit(targets)
    cold_evaluations = evaluations.copy()
    evaluations.clear()
    warm = fitter.fit(targets, initial=first)
    assert sum(evaluations) < 0.7 * sum(cold_evaluations)
    assert np.quantile(distance_mm(warm.joints, cold.joints), 0.95) < 1


def test_rows_without_an_earlier_body_start_afresh(fitter, joints):
    targets = make_targets(joints[:6], 0.01)
    status = np.full(6, FitStatus.TOO_FEW_JOINTS)
    fit = fitter.fit(targets, initial=BodyFit.failed(status, 25))
    assert distance_mm(fit.joints, fitter.fit(targets).joints).max() < 0.1


def test_a_failed_row_takes_any_other_status():
    """`invalid_targets` is longer than the text that the rows were made with."""
    before, after = (
        BodyFit.failed(np.full(2, each), 25) for each in ("too_few_joints", "invalid_targets")
    )
    before.put(np.array([1]), after.rows(np.array([1])))
    assert before.status.tolist() == [FitStatus.TOO_FEW_JOINTS, FitStatus.INVALID_TARGETS]


def test_misuse_is_told(fitter, joints):
    with pytest.raises(ValueError, match=r"xyz must be \(B, J, 3\)"):
        JointTargets(joints[0], np.zeros((25, 3, 3)))
    with pytest.raises(ValueError, match="information must be"):
        JointTargets(joints, np.zeros((1, 25, 3)))
    with pytest.raises(ValueError, match="25 keypoints of the body"):
        fitter.fit(make_targets(joints[:, :18], 0.01))
    with pytest.raises(ValueError, match="one row per target"):
        fitter.fit(make_targets(joints, 0.01), initial=fitter.fit(make_targets(joints[:2], 0.01)))
    with pytest.raises(ValueError, match="kernel_scale must be positive"):
        BodyConfig(kernel_scale=0)
    with pytest.raises(ValueError, match="model_sigma_m must be positive"):
        BodyConfig(model_sigma_m=-1)
    with pytest.raises(
        TypeError, match=r"object must inherit from .*BodyFitter, which makes the other methods"
    ):
        check_fitter(object())
