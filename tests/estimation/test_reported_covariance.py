"""What is said of solved joints: how each is known, what its covariance leaves out, what went
wrong.
"""

from types import SimpleNamespace

import numpy as np

from shapepose_fg.body.fitting.fitter import BodyFit
from shapepose_fg.core.reconstruction import Known
from shapepose_fg.estimation.draft import drafted
from shapepose_fg.estimation.linearisation import ViewEvidence
from shapepose_fg.estimation.reported_covariance import how_known, problems

I3 = np.eye(3)


def message(sigma_m, known=None):
    """Information of joints (N, J) known alike in all directions, at the origin; sigma infinite:
    none.
    """
    sigma = np.asarray(sigma_m, dtype=float)
    information = np.where(np.isfinite(sigma), sigma, np.inf)[..., None, None] ** -2.0 * I3
    known = np.isfinite(sigma) if known is None else np.asarray(known)
    return SimpleNamespace(information=information, known=known, xyz=np.zeros((*sigma.shape, 3)))


def test_a_joint_is_seen_or_the_body_s_or_carried_by_motion():
    """Seen by one view of three; by none, with 70 % and 72 % of the body's sigma; without a body;
    not placed; by two views, of which one is weak, or as probably of somebody else, or neither.
    """
    sigma = np.array([[0.09, 0.07, 0.072, 0.07, 0.07, 0.02, 0.02, 0.02]])
    covariance = sigma[..., None, None] ** 2 * I3
    inlier = np.zeros((1, 8, 3), dtype=bool)
    inlier[0, 0, 1] = inlier[0, 4, :] = inlier[0, 5:, :2] = True
    joints = np.zeros((1, 8, 3))
    joints[0, 4, 2] = np.nan
    body = message(np.full((1, 8), 0.1), [[True, True, True, False, True, True, True, True]])
    confidence, probability = np.full((1, 8, 3), 0.8), np.ones((1, 8, 3))
    confidence[0, 5, 0], probability[0, 6, 0] = 0.2, 0.4
    observations = SimpleNamespace(confidence=confidence, probability=probability)
    state = SimpleNamespace(of_body=body, inlier=inlier, joints=joints, observations=observations)
    found = how_known(state, covariance)
    unseen = [Known.MOTION, Known.BODY, Known.MOTION, Known.UNKNOWN]
    assert found.tolist() == [[Known.WEAK, *unseen, Known.WEAK, Known.WEAK, Known.SEEN]]
    assert found.dtype == np.uint8


def window(joints):
    return SimpleNamespace(touched=np.zeros(joints, bool), rows=np.arange(1), failure="")


def solved(away_m, sigma_m=0.02, body_sigma_m=np.inf):
    """One frame: joints at the origin but for `away_m` (J,) along x, views and body at the
    origin.
    """
    away = np.asarray(away_m, dtype=float)
    joints = np.zeros((1, len(away), 3))
    joints[0, :, 0] = away
    shape = np.ones((1, len(away)))
    said = {"of_views": message(sigma_m * shape), "of_body": message(body_sigma_m * shape)}
    observations = SimpleNamespace(track=np.array([7]), frame=np.array([12]))
    return SimpleNamespace(joints=joints, observations=observations, **said)


def reasons(solution, here, covariance=None, first=None):
    count = solution.joints.shape[1]
    covariance = np.broadcast_to(I3, (1, count, 3, 3)) if covariance is None else covariance
    solution.first, solution.people = np.zeros((1, count, 3)) if first is None else first, [here]
    found = problems(solution, covariance)
    assert all((each.row, each.track, each.frame) == (0, 7, 12) for each in found)
    return {each.joint: each.reason for each in found}


def test_a_joint_far_from_all_that_is_said_of_it_ran_away():
    """Half a metre and 20 standard deviations, both: 0.49 m is 24 of 2 cm, 0.6 m only 15 of 4
    cm.
    """
    here = window(2)
    assert set(reasons(solved([0.51, 0.49]), here)) == {0}
    assert reasons(solved([0.6, 0.0], sigma_m=0.04), here) == {}
    assert set(reasons(solved([0.9, 0.0], sigma_m=0.04), here)) == {0}
    # With the body beside the views 4 cm is 2.8 cm: 0.6 m are 21 of them.
    both = reasons(solved([0.6, 0.0], sigma_m=0.04, body_sigma_m=0.04), here)
    assert both == {0: "diverged from its views and the body"}


def test_a_joint_with_a_factor_of_one_s_own_ran_away_after_a_metre():
    here = window(3)
    here.touched = np.array([True, True, False])
    first = np.array([[[1.01, 0, 0], [0.99, 0, 0], [5.0, 0, 0]]])
    assert reasons(solved([0.0, 0.0, 0.0]), here, first=first) == {0: "diverged from its views"}


def test_what_nothing_determines_and_what_the_solver_says():
    here = window(2)
    covariance = np.full((1, 2, 3, 3), np.nan)
    covariance[0, 1] = I3
    assert reasons(solved([0.0, 0.0]), here, covariance) == {
        0: "undetermined: its system is singular"
    }
    here.failure = "the solver diverged"
    solution = solved([0.0, np.nan])
    assert reasons(solution, here, covariance) == {0: here.failure}, (
        "who is not placed has no problem"
    )


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
    """A body 4 cm off, known to 3 cm and 2 for the model; views to 2 cm: 13 to 4. Views 20 cm off
    do not count.
    """
    views = np.array([[[0.04, 0, 0], [0.2, 0, 0], [0.04, 0, 0]]])
    sigma = np.array([[0.02, 0.02, np.inf]])
    at, covariance = drafted(
        evidence(views, sigma), body_at(np.zeros((1, 3, 3)), 0.03), disagreement=4.8
    )
    whole = 0.03**2 + 0.02**2
    share = whole / (whole + 0.02**2)
    np.testing.assert_allclose(at[0], [[share * 0.04, 0, 0], [0, 0, 0], [0, 0, 0]], atol=1e-12)
    np.testing.assert_allclose(covariance[0, 0], I3 * whole * 0.02**2 / (whole + 0.02**2))
    np.testing.assert_allclose(covariance[0, 1:], np.stack([whole * I3] * 2))
    # 20 cm are sqrt(17) x 1 cm, 4.85 times: with a little more patience the views count.
    np.testing.assert_allclose(np.hypot(np.sqrt(whole), 0.02), np.sqrt(17) / 100)
    patient, _ = drafted(
        evidence(views[:, 1:2], sigma[:, 1:2]), body_at(np.zeros((1, 1, 3)), 0.03), 4.9
    )
    np.testing.assert_allclose(patient[0, 0, 0], share * 0.2)


def test_a_draft_without_a_body_is_the_views_and_without_both_nothing():
    views = np.array([[[1.0, 2, 3], [4, 5, 6], [7, 8, 9]]])
    fit = body_at(np.full((1, 3, 3), np.nan), 0.03, ok=False)
    at, covariance = drafted(evidence(views, np.array([[0.02, 0.9, 1.1]])), fit, disagreement=6.0)
    np.testing.assert_allclose(at[0, :2], views[0, :2])
    np.testing.assert_allclose(covariance[0, :2], np.stack([0.02**2 * I3, 0.9**2 * I3]))
    assert np.isnan(at[0, 2]).all() and np.isnan(covariance[0, 2]).all(), (
        "determined to a metre, or not at all"
    )
