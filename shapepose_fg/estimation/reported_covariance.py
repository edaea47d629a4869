"""Results of a solved window: correlated errors, further uncertainty, how joints are known, and
problems.
"""

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.body.fitting.fitter import BodyFit, BodyFitter, JointTargets
from shapepose_fg.core.arrays import Array, Mask
from shapepose_fg.core.decompositions import raise_eigenvalues
from shapepose_fg.core.notes import Problem
from shapepose_fg.core.reconstruction import Known, Status
from shapepose_fg.estimation.association_uncertainty import (
    DOUBTED,
    association_spread,
    exchange_spread,
    limbs_to_exchange,
    mirrored_spread,
)
from shapepose_fg.estimation.asynchronous_views import carried_to_frames
from shapepose_fg.estimation.camera_pose_uncertainty import carried_covariance
from shapepose_fg.estimation.covariance_calibration import LASTS_S, Calibration, CovarianceFeatures
from shapepose_fg.estimation.in_time import carried, smoothed_in_time, waited_s
from shapepose_fg.estimation.limbs import limbs_kept
from shapepose_fg.estimation.linearisation import (
    ViewEvidence,
    information_by_view,
    inverses,
    linearise,
    mean_confidence,
    squared_distance,
    weakest_sigma,
)
from shapepose_fg.estimation.missed_detections import SPEED_M_S, elsewhere_variance, limbs_that_hide
from shapepose_fg.estimation.motion_model import LOST_M
from shapepose_fg.estimation.noise_law import core_sigma_m, variance_ratio
from shapepose_fg.estimation.state import State
from shapepose_fg.estimation.state_covariances import state_covariances
from shapepose_fg.estimation.user_factors import factors_of
from shapepose_fg.estimation.window_graph import WindowGraph
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
    rows, people, shape = state.observations, state.people, state.joints.shape
    solved, covariance, velocity_covariance = (np.full((*shape, 3), np.nan) for _ in range(3))
    velocity = np.full(shape, np.nan)
    for person, (of_positions, of_velocities) in zip(
        people, state_covariances(people), strict=True
    ):
        solved[person.rows] = covariance[person.rows] = of_positions
        if person.temporal:
            velocity[person.rows] = person.velocity
            velocity_covariance[person.rows] = of_velocities
            covariance[person.rows] = with_lasting(state, person, of_positions)
    X = limbs_kept(state, covariance, fitter) if state.config.motion.keep_limbs else state.joints
    fit = final_bodies(state, covariance, fitter)
    carried = carried_to_frames(rows, X, np.nan_to_num(velocity), state.views)
    final = linearise(carried, state.sigmas, X, state.views, state.config.observations)
    covariance = _calibrated(state, X, covariance, final)
    if state.views.carried is not None:
        covariance += carried_covariance(
            final, state.of_body, state.sigmas, state.views, state.config.observations
        )
    reported = strong(state)
    hiding = limbs_that_hide(state.config.joints)
    elsewhere = elsewhere_variance(X, rows.frame, reported, state.views, hiding)
    for person in people:
        waited = waited_s(np.asarray(reported[person.rows].any(axis=-1)), person.times_s)
        moved = np.minimum(elsewhere[person.rows], (SPEED_M_S * waited) ** 2)
        covariance[person.rows] += moved[..., None, None] * np.eye(3)
    covariance += mirrored_spread(X, rows.mirrored, state.config.joints)
    wrong = problems(state, covariance)
    doubted = np.median(rows.mirrored.max(axis=2, initial=0.0), axis=1) > DOUBTED
    sided = np.where(doubted, Status.CONTRADICTED, Status.OK)
    status = np.where(
        fit.ok, sided, np.where(state.enough, Status.BODY_UNDETERMINED, Status.TOO_FEW_VIEWS)
    )
    status[[problem.row for problem in wrong]] = Status.NOT_SOLVED
    return WindowSolution(
        observations=rows,
        joints=X,
        covariance=covariance,
        velocity=velocity,
        velocity_covariance=velocity_covariance,
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
                solved_covariance=solved[person.rows], lasting=state.motion.views,
                body=state.of_body.rows(person.rows),
            )
            for person in people
        ]),
        factors=factors_of(people),
    )  # fmt: skip


def final_bodies(state: State, covariance: Array, fitter: BodyFitter) -> BodyFit:
    """The bodies to return. For people with user factors, they are fitted to the solved joints.

    In this way, the bodies follow these factors. Joints and covariances are final and not affected.
    """
    fit = state.fit
    chosen = [
        person.rows for person in state.people
        if person.touched.any() and (person.temporal or fit.ok[person.rows].all())
    ]  # fmt: skip
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
    law.

    `covariance` is that of the graph, with correlated errors, and `final` the linearised
    observations at `X`. In rows without temporal factors, the result is not smaller than
    `covariance`.
    """
    rows, body, count, joints = (
        state.observations,
        state.of_body,
        state.inlier.sum(axis=-1),
        state.config.joints,
    )
    config, alone = state.config.observations, np.ones(len(X), dtype=bool)
    for person in state.people:
        alone[person.rows] = not person.temporal
    sigma_m = core_sigma_m(rows.confidence, config) * config.scatter(joints)[:, None]
    by_view = information_by_view(final, state.sigmas, state.views, config)
    ratio = variance_ratio(
        state.config.noise, alone, rows.confidence, sigma_m, by_view, body.information
    )
    widened = ratio[..., None, None] * covariance
    of_body = np.nan_to_num(squared_distance(body, state.joints, widened))
    association = association_spread(rows, state.sigmas, final, body, state.views, config)
    moved = np.nan_to_num(state.joints - rows.initial)
    draft = moved[..., None] * moved[..., None, :]
    exchange = exchange_spread(
        state.joints, state.fit.joints, rows.frame, limbs_to_exchange(joints)
    )
    for person in state.people:
        mine, times_s = person.rows, person.times_s
        association[mine] = smoothed_in_time(association[mine], times_s, LASTS_S, count[mine] > 0)
        for clue in (of_body, draft, exchange):
            clue[mine] = smoothed_in_time(clue[mine], times_s, LASTS_S)
    clues = CovarianceFeatures(rows.frame, X, count, widened, of_body, association, draft, exchange)
    found = Calibration.load(joints).covariance(clues)
    single = alone[:, None] & np.isfinite(found).all(axis=(-2, -1))
    found[single] = covariance[single] + raise_eigenvalues(found[single] - covariance[single], 0.0)
    return found


def with_lasting(state: State, person: WindowGraph, marginal: Array) -> Array:
    """(T, J, 3, 3) covariance of joints, m²: `marginal` of the person's graph, plus the errors it
    omits.

    Added are the correlated share of the single-frame covariance by views and body; and of the
    white share, the part that smoothing does not really remove, because errors are correlated over
    a few frames (`CorrelatedError.kept`). For unseen joints this is taken from the nearest frame in
    which they are seen. For joints solved with offsets, `marginal` already includes the correlated
    error.
    """
    said = state.of_views.information[person.rows]
    information = said + state.of_body.information[person.rows]
    simple = np.broadcast_to(~person.with_offsets, said.shape[:2])
    seen = (weakest_sigma(said) <= LOST_M) & simple
    f, kept = state.motion.views.white_share, state.motion.views.kept
    left = np.zeros(information.shape)
    left[seen] = inverses(information[seen])
    left = carried(left, seen, person.times_s)
    total = np.where(seen, 1 - kept, 1.0)[..., None, None] * marginal + (1 - f + kept * f) * left
    return np.where(simple[..., None, None], total, marginal)


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
