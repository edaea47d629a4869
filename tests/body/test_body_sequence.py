"""Bodies over time, every fitter: one shape, smooth poses, joints, rows without targets, shapes
carried on.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from shapepose_fg.body.fitting import body_sequence, optimisers
from shapepose_fg.body.fitting.fitter import (
    BodyConfig,
    FitStatus,
    JointTargets,
    SequenceFit,
    Shapes,
    check_groups,
)
from shapepose_fg.body.fitting.fitters import SmplFitter, make_fitter
from shapepose_fg.body.fitting.priors import PosePrior
from shapepose_fg.body.model.body_model import BodyModel, BodyParameters
from shapepose_fg.core.skeleton import BODY_25, SMPL_24
from tests.marks import slow

PEOPLE, FRAMES, FPS = 3, 60, 30.0
NOISE_M = 0.015
FITTERS = {"plain": SmplFitter, "learned": make_fitter}
"""Every fitter that ships."""
ARM = [BODY_25.index("RElbow"), BODY_25.index("RWrist")]
HIDDEN = slice(20, 35)
"""Frames in which the first person's right forearm is not seen: half a second."""


def smooth(count: int, rng: np.random.Generator) -> np.ndarray:
    """(PEOPLE, FRAMES, count) of unit variance, varying over a third of a second."""
    white = rng.normal(size=(PEOPLE, FRAMES + 60, count))
    slow = gaussian_filter1d(white, 10.0, axis=1)[:, 30:-30]
    return slow / slow.std()


@pytest.fixture(scope="module")
def bodies() -> BodyParameters:
    """People who move as the priors say, PEOPLE * FRAMES rows."""
    rng = np.random.default_rng(0)
    prior = PosePrior.default()
    factor = np.linalg.cholesky(prior.covariance)
    poses = np.clip(prior.mean + 0.7 * smooth(69, rng) @ factor.T, prior.lower, prior.upper)
    upright = Rotation.from_rotvec([np.pi / 2, 0, 0])
    turn = Rotation.from_euler(
        "z", (1.0 * smooth(1, rng) + np.arange(PEOPLE)[:, None, None]).reshape(-1, 1)
    )
    betas = np.repeat(np.clip(rng.normal(size=(PEOPLE, 10)), -2, 2), FRAMES, axis=0)
    place = (0.3 * smooth(3, rng) + 2 * np.arange(PEOPLE)[:, None, None]).reshape(-1, 3)
    parts = (betas, (turn * upright).as_rotvec(), poses.reshape(-1, 23, 3), place)
    return BodyParameters(*(parts))


@pytest.fixture(scope="module")
def truth(bodies) -> np.ndarray:
    return BodyModel.default().keypoints(bodies)


GROUP = np.repeat([9, -2, 5], FRAMES)
TIME_S = np.tile(np.arange(FRAMES) / FPS, PEOPLE)


@pytest.fixture(scope="module")
def targets(truth) -> JointTargets:
    information = np.broadcast_to(np.eye(3) / NOISE_M**2, (*truth.shape, 3)).copy()
    information[HIDDEN, ARM] = 0
    return JointTargets(
        truth + np.random.default_rng(1).normal(0, NOISE_M, truth.shape), information
    )


def some(targets: JointTargets, rows: np.ndarray) -> JointTargets:
    return JointTargets(targets.xyz[rows], targets.information[rows])


@pytest.fixture(scope="module", params=["learned", *slow("plain")])
def fitter(request) -> SmplFitter:
    return FITTERS[request.param]()


@pytest.fixture(scope="module")
def found(fitter, targets) -> SequenceFit:
    return fitter.fit_sequence(targets, GROUP, TIME_S)


def acceleration(xyz: np.ndarray) -> np.ndarray:
    """(PEOPLE, FRAMES - 2, ...) lengths, m/s²."""
    return (
        np.linalg.norm(np.diff(xyz.reshape(PEOPLE, FRAMES, -1, 3), n=2, axis=1), axis=-1) * FPS**2
    )


def turns_deg(poses: np.ndarray) -> np.ndarray:
    """(PEOPLE, FRAMES - 1, 23) how far each joint turns from frame to frame."""
    R = Rotation.from_rotvec(poses.reshape(-1, 3)).as_matrix().reshape(PEOPLE, FRAMES, 23, 3, 3)
    step = R[:, :-1].swapaxes(-1, -2) @ R[:, 1:]
    return np.degrees(Rotation.from_matrix(step.reshape(-1, 3, 3)).magnitude()).reshape(
        PEOPLE, FRAMES - 1, 23
    )


def stature_m(betas: np.ndarray) -> np.ndarray:
    """(G,) from the soles to the top of the head, T-pose."""
    model, rest = BodyModel.default(), BodyParameters.zeros(len(betas))
    height = model.vertices(replace(rest, betas=betas))[..., 1]
    return np.ptp(height, axis=1)


def test_joints_are_where_they_are(found, truth):
    error = 1e3 * np.linalg.norm(found.fit.joints - truth, axis=-1)
    assert found.fit.ok.all()
    seen = np.ones(error.shape, dtype=bool)
    seen[HIDDEN, ARM] = False
    # 24 mm is the noise's mean length; frame by frame bodies are 15 mm off.
    assert error[seen].mean() < 12 and np.quantile(error[seen], 0.99) < 40
    assert error[~seen].mean() < 150  # half a second without elbow and wrist


@pytest.mark.slow
@pytest.mark.parametrize("size", [0.65, *slow(1.2)])
def test_bodies_far_from_an_adult_s_size_are_as_tall_as_they_are(
    fitter, found, truth, targets, size
):
    small = fitter.fit_sequence(targets.larger(np.full(len(targets), size)), GROUP, TIME_S)
    expected = size * stature_m(found.shapes.mean)
    np.testing.assert_allclose(stature_m(small.shapes.mean), expected, atol=0.03)
    assert small.fit.ok.all() and (small.fit.betas[:FRAMES] == small.fit.betas[0]).all()
    error = 1e3 * np.linalg.norm(small.fit.joints - size * truth, axis=-1)
    assert np.delete(error, HIDDEN, axis=0).mean() < 18  # the nearest shape is not quite theirs


def test_bodies_move_as_the_truth_does(fitter, found, truth, targets):
    alone = fitter.fit(targets)
    true, ours, before = (acceleration(xyz) for xyz in (truth, found.fit.joints, alone.joints))
    # Noise adds to it; frame by frame it is over four times as much.
    assert true.mean() / 1.5 < ours.mean() < 2 * true.mean()
    assert before.mean() > 4 * true.mean()
    off = np.linalg.norm(
        np.diff((found.fit.joints - truth).reshape(PEOPLE, FRAMES, 25, 3), n=2, axis=1), axis=-1
    )
    assert FPS**2 * off.mean() < 10


def test_no_limb_twists_where_the_truth_does_not(found, bodies):
    visible = [SMPL_24.index(name) - 1 for name in SMPL_24[1:] if "hand" not in name]
    extra = (turns_deg(found.fit.body_pose) - turns_deg(bodies.body_pose))[..., visible]
    assert extra.max() < 20


def test_one_person_has_one_shape_and_two_halves_agree(fitter, found, targets, bodies):
    np.testing.assert_array_equal(found.groups, [-2, 5, 9])
    for place, number in enumerate(found.groups):
        betas = found.fit.betas[number == GROUP]
        np.testing.assert_allclose(betas, np.tile(found.shapes.mean[place], (FRAMES, 1)), atol=1e-5)
    true = stature_m(np.stack([bodies.betas[number == GROUP][0] for number in found.groups]))
    assert np.abs(stature_m(found.shapes.mean) - true).max() < 0.03
    first = TIME_S < FRAMES / 2 / FPS
    halves = [
        fitter.fit_sequence(some(targets, rows), GROUP[rows], TIME_S[rows]).shapes.mean
        for rows in (first, ~first)
    ]
    assert np.abs(stature_m(halves[0]) - stature_m(halves[1])).max() < 0.02


def test_what_is_known_of_a_shape_holds_the_true_one(found, bodies):
    apart = found.shapes.mean - np.stack(
        [bodies.betas[number == GROUP][0] for number in found.groups]
    )
    squared = np.einsum("gi,gij,gj->g", apart, found.shapes.information, apart)
    assert (squared < 23.2).all()  # 99 % of a chi-squared of 10
    assert (
        np.linalg.eigvalsh(found.shapes.information) > 0.99
    ).all()  # never less than about anybody


def test_more_frames_in_the_same_time_tell_no_more_of_the_shape(fitter, truth):
    """Errors of targets last: thirty frames of one second are one look, not thirty."""
    rows = np.flatnonzero(GROUP == 9)
    information = np.broadcast_to(np.eye(3) / NOISE_M**2, (*truth.shape, 3))
    targets = JointTargets(truth, information)
    told = []
    for every in (1, 3):
        chosen = rows[::every]
        shapes = fitter.fit_sequence(some(targets, chosen), GROUP[chosen], TIME_S[chosen]).shapes
        told.append(np.linalg.eigvalsh(shapes.information[0] - np.eye(10)).max())
    assert told[0] == pytest.approx(told[1], rel=0.2)


def test_shapes_are_carried_on_and_count_once(fitter, targets):
    first, second = TIME_S < 1.0, TIME_S >= 1.0
    one = fitter.fit_sequence(some(targets, first), GROUP[first], TIME_S[first])
    two = fitter.fit_sequence(some(targets, second), GROUP[second], TIME_S[second], one.shapes)
    alone = fitter.fit_sequence(some(targets, second), GROUP[second], TIME_S[second])
    # What the second second tells is added to what the first told; about nobody in particular is in
    # it once.
    added = two.shapes.information - one.shapes.information
    told = alone.shapes.information - np.eye(10)
    np.testing.assert_allclose(
        np.trace(added, axis1=1, axis2=2), np.trace(told, axis1=1, axis2=2), rtol=0.1
    )
    # Somebody of whom everything is known stays as he is.
    sure = Shapes(one.shapes.mean, np.tile(1e8 * np.eye(10), (PEOPLE, 1, 1)))
    kept = fitter.fit_sequence(some(targets, second), GROUP[second], TIME_S[second], sure)
    np.testing.assert_allclose(kept.shapes.mean, one.shapes.mean, atol=1e-3)
    fixed = fitter.fit_sequence(
        some(targets, second), GROUP[second], TIME_S[second], one.shapes, fixed_shapes=True
    )
    assert fixed.shapes is one.shapes
    for place, number in enumerate(fixed.groups):
        rows = GROUP[second] == number
        np.testing.assert_allclose(
            fixed.fit.betas[rows], np.tile(one.shapes.mean[place], (rows.sum(), 1)), atol=1e-6
        )


def test_rows_that_no_view_saw_follow_those_around_them(fitter, targets, truth):
    information = targets.information.copy()
    gone = np.arange(40, 46)
    information[gone] = 0
    found = fitter.fit_sequence(JointTargets(targets.xyz, information), GROUP, TIME_S)
    assert found.fit.ok.all()
    # 0.2 s of somebody who moves by 0.6 m/s and turns: joints between those before and after.
    assert np.linalg.norm((found.fit.joints - truth)[gone], axis=-1).mean() < 0.08
    assert (
        np.isnan(found.fit.residual_m[gone]).all() and np.isfinite(found.fit.residual_m[:40]).all()
    )


def test_order_groups_and_other_people_do_not_matter(fitter, targets, found):
    order = np.random.default_rng(2).permutation(len(GROUP))
    shuffled = fitter.fit_sequence(some(targets, order), GROUP[order], TIME_S[order])
    # A chain is done within 0.05 of its energy a row; batches round differently.
    np.testing.assert_allclose(shuffled.fit.joints, found.fit.joints[order], atol=2e-3)
    rows = GROUP == 5
    alone = fitter.fit_sequence(some(targets, rows), GROUP[rows], TIME_S[rows] + 1e5)
    np.testing.assert_allclose(alone.fit.joints, found.fit.joints[rows], atol=2e-3)


@pytest.mark.slow
def test_where_long_chains_are_cut_is_not_seen(targets, found, monkeypatch):
    whole = SmplFitter().fit_sequence(targets, GROUP, TIME_S)
    monkeypatch.setattr(body_sequence, "SEGMENT_ROWS", 25)
    monkeypatch.setattr(body_sequence, "OVERLAP_ROWS", 12)
    cut = SmplFitter().fit_sequence(targets, GROUP, TIME_S)
    assert np.ptp(cut.fit.betas.reshape(PEOPLE, FRAMES, 10), axis=1).max() < 1e-5
    apart = np.linalg.norm(cut.fit.joints - whole.fit.joints, axis=-1)
    assert np.quantile(apart, 0.99) < 0.01 and np.median(apart) < 0.002
    np.testing.assert_allclose(stature_m(cut.shapes.mean), stature_m(whole.shapes.mean), atol=0.005)
    assert acceleration(cut.fit.joints).max() < 1.5 * acceleration(whole.fit.joints).max()


def test_what_cannot_be_fitted_has_a_status(fitter, targets):
    information = targets.information.copy()
    information[GROUP == 5] = 0
    information[7, 3] = np.nan
    found = fitter.fit_sequence(JointTargets(targets.xyz, information), GROUP, TIME_S)
    assert found.fit.status[7] == FitStatus.INVALID_TARGETS
    assert (found.fit.status[GROUP == 5] == FitStatus.TOO_FEW_JOINTS).all()
    assert found.fit.ok.sum() == 2 * FRAMES - 1
    assert np.isnan(found.fit.joints[GROUP == 5]).all() and not found.fit.betas[GROUP == 5].any()
    nobody = fitter.fit_sequence(some(targets, np.zeros(0, dtype=int)), GROUP[:0], TIME_S[:0])
    assert len(nobody.fit) == 0 and len(nobody.groups) == 0 and nobody.shapes.mean.shape == (0, 10)
    # One row is a sequence too, and one whose neighbours are an hour away.
    single = fitter.fit_sequence(
        some(targets, np.array([0, 1])), GROUP[:2], np.array([0.0, 3600.0])
    )
    assert single.fit.ok.all()


def test_rows_that_never_settle_have_no_body_and_say_so(targets, monkeypatch):
    """After one step from a cold start energy is still falling in most rows: they have nothing to
    start from.
    """
    monkeypatch.setattr(optimisers, "MAX_ITERATIONS", 1)
    found = SmplFitter().fit_sequence(targets, GROUP, TIME_S)
    lost = found.fit.status == FitStatus.NOT_CONVERGED
    assert lost.any() and np.isnan(found.fit.joints[lost]).all() and not found.fit.betas[lost].any()
    assert found.fit.ok[~lost].all() and np.isfinite(found.fit.joints[~lost]).all()


def test_misuse_is_told(fitter, targets):
    with pytest.raises(ValueError, match="time_s must be 180 finite numbers"):
        fitter.fit_sequence(targets, GROUP, TIME_S[:5])
    with pytest.raises(ValueError, match="groups must be 180 whole numbers"):
        fitter.fit_sequence(targets, GROUP[:5], TIME_S)
    with pytest.raises(ValueError, match="has two rows at"):
        fitter.fit_sequence(targets, GROUP, np.round(TIME_S, 1))
    with pytest.raises(ValueError, match="fixed_shapes needs shapes"):
        fitter.fit_sequence(targets, GROUP, TIME_S, fixed_shapes=True)
    shapes = Shapes(np.zeros((2, 10)), np.tile(np.eye(10), (2, 1, 1)))
    with pytest.raises(ValueError, match="one row for each of the 3 groups, got 2"):
        fitter.fit_sequence(targets, GROUP, TIME_S, shapes)
    with pytest.raises(ValueError, match=r"mean and information must be \(G, 10\)"):
        Shapes(np.zeros((2, 10)), np.eye(10))
    with pytest.raises(ValueError, match="gap_s must be positive"):
        BodyConfig(gap_s=0)


@pytest.mark.parametrize(
    "groups", [[0, 1], [[0], [1], [2]], [0.0, 1.0, 2.0], ["a", "b", "c"], [True] * 3]
)
def test_groups_that_are_not_one_number_a_row_are_refused(groups):
    with pytest.raises(ValueError, match="groups must be 3 whole numbers"):
        check_groups(np.array(groups), 3)
