"""The learned fitter with the weights that ship: errors, independence, offsets, bad input.

Bounds on errors leave room for other weights: they say that the fitter works, `docs/evaluation.md`
how well.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from shapepose_fg.body.fitting.fitter import BodyConfig, BodyFit, FitStatus, JointTargets
from shapepose_fg.body.fitting.fitters import SmplFitter
from shapepose_fg.body.fitting.priors import PosePrior
from shapepose_fg.body.model.body_model import BodyModel, BodyParameters
from shapepose_fg.body.model.target_skeletons import BODY_POINTS, TARGET_SKELETONS
from shapepose_fg.core.skeleton import BODY_25
from tests.body.mirrored_offsets import symmetric

COUNT = 32
WRIST, ELBOW = BODY_25.index("RWrist"), BODY_25.index("RElbow")


def draw_bodies(count: int, rows_each: int = 1) -> BodyParameters:
    """`count` people of `rows_each` poses from the prior, standing in a z-up world, any heading."""
    rng = np.random.default_rng(0)
    rows = count * rows_each
    heading = Rotation.from_euler("z", rng.uniform(-np.pi, np.pi, (rows, 1)))
    orient = (heading * Rotation.from_rotvec([np.pi / 2, 0, 0])).as_rotvec()
    betas = np.repeat(np.clip(rng.normal(size=(count, 10)), -2, 2), rows_each, axis=0)
    poses, transl = PosePrior.default().sample(rng, rows), rng.uniform(-3, 3, (rows, 3))
    return BodyParameters(*((betas, orient, poses, transl)))


def known_to(xyz: np.ndarray, sigma_m: float) -> JointTargets:
    return JointTargets(xyz.copy(), np.broadcast_to(np.eye(3) / sigma_m**2, (*xyz.shape, 3)).copy())


def distance_mm(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return 1000 * np.linalg.norm(a - b, axis=-1)


@pytest.fixture(scope="module")
def fitter(shipped_weights) -> SmplFitter:
    return SmplFitter(weights=shipped_weights)


@pytest.fixture(scope="module")
def joints() -> np.ndarray:
    """(COUNT, 25, 3) true joints."""
    return BodyModel.default().keypoints(draw_bodies(COUNT))


@pytest.fixture(scope="module")
def uneven(joints) -> JointTargets:
    """Noisy targets, surer along some directions than along others, forearms missing from every
    third row.
    """
    rng = np.random.default_rng(1)
    A = 0.02 * rng.normal(size=(*joints.shape, 3))
    information = np.linalg.inv(0.01**2 * np.eye(3) + A @ A.swapaxes(-1, -2))
    information[::3, [ELBOW, WRIST]] = 0
    return JointTargets(joints + rng.normal(0, 0.01, joints.shape), information)


@pytest.fixture(scope="module")
def fit(fitter, uneven) -> BodyFit:
    return fitter.fit(uneven)


def test_clean_joints_come_back(fitter, joints):
    fit = fitter.fit(known_to(joints, 0.005))
    assert fit.ok.all()
    # 6.3 mm with weights that were a third trained; a tenth of the prior's poses are wilder than
    # any recorded.
    assert distance_mm(fit.joints, joints).mean() < 8
    assert np.median(distance_mm(fit.joints, joints)) < 6


@pytest.mark.parametrize("name", ["COCO_17", "HALPE_26", "SMPL_24"])
def test_clean_joints_of_other_skeletons_come_back(shipped_weights, name):
    model = BodyModel.default().with_keypoints(TARGET_SKELETONS[name])
    truth = model.keypoints(draw_bodies(COUNT))
    fit = SmplFitter(model, weights=shipped_weights).fit(known_to(truth, 0.005))
    assert fit.ok.all() and fit.joints.shape == truth.shape
    # COCO has neither feet nor neck, SMPL has a spine and hands that no prior bends far: a little
    # more room.
    assert distance_mm(fit.joints, truth).mean() < 12


def test_noise_is_averaged_out(fitter, joints):
    noise = np.random.default_rng(1).normal(0, 0.02, joints.shape)
    fit = fitter.fit(known_to(joints + noise, 0.02))
    # 20 mm an axis is 32 mm in length; 25 joints hang together in fewer than 75 ways.
    assert distance_mm(fit.joints, joints).mean() < 0.8 * distance_mm(noise, 0).mean()


def test_the_polish_pays_and_needs_the_network(fitter, shipped_weights, joints):
    unpolished = SmplFitter(weights=shipped_weights, config=BodyConfig(polish_steps=0))
    targets = known_to(joints, 0.005)
    rough = unpolished.fit(targets)
    rough_mm = distance_mm(rough.joints, joints)[rough.ok].mean()
    assert distance_mm(fitter.fit(targets).joints, joints).mean() < 0.9 * rough_mm
    assert rough_mm < 40  # a mean pose put on the joints is 110 mm off


def test_parameters_are_the_body_that_has_the_joints(fit):
    parameters = BodyParameters(*((fit.betas, fit.global_orient, fit.body_pose, fit.transl)))
    keypoints = BodyModel.default().keypoints(parameters)
    assert fit.ok.all()
    assert distance_mm(fit.joints, keypoints).max() < 0.01  # single precision


def test_a_world_turned_and_moved_has_the_same_bodies_turned_and_moved(fitter, uneven, fit):
    R, t = Rotation.random(random_state=0).as_matrix(), np.array([20.0, -7.0, 3.0])
    moved = fitter.fit(JointTargets(uneven.xyz @ R.T + t, R @ uneven.information @ R.T))
    # Single precision within a metre of each person, 1e-6 m, times a condition of 100 at most.
    np.testing.assert_allclose(moved.joints, fit.joints @ R.T + t, atol=1e-4)
    np.testing.assert_allclose(moved.betas, fit.betas, atol=1e-3)
    np.testing.assert_allclose(moved.body_pose, fit.body_pose, atol=1e-3)
    np.testing.assert_allclose(moved.covariance, R @ fit.covariance @ R.T, atol=1e-5)


def test_a_row_alone_is_the_row_of_a_batch(fitter, uneven, fit):
    for row in (0, 7):
        alone = fitter.fit(JointTargets(uneven.xyz[[row]], uneven.information[[row]]))
        np.testing.assert_allclose(
            alone.joints[0], fit.joints[row], atol=1e-4
        )  # products in another order
        np.testing.assert_allclose(alone.betas[0], fit.betas[row], atol=1e-3)


def test_where_a_fit_starts_does_not_matter(fitter, uneven, fit):
    np.testing.assert_array_equal(fitter.fit(uneven, initial=fit).joints, fit.joints)


@pytest.mark.parametrize("anything", [np.nan, np.inf, 1e6])
def test_the_place_of_a_missing_joint_is_not_looked_at(fitter, uneven, fit, anything):
    xyz = uneven.xyz.copy()
    xyz[::3, [ELBOW, WRIST]] = anything
    np.testing.assert_array_equal(
        fitter.fit(JointTargets(xyz, uneven.information)).joints, fit.joints
    )


def test_missing_joints_are_filled_in_and_known_to_be_guesses(fit, joints):
    length = np.linalg.norm((fit.joints - joints)[::3, WRIST], axis=-1)
    assert np.median(length) < 0.3  # a guess, but on the right side: an arm is 0.55 m
    sigma = np.sqrt(np.trace(fit.covariance, axis1=-2, axis2=-1) / 3)[::3]
    assert (sigma[:, WRIST] > 3 * sigma[:, BODY_25.index("LWrist")]).all()
    assert np.linalg.eigvalsh(fit.covariance).min() > 0


def test_beliefs_about_missing_joints_are_as_wide_as_the_weights_say(shipped_weights, uneven):
    one, four = (replace(shipped_weights, spread=np.full(len(BODY_POINTS), s)) for s in (1.0, 4.0))
    narrow, wide = (SmplFitter(weights=weights).fit(uneven) for weights in (one, four))
    hidden = ~uneven.information.any(axis=(-1, -2))
    np.testing.assert_allclose(wide.covariance[hidden], 4 * narrow.covariance[hidden], rtol=1e-9)
    np.testing.assert_array_equal(wide.covariance[~hidden], narrow.covariance[~hidden])
    np.testing.assert_array_equal(wide.joints, narrow.joints)


def test_bad_rows_get_a_status_and_leave_the_others_alone(fitter, joints):
    targets = known_to(joints[:8], 0.01)
    good = fitter.fit(targets)
    xyz, information = targets.xyz.copy(), targets.information.copy()
    information[0] = 0  # all missing
    xyz[1, 3, 1] = np.nan
    information[2, 5, 0, 0] = np.nan
    information[3, 5] *= -1
    xyz[4] = xyz[4, :1]  # collapsed: all joints in one point
    xyz[5] = xyz[5, :1] + np.linspace(0, 1, 25)[:, None] * [0.2, 0.3, 1.0]  # all on a line
    information[6, 3:] = 0
    fit = fitter.fit(JointTargets(xyz, information))
    few, invalid = FitStatus.TOO_FEW_JOINTS, FitStatus.INVALID_TARGETS
    assert fit.status.tolist() == [few, invalid, invalid, invalid, few, few, few, FitStatus.OK]
    for values in (fit.betas, fit.global_orient, fit.body_pose, fit.transl):
        assert not values[:7].any() and np.isfinite(values).all()
    assert np.isnan(fit.joints[:7]).all() and np.isnan(fit.residual_m[:7]).all()
    np.testing.assert_allclose(fit.joints[7], good.joints[7], atol=1e-4)


@pytest.mark.parametrize("scale", [0.2, 100.0, 1e6])
def test_what_is_no_person_never_becomes_nan(fitter, joints, scale):
    fit = fitter.fit(known_to(joints[:4] * scale, 0.01))
    assert set(fit.status) <= {FitStatus.OK, FitStatus.NOT_CONVERGED, FitStatus.TOO_FEW_JOINTS}
    for values in (fit.betas, fit.global_orient, fit.body_pose, fit.transl, fit.joints[fit.ok]):
        assert np.isfinite(values).all()
    clean = fitter.fit(known_to(joints[:4], 0.01)).residual_m
    assert (fit.residual_m[fit.ok] > 3 * np.median(clean)).all()  # it says that it does not fit


def test_where_the_network_goes_wild_the_plain_optimiser_fits(shipped_weights, joints):
    trained = shipped_weights.network
    network = type(trained)(
        trained.config, {**trained.weights, "leave.bias": trained.weights["leave.bias"] + 1e30}
    )
    fit = SmplFitter(weights=replace(shipped_weights, network=network)).fit(
        known_to(joints[:3], 0.01)
    )
    plain = SmplFitter().fit(known_to(joints[:3], 0.01))
    assert fit.ok.all()
    np.testing.assert_array_equal(fit.joints, plain.joints)


def test_no_rows_give_no_bodies(fitter):
    fit = fitter.fit(JointTargets(np.zeros((0, 25, 3)), np.zeros((0, 25, 3, 3))))
    assert len(fit) == 0 and fit.joints.shape == (0, 25, 3)


def test_a_detector_that_puts_joints_elsewhere_is_followed(fitter, shipped_weights, joints):
    offsets = symmetric({"LHip": (0.05, 0.06, 0.0), "LAnkle": (0.0, 0.0, -0.05)})
    elsewhere = fitter.with_keypoint_offsets(offsets)
    truth = elsewhere.model.keypoints(draw_bodies(COUNT))
    hip = BODY_25.index("LHip")
    assert distance_mm(truth[:, hip], joints[:, hip]) == pytest.approx(
        1000 * np.hypot(0.05, 0.06), abs=0.01
    )
    targets = known_to(truth, 0.005)
    informed, naive = elsewhere.fit(targets), fitter.fit(targets)
    assert distance_mm(informed.joints, truth).mean() < 8
    assert (
        distance_mm(informed.joints, truth)[:, hip].mean()
        < 0.5 * distance_mm(naive.joints, truth)[:, hip].mean()
    )
    body = fitter.model.keypoints(
        BodyParameters(*((informed.betas, informed.global_orient, informed.body_pose,
                                               informed.transl)))
    )  # fmt: skip
    assert distance_mm(body, joints).mean() < 8  # the body itself is where it was


def test_offsets_of_joints_that_a_skeleton_lacks_change_nothing(shipped_weights):
    model = BodyModel.default().with_keypoints(TARGET_SKELETONS["COCO_17"])
    plain = SmplFitter(model, weights=shipped_weights)
    targets = known_to(model.keypoints(draw_bodies(4)), 0.01)
    offsets = symmetric({"Neck": (0.0, 0.15, 0.0), "LBigToe": (0.1, 0.0, 0.1)})
    moved = plain.with_keypoint_offsets(offsets).fit(targets)
    np.testing.assert_array_equal(moved.joints, plain.fit(targets).joints)


def test_misuse_is_refused(fitter, joints):
    with pytest.raises(ValueError, match="the 25 keypoints of the body, got 17"):
        fitter.fit(known_to(joints[:, :17], 0.01))
    with pytest.raises(ValueError, match="polish_steps must not be negative"):
        BodyConfig(polish_steps=-1)
