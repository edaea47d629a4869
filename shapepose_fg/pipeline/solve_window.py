"""Stage II on one page: joints, bodies and graphs from a window of frames with assigned
detections.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from shapepose_fg.body.fitting.evidence import LEAST_JOINTS
from shapepose_fg.body.fitting.fitter import BodyFitter
from shapepose_fg.core.arrays import Array
from shapepose_fg.core.camera import Views
from shapepose_fg.core.detections import Input
from shapepose_fg.core.observations import Observations, rows_in
from shapepose_fg.core.skeleton import Skeleton
from shapepose_fg.estimation.asynchronous_views import carried_to_frames, velocities_of, widened
from shapepose_fg.estimation.body_solution import solve_bodies
from shapepose_fg.estimation.body_step import BodyStep, disagreement
from shapepose_fg.estimation.draft import Draft, draft
from shapepose_fg.estimation.estimator_config import EstimatorConfig
from shapepose_fg.estimation.joint_step import solve_between, solve_joints
from shapepose_fg.estimation.linearisation import linearise, mean_confidence
from shapepose_fg.estimation.motion_model import MotionModel
from shapepose_fg.estimation.reported_covariance import outcome
from shapepose_fg.estimation.smoothing import smoothed
from shapepose_fg.estimation.state import State
from shapepose_fg.estimation.user_factors import ExtraFactors, functions_of
from shapepose_fg.estimation.window_graph import WindowGraph
from shapepose_fg.estimation.window_solution import WindowSolution
from shapepose_fg.tracking.reassociation import LEAST_PROBABILITY, changed, reassociate

_SETTLED = 0.002
"""Share of changed detections below which reassociation ends: in crowds after three or four rounds
with six cameras, after eight or more with three."""


@dataclass(frozen=True)
class Assigning:
    """Data for reassociation around initial estimates."""

    frames: Sequence[Input]
    """All detections of the window's frames."""
    skeleton: Skeleton
    """The detector's joints."""
    rounds: int
    """Maximum number of rounds."""
    over_time: bool
    """Whether people are the same from frame to frame. If not, each round demands a higher
    probability of people (`LEAST_PROBABILITY`)."""


def solve_window(
    observations: Observations,
    views: Views,
    fitter: BodyFitter,
    config: EstimatorConfig,
    *,
    assigning: Assigning | None = None,
    extra_factors: ExtraFactors | None = None,
) -> WindowSolution:
    """Joints, covariances, bodies and graphs of N rows in any order; (track, frame) must be unique.

    Rows of one track at several frames are a window, one factor graph with a body in every frame.
    If no track has several rows, or the fitter no body model, rows are solved by the frame-by-frame
    method, which with the paper's `EstimatorConfig` is its Algorithm 1.
    `views` are the cameras, by row if they move. `extra_factors`, one function or several, add
    factors of your own to every window. Without `assigning` detections keep their people.

    Frame by frame, in each round the body is fitted to estimates of all joints from the views only,
    and then constrains the joints. Its constraint on a joint excludes that joint's own views
    (`BodyFit.prior_xyz`), so that no measurement counts twice.
    """
    if len(views) != observations.confidence.shape[2] or views.rows_known not in (
        None,
        len(observations),
    ):
        raise ValueError(
            f"views must be of the {len(observations)} rows' {observations.confidence.shape[2]} "
            "views"
        )
    began = time.perf_counter()
    motion = MotionModel.load(config.joints, config.motion, config.law)

    # Assignment: detections near people's initial joints and bodies, iterated.
    drafted: Draft | None = None
    for n in range(assigning.rounds if assigning is not None and len(observations) > 0 else 0):
        assert assigning is not None
        drafted = draft(observations, views, fitter, config, drafted)
        places, covariance = drafted.places, drafted.covariance
        if assigning.over_time:
            times_s = observations.time_s.mean(axis=1)
            places, covariance = smoothed(places, covariance, observations.track, times_s, motion)
            covariance = widened(covariance, observations, places, views)
        least = (
            None if assigning.over_time else n / max(assigning.rounds - 1, 1) * LEAST_PROBABILITY
        )
        before = observations
        observations = reassociate(
            assigning.frames, before, places, covariance, assigning.skeleton, least
        )
        views = views if views.rows_known is None else views.rows(rows_in(before, observations))
        if assigning.over_time and changed(before, observations) < _SETTLED:
            break
    assigned = time.perf_counter()

    over_time = len(np.unique(observations.track)) < len(observations)
    functions = functions_of(extra_factors)
    if config.refine.with_body and over_time and fitter.model is not None:
        solution = solve_bodies(observations, views, fitter, config, motion, functions)
        solution.seconds.update(
            {"associate again": assigned - began, "solve": time.perf_counter() - assigned}
        )
        return solution

    # Initial estimate: X_0, standard deviations of the observations there, and all graphs.
    state = State.start(observations, views, fitter, config, functions)
    moving, velocity = state.people, velocities_of(observations, state.joints)
    for n in range(config.refine.alternations if len(moving) > 0 else 0):  # Algorithm 1
        rows = np.concatenate([person.rows for person in moving])
        cameras, sigma, X = views.rows(rows), state.sigmas[rows], state.joints[rows]
        observed = carried_to_frames(observations.rows(rows), X, velocity[rows], cameras)

        # Gating: measurements of the views around X, delta of Eq. 2.
        evidence = linearise(observed, sigma, X, cameras, config.observations)
        if n == 0:
            placed = evidence.sigma_m <= config.refine.max_sigma_m
            state.enough[rows] = placed.sum(axis=1) >= LEAST_JOINTS

        # Bodies: the Theta step.
        step = BodyStep(fitter, moving, config)
        targets = step.targets(evidence, state.enough[rows])
        body, anew = step.fit_changed(targets, state.fit.rows(rows), state.targets.rows(rows))
        fitted = evidence.target
        wrong = disagreement(evidence, body) > config.refine.contradiction
        if wrong.any():
            # Gate again around the body's joints, and fit the body again without rejected
            # detections.
            there = np.where(wrong[..., None], body.prior_xyz, X)
            evidence = linearise(observed, sigma, there, cameras, config.observations)
            again = np.flatnonzero(wrong.any(axis=-1))
            targets = step.targets(evidence, state.enough[rows])
            body, anew = (
                body.with_rows(again, step.fit(targets, body, again)),
                np.union1d(anew, again),
            )
        state.targets.put(rows[anew], targets.rows(anew))
        # delta of Eq. 4; joints that their views do not determine need the body despite a confident
        # single view.
        pulled = mean_confidence(observed, evidence.inlier) <= config.graph.rho_3d
        pulled |= evidence.sigma_m > config.refine.max_sigma_m
        of_body = step.message(body, targets, pulled)

        # Joints: the X step. Graphs are solved by GTSAM only after convergence, but for those with
        # user factors.
        parts = [(person, slice(k, k + 1)) for k, person in enumerate(moving)]
        near = solve_between(observed, sigma, cameras, evidence, of_body, config)
        now = [(person, part) for person, part in parts if len(person.ties.factors) > 0]
        solve_joints(now, evidence, of_body, config)
        X_new = _solved(near, now)

        # Convergence: the body was fitted to the current joints, and joints constrained by it did
        # not move.
        before = np.where((of_body.known | wrong)[..., None], X, fitted)
        still = np.linalg.norm(X_new - before, axis=-1) < config.refine.settled_m
        settled = (still | np.isnan(X_new).any(axis=-1)).all(axis=1)
        last = n + 1 == config.refine.alternations
        unsettled = {id(person.ties) for person, part in parts if not settled[part].all()}
        done = [each for each in parts if last or id(each[0].ties) not in unsettled]
        moving = [] if last else [person for person, _ in parts if id(person.ties) in unsettled]
        done = [each for each in done if len(each[0].ties.factors) == 0]
        solve_joints(done, evidence, of_body, config, near)
        state.put(rows, _solved(X_new, done), evidence, wrong, of_body, body)
        if len(moving) == 0:
            break
    solution = outcome(state, fitter)
    solution.seconds.update(
        {"associate again": assigned - began, "solve": time.perf_counter() - assigned}
    )
    return solution


def _solved(joints: Array, parts: Sequence[tuple[WindowGraph, slice]]) -> Array:
    """Joints (R, J, 3), with those of some people as their graphs have them."""
    found = joints.copy()
    for person, part in parts:
        found[part] = person.positions
    return found
