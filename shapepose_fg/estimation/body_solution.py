"""Stage II with the body in the graph: from observations of a window to joints, covariances and
bodies.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from factors import CONSTANT_VELOCITY
from shapepose_fg.body.fitting.evidence import LEAST_JOINTS
from shapepose_fg.body.fitting.fitter import BodyFit, BodyFitter, FitStatus, JointTargets
from shapepose_fg.core.arrays import Array, Mask
from shapepose_fg.core.camera import Views
from shapepose_fg.core.notes import Problem
from shapepose_fg.core.observations import Observations, window_rows
from shapepose_fg.core.reconstruction import Known
from shapepose_fg.estimation.body_frames import BodyFrames
from shapepose_fg.estimation.body_window import BodyWindow, Marginals
from shapepose_fg.estimation.camera_pose_uncertainty import carried_covariance
from shapepose_fg.estimation.condensed_graph import gtsam_step
from shapepose_fg.estimation.contact import feet_of
from shapepose_fg.estimation.draft import Draft, first_bodies, first_places, joint_targets
from shapepose_fg.estimation.estimator_config import EstimatorConfig
from shapepose_fg.estimation.factor_solution import solve_with_factors
from shapepose_fg.estimation.gated_views import (
    ViewEvidence,
    inverses,
    linearise,
    mean_confidence,
    observation_sigmas,
)
from shapepose_fg.estimation.in_time import near_in_time, velocities, waited_s
from shapepose_fg.estimation.mirrored_sides import mirrored_spread
from shapepose_fg.estimation.missed_detections import (
    elsewhere_variance,
    limbs_that_hide,
)
from shapepose_fg.estimation.motion_densities import MotionModel
from shapepose_fg.estimation.person_graph import BodyGraph
from shapepose_fg.estimation.reported_covariances import covariance_factors
from shapepose_fg.estimation.user_factors import FactorFunction, add_factors, factors_of
from shapepose_fg.estimation.window_solution import (
    PersonGraph,
    WindowSolution,
    statuses,
    strong_detections,
    tied,
)

GATE_M = 0.1
"""rho_2D of Eq. 2 in windows, as a length at the joint's depth, at the initial estimate and in
every round; more for detectors with larger errors."""
RECENT_S = 0.25
"""Time since a view last detected a joint, s, within which its motion determines it."""


def solve_bodies(
    observations: Observations,
    views: Views,
    fitter: BodyFitter,
    config: EstimatorConfig,
    motion: MotionModel,
    functions: Sequence[FactorFunction] = (),
    drafted: Draft | None = None,
) -> WindowSolution:
    """Joints, covariances and bodies of N rows: each track over its rows, or a row by itself;
    bodies begin at those `drafted`.

    A joint's covariance is, in this order: the one from its views, if its row has no body
    (`_Found.of_views`); the marginal of its person's graph, with deviations wider for unseen joints
    (`BodyWindow.of_joints`, `widen_unseen`), times the person's factor (`covariance_factors`), or
    that of the graph with user factors (`solve_with_factors`); plus errors of moving cameras
    (`carried_covariance`), and exchanged sides (`mirrored_spread`).
    """
    assert fitter.model is not None
    # Gating of the initial estimate; what it rejects stays out, since bodies can be drawn to the
    # other leg's detections.
    seen, ratio = observations.seen, config.noise.ratios(observations.confidence)
    noisy = max(1.0, float(np.sqrt(ratio[seen].mean()))) if seen.any() else 1.0
    rho_2d_m = noisy * min(GATE_M, config.observations.rho_2d_m)
    gates = replace(config.observations, rho_2d_m=rho_2d_m)
    X = first_places(observations, views, fitter, config)
    sigmas = observation_sigmas(observations, X, views, config.observations, config.joints)
    sigmas = sigmas * np.sqrt(ratio)
    evidence = linearise(observations, sigmas, X, views, gates)
    enough = (evidence.sigma_m <= config.refine.max_sigma_m).sum(axis=1) >= LEAST_JOINTS
    start = first_bodies(observations, joint_targets(evidence, enough), fitter, drafted)
    # Where it rejects some detections of a joint, the others are less certain, too.
    kept = evidence.inlier.sum(axis=-1) / np.maximum(observations.seen.sum(axis=-1), 1)
    sigmas = np.where(evidence.inlier, sigmas / np.maximum(kept, 1e-9)[..., None], 0.0)

    # Bodies and joints together. Rows without a body keep what their views determine.
    agreed = np.asarray(evidence.inlier.sum(axis=-1) >= 2)
    found = _Found.of_views(evidence, config.refine.max_sigma_m, start.status)
    people, spread = list[BodyGraph](), list[Array]()
    feet = feet_of(config.joints if config.motion.contact else ())
    over_time = len(np.unique(observations.track)) < len(observations)
    Model = BodyWindow if over_time else BodyFrames
    parts = deque(window_rows(observations) if over_time else [np.flatnonzero(start.ok)])
    while parts:
        rows = parts.popleft()
        if not start.ok[rows].any():
            continue
        given = observations.rows(rows), sigmas[rows], views.rows(rows)
        window = Model(*given, fitter.model, gates, motion, config.law)
        window.variance /= config.graph.weight_shape
        free = window.energy.parameters(start.rows(rows), np.zeros((len(rows), 3)))
        free = _filled(free, start.ok[rows], window.times_s) if over_time else free
        try:
            state = window.solve(free)
            if over_time and len(rows) > 2 and len(feet) > 0:
                window.hold(state, feet)
            state = window.take(state, *gtsam_step(window, state))
            marginals = window.covariances(state)
        except np.linalg.LinAlgError:
            if not over_time and len(rows) > 1:  # one of them
                parts.extend(rows[:, None])
            continue
        widen = covariance_factors(marginals, noisy)
        for (place, each), factor in zip(window.apart(marginals), widen, strict=True):
            own = rows[place]
            frames = observations.frame[own].astype(np.int64)
            track = int(observations.track[own[0]])
            people.append(BodyGraph(each.window, each.state, track, frames, float(factor), own))
            spread.append(each.of_bodies)
            found.put(people[-1], each)
        del marginals, each  # memory that the next person needs

    # Uncertainty: unseen joints deviate from their bodies by more, above all those that cameras
    # should see; cameras' poses and sides may be wrong.
    strong = strong_detections(observations, found.evidence.inlier)
    limbs = limbs_that_hide(config.joints)
    elsewhere = elsewhere_variance(found.joints, observations.frame, strong, views, limbs)
    for person, of_bodies in zip(people, spread, strict=True):
        seen = np.asarray(strong[person.rows].any(axis=-1))
        moved = np.square(CONSTANT_VELOCITY.start[0] * waited_s(seen, person.times_s))
        moved = np.minimum(elsewhere[person.rows], moved)
        person.window.widen_unseen(of_bodies, moved / person.widen)  # a length, whatever the graph
        found.covariance[person.rows] = person.widen * person.window.of_joints(of_bodies)

    # User factors: people who have some are solved once more.
    if len(functions) > 0:
        add_factors(people, functions)
        for each in solve_with_factors(people, config.graph):
            found.put(each.person, each.marginals)
            found.covariance[each.person.rows] = each.covariance
    if views.carried is not None:
        bodies = JointTargets(found.joints, inverses(found.fit.covariance + np.eye(3) * 1e-6))
        found.covariance[:] += carried_covariance(found.evidence, bodies, sigmas, views, gates)
    found.covariance[:] += mirrored_spread(found.joints, observations.mirrored, config.joints)
    # Views that agreed on a joint, of which none is used: they contradict the body.
    against = agreed & ~found.evidence.inlier.any(axis=-1)
    return found.solution(observations, enough, strong, against, people)


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
    def of_views(cls, evidence: ViewEvidence, most_m: float, status: NDArray[np.str_]) -> "_Found":
        """Joints and covariances from the views only, where they determine them; NaN elsewhere."""
        placed = np.asarray(evidence.sigma_m <= most_m)
        (N, J), nowhere = placed.shape, np.full((*placed.shape, 3), np.nan)
        covariance = np.full((N, J, 3, 3), np.nan)
        covariance[placed] = np.linalg.inv(evidence.information[placed])
        joints = np.where(placed[..., None], evidence.target, np.nan)
        fit = BodyFit.failed(status, J)
        return cls(joints, covariance, nowhere, np.full_like(covariance, np.nan), evidence, fit)

    def put(self, person: BodyGraph, marginals: Marginals) -> None:
        """Store a person's solution."""
        rows, window, state, fit = person.rows, person.window, person.state, self.fit
        self.joints[rows] = joints = window.joints(state)
        self.velocity[rows] = velocities(joints, window.times_s)
        if window.over_time:
            self.velocity_covariance[rows] = marginals.velocities()
        self.evidence.put(rows, window.last.evidence)
        fit.put_bodies(rows, window.parameters(state), np.zeros((len(rows), 3)))
        fit.joints[rows] = joints - state.deviation
        fit.covariance[rows] = person.widen * marginals.of_bodies
        fit.residual_m[rows] = np.sqrt(np.square(state.deviation).sum(axis=-1).mean(axis=-1))
        fit.status[rows] = FitStatus.OK

    def solution(
        self,
        rows: Observations,
        enough: Mask,
        strong: Mask,
        against: Mask,
        people: Sequence[BodyGraph],
    ) -> WindowSolution:
        """The solution, with codes and statuses."""
        inlier = self.evidence.inlier
        recent = np.asarray(inlier.any(axis=-1))
        for person in people:
            mine = person.rows
            recent[mine] = near_in_time(recent[mine], person.times_s, RECENT_S)
        known = np.where(recent, Known.MOTION, Known.BODY)
        known = np.where(inlier.any(axis=-1), Known.WEAK, known)
        known = np.where(strong.sum(axis=-1) >= 2, Known.SEEN, known)
        known = np.where(np.isfinite(self.joints).all(axis=-1), known, Known.UNKNOWN)
        wrong = tuple(
            Problem(int(row), each.track, int(rows.frame[row]), joint, each.failure)
            for each in people
            for row in (each.rows if each.failure else ())
            for joint in np.flatnonzero(each.touched).tolist()
        )
        return WindowSolution(
            observations=rows,
            joints=self.joints,
            covariance=self.covariance,
            velocity=self.velocity,
            velocity_covariance=self.velocity_covariance,
            confidence=mean_confidence(rows, inlier),
            inlier=inlier,
            contradicts=against,
            residual_px=self.evidence.residual_px,
            known=known.astype(np.uint8),
            fit=self.fit,
            status=statuses(rows, self.fit.ok, enough, wrong),
            problems=wrong,
            people=tied(
                [
                    PersonGraph(
                        window=each,
                        joints=self.joints[each.rows],
                        covariance=self.covariance[each.rows],
                        bodies=self.fit.rows(each.rows),
                    )
                    for each in people
                ]
            ),
            factors=factors_of(people),
        )


def _filled(free: Array, ok: Mask, times_s: Array) -> Array:
    """Bodies (T, P), those that are not `ok` (T,) as the nearest in time that are."""
    there = np.flatnonzero(ok)
    return free[there[np.abs(times_s[:, None] - times_s[there]).argmin(axis=1)]]
