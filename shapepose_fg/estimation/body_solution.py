"""Stage II with the body in the graph: from observations of a window to joints, covariances and
bodies.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from shapepose_fg.body.fitting.evidence import LEAST_JOINTS
from shapepose_fg.body.fitting.fitter import BodyFit, BodyFitter, FitStatus
from shapepose_fg.core.arrays import Array, Index, Mask
from shapepose_fg.core.camera import Views
from shapepose_fg.core.notes import Problem
from shapepose_fg.core.observations import Observations
from shapepose_fg.core.reconstruction import Known, Status
from shapepose_fg.estimation.association_uncertainty import DOUBTED, mirrored_spread
from shapepose_fg.estimation.body_step import joint_targets
from shapepose_fg.estimation.body_window import BodyFrames, BodyState, BodyWindow
from shapepose_fg.estimation.body_window_graph import BodyGraph
from shapepose_fg.estimation.draft import first_places
from shapepose_fg.estimation.estimator_config import EstimatorConfig
from shapepose_fg.estimation.factor_solution import solve_with_factors
from shapepose_fg.estimation.in_time import near_in_time, velocities
from shapepose_fg.estimation.linearisation import (
    ViewEvidence,
    linearise,
    mean_confidence,
    observation_sigmas,
)
from shapepose_fg.estimation.motion_model import MotionModel
from shapepose_fg.estimation.reported_covariance import WEAK_PROBABILITY, WEAK_SCORE
from shapepose_fg.estimation.state import window_rows
from shapepose_fg.estimation.user_factors import FactorFunction, add_factors, factors_of
from shapepose_fg.estimation.window_solution import PersonGraph, WindowSolution, tied

LASTS = 2.0
"""Covariances over time are this many times those of errors that are new in every frame: detectors'
errors last.

Solution and gates do not change: detections, bodies, motion and priors all are that much less
certain."""
GATE_M = 0.1
"""rho_2D of Eq. 2 in windows, as a length at the joint's depth, at the initial estimate and in
every round."""
RECENT_S = 0.25
"""Time since a view last detected a joint, s, within which its motion determines it."""


def solve_bodies(
    observations: Observations,
    views: Views,
    fitter: BodyFitter,
    config: EstimatorConfig,
    motion: MotionModel,
    functions: Sequence[FactorFunction] = (),
) -> WindowSolution:
    """Joints, covariances and bodies of N rows: each track over its rows, or a row by itself.

    `functions` make user factors; people with some are solved once more, by GTSAM.
    """
    assert fitter.model is not None
    # Gating of the initial estimate; what it rejects stays out, since bodies can be drawn to the
    # other leg's detections.
    gates = replace(config.observations, rho_2d_m=min(GATE_M, config.observations.rho_2d_m))
    X = first_places(observations, views, fitter, config)
    sigmas = observation_sigmas(observations, X, views, config.observations, config.joints)
    sigmas = sigmas * np.sqrt(config.noise.variances(observations.confidence)[0])
    evidence = linearise(observations, sigmas, X, views, gates)
    enough = (evidence.sigma_m <= config.refine.max_sigma_m).sum(axis=1) >= LEAST_JOINTS
    start = fitter.fit_whole(joint_targets(evidence, enough))
    sigmas = np.where(evidence.inlier, sigmas, 0.0)

    # Bodies and joints together. Rows without a body keep what their views determine.
    found = _Found.of_views(evidence, config.refine.max_sigma_m, start.status)
    people = list[BodyGraph]()
    tracks = [rows for rows in window_rows(observations) if start.ok[rows].any()]
    alone = [rows for rows in tracks if len(rows) == 1]
    over_time = [rows for rows in tracks if len(rows) > 1]
    for rows in [*over_time, np.concatenate(alone)] if alone else over_time:
        given = observations.rows(rows), sigmas[rows], views.rows(rows)
        kind = BodyWindow if len(np.unique(observations.track[rows])) < len(rows) else BodyFrames
        window = kind(*given, fitter.model, gates, motion, config.law)
        free = window.energy.parameters(start.rows(rows), np.zeros((len(rows), 3)))
        try:
            state = window.solve(_filled(free, start.ok[rows], window.times_s))
            found.put(rows, window, state)
        except np.linalg.LinAlgError:
            continue
        people += _people(window, state, rows)

    # User factors.
    if len(functions) > 0:
        add_factors(people, functions)
        for each in solve_with_factors(people, config.graph):
            person, covariances = each.person, (each.covariance, each.velocity_covariance)
            found.put(person.rows, person.window, person.state, covariances)
    return found.solution(observations, views, config, enough, people)


def _people(window: BodyWindow, state: BodyState, rows: Index) -> list[BodyGraph]:
    """The graphs of a solved window: one person's, or that of each single frame."""
    tracks, frames = window.observations.track, window.observations.frame.astype(np.int64)
    if not isinstance(window, BodyFrames):
        return [BodyGraph(window, state, int(tracks[0]), frames, LASTS, rows)]
    found = list[BodyGraph]()
    for n in np.arange(len(rows))[:, None]:
        part = window.rows(n)
        part.last = window.last.rows(n)
        found.append(BodyGraph(part, state.rows(n), int(tracks[n[0]]), frames[n], 1.0, rows[n]))
    return found


@dataclass(frozen=True)
class _Found:
    """Results of N rows while they are solved."""

    joints: Array
    covariance: Array
    velocity: Array
    velocity_covariance: Array
    evidence: ViewEvidence
    fit: BodyFit

    @classmethod
    def of_views(cls, evidence: ViewEvidence, most_m: float, status: Array) -> "_Found":
        """What the views alone say of joints, where they determine them; NaN elsewhere."""
        placed = evidence.sigma_m <= most_m
        (N, J), nowhere = placed.shape, np.full((*placed.shape, 3), np.nan)
        covariance = np.full((N, J, 3, 3), np.nan)
        covariance[placed] = np.linalg.inv(evidence.information[placed])
        joints = np.where(placed[..., None], evidence.target, np.nan)
        fit = BodyFit.failed(status, J)
        return cls(joints, covariance, nowhere, np.full_like(covariance, np.nan), evidence, fit)

    def put(
        self,
        rows: Index,
        window: BodyWindow,
        state: BodyState,
        covariances: tuple[Array, Array] | None = None,
    ) -> None:
        """Store the solution of some `rows`; LinAlgError if its system is singular. `covariances`
        of positions and velocities, where they are not those of the window alone.
        """
        joints = window.joints(state)
        covariance, of_velocity = covariances or _covariances(window, state)
        if not window.alone:
            self.velocity[rows] = velocities(joints, window.times_s)
            self.velocity_covariance[rows] = of_velocity
        self.joints[rows], self.covariance[rows] = joints, covariance
        self.evidence.put(rows, window.last.evidence)
        fit, off = self.fit, np.square(state.deviation).sum(axis=-1)
        fit.put_bodies(rows, window.parameters(state), np.zeros((len(rows), 3)))
        fit.joints[rows], fit.covariance[rows] = joints - state.deviation, covariance
        fit.residual_m[rows] = np.sqrt(off.mean(axis=-1))
        fit.status[rows] = FitStatus.OK

    def solution(
        self,
        rows: Observations,
        views: Views,
        config: EstimatorConfig,
        enough: Mask,
        people: Sequence[BodyGraph],
    ) -> WindowSolution:
        """The solution with all uncertainty, codes and statuses."""
        evidence, inlier = self.evidence, self.evidence.inlier
        sure = (rows.confidence >= WEAK_SCORE) & (rows.probability > WEAK_PROBABILITY)
        strong = inlier & sure
        covariance = self.covariance + mirrored_spread(self.joints, rows.mirrored, config.joints)
        recent = inlier.any(axis=-1)
        for person in people:
            mine, times_s = person.rows, person.times_s
            recent[mine] = near_in_time(recent[mine], times_s, RECENT_S)
        known = np.where(recent, Known.MOTION, Known.BODY)
        known = np.where(inlier.any(axis=-1), Known.WEAK, known)
        known = np.where(strong.sum(axis=-1) >= 2, Known.SEEN, known)
        known = np.where(np.isfinite(self.joints).all(axis=-1), known, Known.UNKNOWN)
        doubted = np.median(rows.mirrored.max(axis=2, initial=0.0), axis=1) > DOUBTED
        status = np.where(doubted, Status.CONTRADICTED, Status.OK)
        failed = np.where(enough, Status.BODY_UNDETERMINED, Status.TOO_FEW_VIEWS)
        wrong = tuple(
            Problem(int(row), each.track, int(rows.frame[row]), joint, each.failure)
            for each in people
            for row in (each.rows if each.failure else ())
            for joint in np.flatnonzero(each.touched).tolist()
        )
        status = np.where(self.fit.ok, status, failed)
        status[[problem.row for problem in wrong]] = Status.NOT_SOLVED
        return WindowSolution(
            observations=rows,
            joints=self.joints,
            covariance=covariance,
            velocity=self.velocity,
            velocity_covariance=self.velocity_covariance,
            confidence=mean_confidence(rows, inlier),
            inlier=inlier,
            contradicts=np.zeros(known.shape, dtype=bool),
            residual_px=evidence.residual_px,
            known=known.astype(np.uint8),
            fit=self.fit,
            status=status,
            problems=wrong,
            people=tied(
                [
                    PersonGraph(
                        window=each,
                        joints=self.joints[each.rows],
                        covariance=covariance[each.rows],
                        bodies=self.fit.rows(each.rows),
                    )
                    for each in people
                ]
            ),
            factors=factors_of(people),
        )


def _covariances(window: BodyWindow, state: BodyState) -> tuple[Array, Array]:
    """Covariances of a window's positions, m², and velocities, m²/s², (T, J, 3, 3)."""
    if isinstance(window, BodyFrames):
        of_bodies = window.body_covariances(state)
        window.widen_unseen(of_bodies)
        return window.of_joints(of_bodies), np.empty(0)
    marginals = window.covariances(state)
    window.widen_unseen(LASTS * marginals.of_bodies)
    return LASTS * marginals.joints(), LASTS * marginals.velocities()


def _filled(free: Array, ok: Mask, times_s: Array) -> Array:
    """Bodies (T, P), those that are not `ok` (T,) as the nearest in time that are."""
    there = np.flatnonzero(ok)
    return free[there[np.abs(times_s[:, None] - times_s[there]).argmin(axis=1)]]
