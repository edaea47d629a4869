"""Drafts: where a body has the joints when some views' detections are another person's."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from shapepose_fg.body.fitting.fitter import BodyFit, BodyFitter
from shapepose_fg.body.fitting.fitters import BodyConfig, make_fitter
from shapepose_fg.core.camera import Views
from shapepose_fg.core.observations import Observations
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.estimation import draft
from shapepose_fg.estimation.draft import drafted
from shapepose_fg.estimation.estimator_config import EstimatorConfig
from shapepose_fg.estimation.gated_views import ViewEvidence
from shapepose_fg.simulation import Scene, built_in_scene

LEG = [BODY_25.joints.index(name) for name in ("RKnee", "RAnkle", "RHeel", "RBigToe", "RSmallToe")]
FRAMES = range(0, 40, 4)
SCENE = built_in_scene(3, people=2, frames=40, cameras=6)


@pytest.fixture(scope="module")
def fitter():
    return make_fitter(BodyConfig())


def with_a_neighbour_s_leg(alone: bool, scene: Scene = SCENE) -> tuple[Observations, np.ndarray]:
    """A person in ten frames, 5 mm of noise, and where the joints are, (N, J, 3).

    Of six views three see the leg below the right hip where it is half a metre aside.
    """
    truth = scene.keypoints[list(FRAMES), 0]
    noisy = truth + np.random.default_rng(0).normal(0, 5e-3, truth.shape)
    aside = noisy.copy()
    aside[:, LEG] += [0.5, 0.0, 0.0]
    xy, wrong = (np.moveaxis(scene.rig.project(joints)[0], 0, 2) for joints in (noisy, aside))
    xy[:, LEG, 3:] = wrong[:, LEG, 3:]
    N = len(truth)
    rows = Observations(
        xy, np.full(xy.shape[:3], 0.8), np.full(truth.shape, np.nan), frame=np.array(FRAMES)
    )
    rows = replace(rows, track=np.arange(N) if alone else np.zeros(N, dtype=int))
    return replace(
        rows, time_s=np.broadcast_to(np.array(FRAMES)[:, None] / scene.fps, rows.time_s.shape)
    ), truth


def ankle_errors(fitter, alone: bool) -> np.ndarray:
    """Distance (N,) of the right ankle's draft from the truth, metres."""
    rows, truth = with_a_neighbour_s_leg(alone)
    found = draft.draft(rows, Views.of(SCENE.rig), fitter, EstimatorConfig())
    joints, covariance = found.places, found.covariance
    assert np.isfinite(joints).all() and (np.linalg.eigvalsh(covariance) > 0).all()
    return np.linalg.norm(joints - truth, axis=-1)[:, LEG[1]]


def test_a_neighbour_s_leg_loses_its_hold_on_the_body(fitter, monkeypatch):
    """Half of the views say it is half a metre aside, and nothing but the rest of the body can
    tell.

    Over five scenes 275 mm without, 170 with, between 8 and 317: on the way from between the two
    legs to his own.
    """
    for alone in (True, False):
        after = ankle_errors(fitter, alone)
        with monkeypatch.context() as once:
            once.setattr(draft, "NARROWING_M", (1.0,))
            before = ankle_errors(fitter, alone)
        assert before.min() > 0.2 and after.mean() < before.mean() - 0.005


class Counting(BodyFitter):
    """A fitter that counts the rows that it is given."""

    def __init__(self, fitter) -> None:
        self.fitter, self.rows = fitter, []

    def fit(self, targets, initial=None):
        self.rows.append(len(targets))
        return self.fitter.fit(targets, initial)


def test_bodies_are_fitted_again_only_where_their_targets_have_changed(fitter, monkeypatch):
    """Of three scenes twenty rows, half of them with the neighbour's leg in three views: about as
    when all are fitted every time.
    """
    count, apart_m, usual = len(FRAMES), [], draft.changed_targets
    for scene in (
        SCENE,
        *(built_in_scene(seed, people=2, frames=40, cameras=6) for seed in (4, 5)),
    ):
        disturbed, truth = with_a_neighbour_s_leg(True, scene)
        noisy = truth + np.random.default_rng(1).normal(0, 5e-3, truth.shape)
        clean = np.moveaxis(scene.rig.project(noisy)[0], 0, 2)
        rows = Observations.concatenate(
            [disturbed, replace(disturbed, xy=clean, track=disturbed.track + count)]
        )
        drafts, fitted = [], []
        for chosen in (usual, lambda before, now, *_: np.arange(len(now.xyz))):
            monkeypatch.setattr(draft, "changed_targets", chosen)
            counting = Counting(fitter)
            found = draft.draft(rows, Views.of(scene.rig), counting, EstimatorConfig())
            drafts.append(found.places)
            fitted.append(counting.rows)
        assert fitted[1] == [2 * count] * (1 + len(draft.NARROWING_M))
        # At first every disturbed row, a clean one hardly ever; later those that have not settled.
        assert (
            fitted[0][0] == 2 * count
            and count / 2 < fitted[0][1]
            and max(fitted[0][1:]) < 2 * count
        )
        apart_m.append(np.linalg.norm(drafts[0] - drafts[1], axis=-1).max(axis=1))
        assert apart_m[-1][count:].max() < 1e-3
    # A detection near its gate may fall on either side of it. With targets that count as unmoved:
    # 2.8 to 24 mm.
    assert np.mean(apart_m) < draft.MODEL_SIGMA_M / 8


def test_only_rows_whose_detections_change_are_fitted_again(fitter):
    """Of ten rows three get a neighbour's leg; the others keep their bodies, in any order."""
    rows, truth = with_a_neighbour_s_leg(True)
    xy = np.moveaxis(SCENE.rig.project(truth)[0], 0, 2)
    clean, views, others = replace(rows, xy=xy), Views.of(SCENE.rig), [2, 5, 8]
    before = draft.draft(clean, views, fitter, EstimatorConfig())
    xy = xy.copy()
    xy[others] = rows.xy[others]
    now, counting = replace(clean, xy=xy), Counting(fitter)
    after = draft.draft(now, views, counting, EstimatorConfig(), before)
    assert max(counting.rows) <= len(others)
    kept = np.setdiff1d(np.arange(len(truth)), others)
    np.testing.assert_allclose(after.places[kept], before.places[kept], atol=2e-3)
    assert (np.linalg.norm(after.places - before.places, axis=-1)[others].max(axis=1) > 1e-3).all()
    # In another order, as rows are after others have gone, they are found again.
    counting = Counting(fitter)
    turned = draft.draft(now.rows(kept[::-1]), views, counting, EstimatorConfig(), after)
    np.testing.assert_allclose(turned.places, after.places[kept[::-1]], atol=2e-3)
    assert counting.rows == []


def test_a_draft_of_some_frames_takes_the_place_of_what_they_had(fitter):
    """Of ten rows three get a neighbour's leg and a draft of their own: the others are not fitted
    again, and every row is there once.
    """
    rows, truth = with_a_neighbour_s_leg(True)
    clean = replace(rows, xy=np.moveaxis(SCENE.rig.project(truth)[0], 0, 2))
    views, others = Views.of(SCENE.rig), [2, 5, 8]
    before = draft.draft(clean, views, fitter, EstimatorConfig())
    xy = clean.xy.copy()
    xy[others] = rows.xy[others]
    now, counting = replace(clean, xy=xy), Counting(fitter)
    last = before.updated(draft.draft(now.rows(others), views, fitter, EstimatorConfig()))
    assert sorted(last.observations.frame) == sorted(FRAMES)
    found = draft.draft(now, views, counting, EstimatorConfig(), last)
    assert max(counting.rows, default=0) <= len(others)
    kept, order = np.setdiff1d(np.arange(len(truth)), others), np.argsort(last.observations.frame)
    np.testing.assert_allclose(found.places[kept], last.places[order][kept], atol=2e-3)


def test_a_start_is_complete_and_keeps_what_stage_one_placed(fitter):
    """A joint that one view sees is where the draft has it, one of stage I stays."""
    rows, truth = with_a_neighbour_s_leg(False)
    rows = replace(rows, initial=rows.initial.copy())
    rows.initial[:, 0] = truth[:, 0] + 0.01
    rows.initial[:, LEG[0]] = np.nan
    rows.confidence[:, LEG[0], 1:] = 0
    first = draft.draft(rows, Views.of(SCENE.rig), fitter, EstimatorConfig())
    np.testing.assert_array_equal(first.start[:, 0], rows.initial[:, 0])
    assert np.isnan(first.triangulated[:, LEG[0]]).all()
    assert np.linalg.norm(first.start - truth, axis=-1)[:, LEG[0]].mean() < 0.2


def test_a_detection_that_is_improbable_loses_its_hold_on_the_draft(fitter):
    """The neighbour's leg, once it is known to be the neighbour's."""
    rows, truth = with_a_neighbour_s_leg(True)
    views, wrong = Views.of(SCENE.rig), np.moveaxis(SCENE.rig.project(truth)[0], 0, 2)
    before = draft.draft(rows, views, fitter, EstimatorConfig())
    apart = np.linalg.norm(rows.xy - wrong, axis=-1) > 20
    now = replace(rows, probability=np.where(apart, 1e-3, rows.probability))
    after = draft.draft(now, views, fitter, EstimatorConfig(), before)
    off = [np.linalg.norm(each.places - truth, axis=-1)[:, LEG[1]] for each in (before, after)]
    assert off[1].mean() < off[0].mean() / 2


I3 = np.eye(3)


def message(sigma_m, known=None):
    """Information of joints (N, J) known alike in all directions, at the origin; sigma infinite:
    none.
    """
    sigma = np.asarray(sigma_m, dtype=float)
    information = np.where(np.isfinite(sigma), sigma, np.inf)[..., None, None] ** -2.0 * I3
    known = np.isfinite(sigma) if known is None else np.asarray(known)
    return SimpleNamespace(information=information, known=known, xyz=np.zeros((*sigma.shape, 3)))


def evidence(points, sigma_m) -> ViewEvidence:
    """Views that put joints exactly at `points` (N, J, 3), known to `sigma_m` (N, J); infinite: not
    at all.
    """
    information = message(sigma_m).information
    none = np.zeros((*np.shape(sigma_m), 1))
    return ViewEvidence(points, none > 0, none, information, np.zeros_like(points))


def body_at(joints, sigma_m, ok=True) -> BodyFit:
    covariance = np.broadcast_to(sigma_m**2 * I3, (*joints.shape, 3))
    return SimpleNamespace(joints=joints, covariance=covariance, ok=np.full(len(joints), ok))  # type: ignore[return-value]


def test_a_draft_is_between_views_and_body_by_what_each_knows():
    """A body 4 cm off, known to 3 cm and 2 for the model; views to 2 cm: 13 to 4. Views 30 cm off
    do not count.
    """
    views = np.array([[[0.04, 0, 0], [0.3, 0, 0], [0.04, 0, 0]]])
    sigma = np.array([[0.02, 0.02, np.inf]])
    at, covariance = drafted(evidence(views, sigma), body_at(np.zeros((1, 3, 3)), 0.03))
    whole = 0.03**2 + 0.02**2
    share = whole / (whole + 0.02**2)
    np.testing.assert_allclose(at[0], [[share * 0.04, 0, 0], [0, 0, 0], [0, 0, 0]], atol=1e-12)
    np.testing.assert_allclose(covariance[0, 0], I3 * whole * 0.02**2 / (whole + 0.02**2))
    np.testing.assert_allclose(covariance[0, 1:], np.stack([whole * I3] * 2))


def test_a_draft_without_a_body_is_the_views_and_without_both_nothing():
    views = np.array([[[1.0, 2, 3], [4, 5, 6], [7, 8, 9]]])
    fit = body_at(np.full((1, 3, 3), np.nan), 0.03, ok=False)
    at, covariance = drafted(evidence(views, np.array([[0.02, 0.9, 1.1]])), fit)
    np.testing.assert_allclose(at[0, :2], views[0, :2])
    np.testing.assert_allclose(covariance[0, :2], np.stack([0.02**2 * I3, 0.9**2 * I3]))
    assert np.isnan(at[0, 2]).all() and np.isnan(covariance[0, 2]).all(), (
        "determined to a metre, or not at all"
    )
