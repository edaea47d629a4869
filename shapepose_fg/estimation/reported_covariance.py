"""Results of people solved frame by frame: uncertainty, how joints are known, and problems."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.body.fitting.fitter import BodyFit, BodyFitter, JointTargets
from shapepose_fg.core.arrays import Array, Mask
from shapepose_fg.core.decompositions import raise_eigenvalues
from shapepose_fg.core.notes import Problem
from shapepose_fg.core.observations import Observations
from shapepose_fg.core.reconstruction import Known, Status
from shapepose_fg.estimation.association_uncertainty import (
    DOUBTED,
    association_spread,
    exchange_spread,
    limbs_to_exchange,
    mirrored_spread,
)
from shapepose_fg.estimation.camera_pose_uncertainty import carried_covariance
from shapepose_fg.estimation.covariance_calibration import Calibration, CovarianceFeatures
from shapepose_fg.estimation.linearisation import (
    ViewEvidence,
    information_by_view,
    inverses,
    linearise,
    mean_confidence,
    squared_distance,
    weakest_sigma,
)
from shapepose_fg.estimation.missed_detections import elsewhere_variance, limbs_that_hide
from shapepose_fg.estimation.noise_law import core_sigma_m, variance_ratio
from shapepose_fg.estimation.state import State
from shapepose_fg.estimation.state_covariances import state_covariances
from shapepose_fg.estimation.user_factors import factors_of
from shapepose_fg.estimation.window_solution import CorrectedGraph, WindowSolution, tied

RUNAWAY_M = 1.0
"""Distance of a joint with a user factor from its initial position at which it has diverged, m."""
RUNAWAY_SIGMA = 20.0
"""Distance of a joint from its views and body, standard deviations, at which it has diverged, if
also over 0.5 m."""
_HALF_M = 0.5
WEAK_SCORE = 0.3
"""Score below which a detection is weak: in simulated crowds one in 18 is not the person's, of
others one in 60."""
WEAK_PROBABILITY = 0.5
"""Probability below which a detection is weak."""


def outcome(state: State, fitter: BodyFitter) -> WindowSolution:
    """Results of a window with solved joints: covariances with all uncertainty, codes, statuses."""
    rows, people, X = state.observations, state.people, state.joints
    solved, nowhere = np.full((*X.shape, 3), np.nan), np.full(X.shape, np.nan)
    for person, of_positions in zip(people, state_covariances(people), strict=True):
        solved[person.rows] = of_positions
    fit = final_bodies(state, solved, fitter)
    final = linearise(rows, state.sigmas, X, state.views, state.config.observations)
    covariance = _calibrated(state, X, solved, final)
    if state.views.carried is not None:
        covariance += carried_covariance(
            final, state.of_body, state.sigmas, state.views, state.config.observations
        )
    reported = strong(state)
    hiding = limbs_that_hide(state.config.joints)
    elsewhere = elsewhere_variance(X, rows.frame, reported, state.views, hiding)
    hidden = np.where(reported.any(axis=-1), 0.0, elsewhere)
    covariance += hidden[..., None, None] * np.eye(3)
    covariance += mirrored_spread(X, rows.mirrored, state.config.joints)
    wrong = problems(state, covariance)
    status = statuses(rows, fit.ok, state.enough, wrong)
    return WindowSolution(
        observations=rows,
        joints=X,
        covariance=covariance,
        velocity=nowhere,
        velocity_covariance=np.full_like(covariance, np.nan),
        confidence=mean_confidence(rows, state.inlier),
        inlier=state.inlier,
        contradicts=state.contradicts,
        residual_px=final.residual_px,
        known=how_known(state, covariance),
        fit=fit,
        status=status,
        problems=wrong,
        people=tied([
            CorrectedGraph(
                window=person, joints=X[person.rows], covariance=covariance[person.rows],
                bodies=fit.rows(person.rows), solved=state.joints[person.rows],
                solved_covariance=solved[person.rows],
                body=state.of_body.rows(person.rows),
            )
            for person in people
        ]),
        factors=factors_of(people),
    )  # fmt: skip


def statuses(
    rows: Observations, ok: Mask, enough: Mask, problems: Sequence[Problem]
) -> NDArray[np.str_]:
    """(N,) status of each row: whether it has a body, `ok` (N,), whether its views determine one,
    `enough` (N,), whether sides may be exchanged, and whether it could not be solved.
    """
    doubted = np.median(rows.mirrored.max(axis=2, initial=0.0), axis=1) > DOUBTED
    sided = np.where(doubted, Status.CONTRADICTED, Status.OK)
    failed = np.where(enough, Status.BODY_UNDETERMINED, Status.TOO_FEW_VIEWS)
    status = np.where(ok, sided, failed)
    status[[problem.row for problem in problems]] = Status.NOT_SOLVED
    return status


def final_bodies(state: State, covariance: Array, fitter: BodyFitter) -> BodyFit:
    """The bodies to return. For people with user factors, they are fitted to the solved joints.

    In this way, the bodies follow these factors. Joints and covariances are final and not affected.
    """
    fit = state.fit
    chosen = [person.rows for person in state.people if person.touched.any()]
    if len(chosen) == 0:
        return fit
    rows = np.concatenate(chosen)
    rows = rows[fit.ok[rows]]
    again = fitter.fit_whole(
        JointTargets.solved(state.joints[rows], covariance[rows]), fit.rows(rows)
    )
    return fit.with_rows(rows[again.ok], again.rows(np.flatnonzero(again.ok)))


def _calibrated(state: State, X: Array, covariance: Array, final: ViewEvidence) -> Array:
    """Covariances (N, J, 3, 3) of the joints `X` with all uncertainty, for the detector's noise
    law; not smaller than `covariance`, that of the graph. `final` are the linearised observations
    at `X`.
    """
    rows, body, joints = state.observations, state.of_body, state.config.joints
    config, count = state.config.observations, state.inlier.sum(axis=-1)
    sigma_m = core_sigma_m(rows.confidence, config) * config.scatter(joints)[:, None]
    by_view = information_by_view(final, state.sigmas, state.views, config)
    ratio = variance_ratio(state.config.noise, rows.confidence, sigma_m, by_view, body.information)
    widened = ratio[..., None, None] * covariance
    of_body = np.nan_to_num(squared_distance(body, X, widened))
    association = association_spread(rows, state.sigmas, final, body, state.views, config)
    association = np.where((count > 0)[..., None, None], association, 0.0)
    moved = np.nan_to_num(X - rows.initial)
    draft = moved[..., None] * moved[..., None, :]
    exchange = exchange_spread(X, state.fit.joints, rows.frame, limbs_to_exchange(joints))
    clues = CovarianceFeatures(rows.frame, X, count, widened, of_body, association, draft, exchange)
    found = Calibration.load(joints).covariance(clues)
    known = np.isfinite(found).all(axis=(-2, -1))
    found[known] = covariance[known] + raise_eigenvalues(found[known] - covariance[known], 0.0)
    return found


def strong(state: State) -> Mask:
    """(N, J, V) mask of used observations that are not weak."""
    observations = state.observations
    sure = (observations.confidence >= WEAK_SCORE) & (observations.probability > WEAK_PROBABILITY)
    return state.inlier & sure


def how_known(state: State, covariance: Array) -> NDArray[np.uint8]:
    """(N, J) code of `Known` for each joint, with `covariance` (N, J, 3, 3).

    It is SEEN if two views have used detections that are not weak. An unseen joint is MOTION if its
    variance is less than half that of the body's constraint.
    """
    pulled = state.of_body.known
    information = np.where(pulled[..., None, None], state.of_body.information, np.eye(3))
    said = np.trace(inverses(information), axis1=2, axis2=3)
    moved = ~pulled | (np.trace(covariance, axis1=2, axis2=3) < 0.5 * said)
    code = np.where(moved, Known.MOTION, Known.BODY)
    code = np.where(state.inlier.any(axis=-1), Known.WEAK, code)
    code = np.where(strong(state).sum(axis=-1) >= 2, Known.SEEN, code)
    return np.where(np.isfinite(state.joints).all(axis=-1), code, Known.UNKNOWN).astype(np.uint8)


def problems(state: State, covariance: Array) -> tuple[Problem, ...]:
    """Joints that could not be solved, by person, frame and joint."""
    X, first, observations = state.joints, state.first, state.observations
    finite = np.asarray(np.isfinite(X).all(axis=2))
    reasons = np.full(finite.shape, "", dtype=object)
    information = state.of_views.information + state.of_body.information
    pulls = _pull(state.of_views, X) + _pull(state.of_body, X)
    known = finite & (weakest_sigma(information) < np.inf)
    away = np.zeros(X.shape)
    away[known] = np.linalg.solve(information[known], pulls[known][..., None])[..., 0]
    sigmas = np.sqrt(np.maximum(np.einsum("...i,...i->...", away, pulls), 0.0))
    far = np.linalg.norm(away, axis=2)
    reasons[known & (far > _HALF_M) & (sigmas > RUNAWAY_SIGMA)] = (
        "diverged from its views and the body"
    )
    for person in state.people:
        rows = person.rows
        touched = np.ix_(rows, np.flatnonzero(person.touched))
        with np.errstate(invalid="ignore"):
            ran = np.linalg.norm(X[touched] - first[touched], axis=2) > RUNAWAY_M
        reasons[touched] = np.where(ran, "diverged from its views", reasons[touched])
        if person.failure:
            reasons[rows] = np.where(finite[rows], person.failure, reasons[rows])
    lost = finite & ~np.isfinite(covariance).all(axis=(2, 3)) & (reasons == "")
    reasons[lost] = "undetermined: its system is singular"
    return tuple(
        Problem(
            int(n),
            int(observations.track[n]),
            int(observations.frame[n]),
            int(j),
            str(reasons[n, j]),
        )
        for n, j in np.argwhere(reasons != "")
    )


def _pull(message: JointTargets, X: Array) -> Array:
    """(N, J, 3) information times displacement from `X` to the estimate, 1/m."""
    return np.einsum(
        "...ij,...j->...i", message.information, np.nan_to_num(message.xyz) - np.nan_to_num(X)
    )
