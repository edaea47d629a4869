import numpy as np
import pytest
import torch

from shapepose_fg.body.fitting.baseline import LevenbergMarquardtFitter
from shapepose_fg.body.fitting.pose_prior import PosePrior
from shapepose_fg.body.model.body_model import BodyModel
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.evaluation.fitting import (
    GROUPS,
    LIMBS,
    SETTINGS,
    Corruption,
    corrupt,
    draw_missing,
    fit_calibration,
    fit_errors,
    sigma_ratios,
    true_bodies,
)
from shapepose_fg.evaluation.fitting_methods import (
    ClosedFormFitter,
    Curve,
    Method,
    curve,
    fits_per_second,
    plain_methods,
    timed_fit,
)
from shapepose_fg.evaluation.fitting_optimum import check_optimum
from shapepose_fg.evaluation.gradient_descent import GradientDescentFitter

NOISY = SETTINGS[2]


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def model() -> BodyModel:
    return BodyModel.default()


@pytest.fixture(scope="module")
def truth(model):
    rng = np.random.default_rng(0)
    poses = np.concatenate([rng.normal(0, 0.1, (64, 1, 3)), PosePrior.default().sample(rng, 64)], axis=1)
    return true_bodies(poses, model, rng)


@pytest.fixture(scope="module")
def noisy(truth):
    return corrupt(truth.keypoints, NOISY, np.random.default_rng(1))


@pytest.fixture(scope="module")
def fit(noisy):
    return LevenbergMarquardtFitter().fit(noisy[0])


def test_true_bodies_stand_upright_in_the_room(truth):
    heads, feet = (truth.keypoints[:, BODY_25.index(name), 2] for name in ("Nose", "LHeel"))
    assert np.median(heads - feet) > 1.2  # z is up
    assert np.abs(truth.transl[:, :2]).max() <= 2.0
    assert np.abs(truth.betas).max() <= 2.5
    headings = np.diff(truth.keypoints[:, [BODY_25.index("RHip"), BODY_25.index("LHip")], :2], axis=1)[:, 0]
    assert np.linalg.norm((headings / np.linalg.norm(headings, axis=1, keepdims=True)).mean(axis=0)) < 0.3


def test_true_bodies_refuse_poses_without_a_root(model):
    with pytest.raises(ValueError, match="root"):
        true_bodies(np.zeros((2, 23, 3)), model, np.random.default_rng(0))


def test_half_of_what_is_missing_goes_with_its_limb():
    missing = draw_missing(20_000, 0.3, np.random.default_rng(0))
    assert missing.mean() == pytest.approx(0.3, abs=0.005)  # five times its standard error
    trunk = np.setdiff1d(np.arange(25), np.concatenate(LIMBS))
    assert missing[:, trunk].mean() == pytest.approx(3.75 / 21.25, abs=0.005)  # singly only
    whole = np.mean([missing[:, limb].all(axis=1).mean() for limb in LIMBS])
    single = 3.75 / 21.25
    by_chance = np.mean([single ** len(limb) for limb in LIMBS])
    limbs_gone = 3.75 / 18
    assert whole == pytest.approx(limbs_gone + (1 - limbs_gone) * by_chance, abs=0.01)


def test_corruption_is_what_its_targets_say(truth):
    rng = np.random.default_rng(0)
    targets, missing = corrupt(truth.keypoints, NOISY, rng)
    assert not targets.information[missing].any()
    assert np.isnan(targets.xyz[missing]).all()
    np.testing.assert_allclose(
        targets.information[~missing], np.broadcast_to(np.eye(3) / 0.02**2, ((~missing).sum(), 3, 3))
    )
    error = (targets.xyz - truth.keypoints)[~missing]
    assert error.std() == pytest.approx(0.02, rel=0.05)  # 3,000 numbers: 1.3 % is one sigma
    clean, none = corrupt(truth.keypoints, SETTINGS[0], rng)
    assert not none.any()
    np.testing.assert_array_equal(clean.xyz, truth.keypoints)
    np.testing.assert_allclose(clean.information[0, 0], np.eye(3) / 0.005**2)


@pytest.mark.parametrize("wrong", [{"sigma_m": -1.0}, {"missing": 1.0}])
def test_corruption_refuses_nonsense(wrong):
    with pytest.raises(ValueError, match="must"):
        Corruption("wrong", **wrong)


def test_the_truth_has_no_error_and_a_shift_has_its_length(model, truth, noisy, fit):
    perfect = fit.with_rows(np.arange(len(truth)), fit)
    for name in ("betas", "global_orient", "body_pose", "transl"):
        getattr(perfect, name)[:] = getattr(truth, name)
    perfect.joints[:] = truth.keypoints
    exact = fit_errors(perfect, truth, noisy[1], model)
    assert exact.mean_mm == exact.seen_mm == exact.missing_mm == 0
    assert exact.vertex_mm < 1e-3  # micrometres: single precision
    perfect.transl[:] += [0.03, 0.0, 0.04]
    perfect.joints[:] += [0.03, 0.0, 0.04]
    shifted = fit_errors(perfect, truth, noisy[1], model, meshes=8)
    assert len(shifted.vertices_mm) == 8
    for value in (shifted.mean_mm, shifted.seen_mm, shifted.missing_mm, shifted.vertex_mm):
        assert value == pytest.approx(50, abs=1e-2)


def test_rows_without_a_body_are_counted_not_averaged(model, truth, noisy):
    xyz = noisy[0].xyz.copy()
    information = noisy[0].information.copy()
    information[3] = 0
    fit = LevenbergMarquardtFitter().fit(type(noisy[0])(xyz, information))
    errors = fit_errors(fit, truth, noisy[1], model)
    assert errors.fitted.sum() == len(truth) - 1
    assert np.isfinite([errors.mean_mm, errors.missing_mm, errors.vertex_mm]).all()


def test_batches_change_nothing(noisy, fit):
    parts, ms = timed_fit(LevenbergMarquardtFitter(), noisy[0], 24, rounds=2)
    assert ms.shape == (4,)  # of 24, 24 and 16 rows the last fill no batch
    assert len(parts) == len(fit)
    np.testing.assert_allclose(parts.joints, fit.joints, atol=2e-3)  # rounding, where an energy is flat


def test_fitters_rank_as_they_must(model, truth, noisy, fit):
    """The closed form is worse than the optimum; a hundred first-order steps come near it."""
    optimum = fit_errors(fit, truth, noisy[1], model)
    start = fit_errors(ClosedFormFitter().fit(noisy[0]), truth, noisy[1], model)
    descent = fit_errors(GradientDescentFitter().fit(noisy[0]), truth, noisy[1], model)
    assert optimum.seen_mm < 0.7 * start.seen_mm
    assert abs(descent.mean_mm - optimum.mean_mm) < 0.1 * optimum.mean_mm
    from_closed_form = fit_errors(ClosedFormFitter(steps=None).fit(noisy[0]), truth, noisy[1], model)
    assert abs(from_closed_form.mean_mm - optimum.mean_mm) < 0.1 * optimum.mean_mm


def test_covariances_of_a_perfect_model_are_about_honest(truth, noisy, fit):
    """Bodies and poses come from the very priors that are used, so that the beliefs are nearly true."""
    seen = ~noisy[1]
    found = fit_calibration(fit, truth, seen)
    assert len(found.nees) == seen.sum()
    assert 0.8 < found.coverage[0.9] < 1.0
    alone = fit_calibration(fit, truth, seen, left_out=True)
    assert alone.mean_nees < 6  # without its own target, a joint is a prediction
    ratios = sigma_ratios(fit, truth, seen)
    assert set(ratios) == set(GROUPS)
    assert all(0.5 < value < 3 for value in ratios.values())
    assert np.isnan(list(sigma_ratios(fit, truth, np.zeros_like(seen)).values())).all()


def test_levenberg_marquardt_ends_in_an_optimum(truth, noisy):
    targets = type(noisy[0])(noisy[0].xyz[:2], noisy[0].information[:2])
    check = check_optimum(targets, ClosedFormFitter().fit(targets))
    # The fitter stops where a step gains less than 0.01; L-BFGS finds as much again, spread over small steps.
    assert (check.energy - check.from_there).max() < 0.1
    assert (check.from_there <= check.energy + 1e-9).all()
    assert check.moved_mm.max() < 5
    assert np.median(np.abs(check.from_elsewhere - check.from_there)) < 0.1


def test_a_curve_falls_and_tells_when_an_error_was_reached(truth, noisy):
    method = plain_methods()[2]
    few = Method(method.name, method.make, (1, 3, 12))
    found = curve(few, noisy[0], truth.keypoints, batch=32)
    assert found.ms.shape == found.error_mm.shape == (3,)
    assert (np.diff(found.error_mm) < 0).all()
    assert found.time_to(found.error_mm[1]) <= found.ms[1]
    made = Curve(np.array([1.0, 2.0, 4.0]), np.array([30.0, 20.0, 19.0]))
    assert made.time_to(20.0) == 2.0
    assert made.time_to(10.0) == np.inf


def test_timing_needs_a_full_batch(noisy):
    with pytest.raises(ValueError, match="batch"):
        timed_fit(ClosedFormFitter(), noisy[0], 1000)
    threads = torch.get_num_threads()
    assert fits_per_second(ClosedFormFitter(), noisy[0], 32, workers=2) > 0
    assert torch.get_num_threads() == threads
