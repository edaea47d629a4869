"""Stage II with the body in the graph: from observations of a window to joints, covariances and
bodies.
"""

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from factors import CONSTANT_VELOCITY
from shapepose_fg.body.fitting.evidence import LEAST_JOINTS
from shapepose_fg.body.fitting.fitter import BodyFit, FitStatus
from shapepose_fg.body.model.body_model import BodyModel
from shapepose_fg.core.arrays import Array, Index, Mask
from shapepose_fg.core.camera import Views
from shapepose_fg.core.notes import Problem
from shapepose_fg.core.observations import Observations, window_rows
from shapepose_fg.estimation.body_frames import BodyFrames
from shapepose_fg.estimation.body_window import BodyWindow, Marginals
from shapepose_fg.estimation.condensed_graph import gtsam_step
from shapepose_fg.estimation.contact import feet_of
from shapepose_fg.estimation.draft import Draft
from shapepose_fg.estimation.estimator_config import EstimatorConfig
from shapepose_fg.estimation.factor_solution import solve_with_factors
from shapepose_fg.estimation.gated_views import (
    ObservationConfig,
    ViewEvidence,
    linearise,
    observation_sigmas,
)
from shapepose_fg.estimation.in_time import velocities, waited_s
from shapepose_fg.estimation.missed_detections import (
    elsewhere_variance,
    limbs_that_hide,
)
from shapepose_fg.estimation.motion_densities import MotionModel
from shapepose_fg.estimation.person_graph import BodyGraph
from shapepose_fg.estimation.reported_covariances import covariance_factors
from shapepose_fg.estimation.user_factors import FactorFunction, add_factors
from shapepose_fg.estimation.window_solution import (
    Estimates,
    WindowSolution,
    strong_detections,
)

GATE_M = 0.1
"""rho_2D of Eq. 2 in windows, as a length at the joint's depth, at the initial estimate and in
every round; more for detectors with larger errors."""


def solve_bodies(
    first: Draft,
    views: Views,
    model: BodyModel,
    config: EstimatorConfig,
    motion: MotionModel,
    functions: Sequence[FactorFunction] = (),
) -> WindowSolution:
    """Joints, covariances and bodies of N rows: each track over all its rows, or every row
    separately. The solver starts at the initial estimates `first`.

    A joint's covariance is, in this order: the one from its views, if its row has no body
    (`_of_views`); the marginal of its person's graph, with deviations wider for unseen joints
    (`BodyWindow.of_joints`, `widen_unseen`), times the person's factor (`covariance_factors`), or
    that of the graph with user factors (`solve_with_factors`); plus errors of moving cameras
    and exchanged sides (`Estimates.add_other_errors`).
    """
    observations = first.observations
    noisy = config.noise.typical(observations.confidence[observations.seen])
    rho_2d_m = noisy * min(GATE_M, config.observations.rho_2d_m)
    gates = replace(config.observations, rho_2d_m=rho_2d_m)
    evidence, sigmas = _at_start(first, views, config, gates)
    enough = (evidence.sigma_m <= config.refine.max_sigma_m).sum(axis=1) >= LEAST_JOINTS
    agreed = np.asarray(evidence.inlier.sum(axis=-1) >= 2)

    # Bodies and joints together. Rows without a body keep what their views determine.
    found = _of_views(evidence, config.refine.max_sigma_m, first.body.status)
    people, spread = list[BodyGraph](), list[Array]()
    for rows, solved in _solved(first, sigmas, views, model, config, gates, motion):
        widen = covariance_factors(solved, noisy)
        for (place, each), factor in zip(solved.window.split(solved), widen, strict=True):
            people.append(BodyGraph(each.window, each.state, float(factor), rows[place]))
            spread.append(each.of_bodies)
            _put(found, people[-1], each)
        del solved, each  # memory that the next person needs

    _widen_unseen(found, people, spread, observations, views, config)
    if len(functions) > 0:  # people who have some are solved once more
        add_factors(people, functions)
        for each in solve_with_factors(people, config.graph):
            _put(found, each.person, each.marginals)
            found.covariance[each.person.rows] = each.covariance
    found.add_other_errors(observations, sigmas, views, config, held=True)

    # Views that agreed on a joint, of which none is used: they contradict the body.
    against = agreed & ~found.evidence.inlier.any(axis=-1)
    failed = tuple(
        Problem(int(row), each.track, int(observations.frame[row]), joint, each.failure)
        for each in people
        for row in (each.rows if each.failure else ())
        for joint in np.flatnonzero(each.touched).tolist()
    )
    return found.solution(observations, people, failed, enough, against)


def _at_start(
    first: Draft, views: Views, config: EstimatorConfig, gates: ObservationConfig
) -> tuple[ViewEvidence, Array]:
    """Detections gated at the start, and their standard deviations (N, J, V), pixels.

    What the gate rejects stays out (0), since bodies can be drawn to the other leg's detections.
    Where it rejects some detections of a joint, the others are less certain, too.
    """
    rows, X = first.observations, first.start
    sigmas = observation_sigmas(rows, X, views, config.observations, config.joints)
    sigmas = sigmas * np.sqrt(config.noise.ratios(rows.confidence))
    evidence = linearise(rows, sigmas, X, views, gates)
    kept = evidence.inlier.sum(axis=-1) / np.maximum(rows.seen.sum(axis=-1), 1)
    less = sigmas / np.maximum(kept, 1e-9)[..., None]
    return evidence, np.where(evidence.inlier, less, 0.0)


def _solved(
    first: Draft,
    sigmas: Array,
    views: Views,
    model: BodyModel,
    config: EstimatorConfig,
    gates: ObservationConfig,
    motion: MotionModel,
) -> Iterator[tuple[Index, Marginals]]:
    """The rows of each window that can be solved: a person's, or all people of single frames; and
    its marginals.
    """
    observations, start = first.observations, first.body
    feet = feet_of(config.joints if config.motion.contact else ())
    over_time = len(np.unique(observations.track)) < len(observations)
    Model = BodyWindow if over_time else BodyFrames
    parts = deque(window_rows(observations) if over_time else [np.flatnonzero(start.ok)])
    while parts:
        rows = parts.popleft()
        if not start.ok[rows].any():
            continue
        given = observations.rows(rows), sigmas[rows], views.rows(rows)
        window = Model(*given, model, gates, motion, config.law)
        window.variance /= config.graph.weight_shape
        free = window.energy.parameters(start.rows(rows), np.zeros((len(rows), 3)))
        free = _filled(free, start.ok[rows], window.times_s) if over_time else free
        try:
            state = window.solve(free)
            if over_time and len(rows) > 2 and len(feet) > 0:
                window.hold(state, feet)
            state = window.take(state, *gtsam_step(window, state))
            yield rows, window.covariances(state)
        except np.linalg.LinAlgError:
            if not over_time and len(rows) > 1:  # one of them
                parts.extend(rows[:, None])


def _widen_unseen(
    found: Estimates,
    people: Sequence[BodyGraph],
    spread: Sequence[Array],
    observations: Observations,
    views: Views,
    config: EstimatorConfig,
) -> None:
    """Widen the deviations of unseen joints from their bodies, above all of those that cameras
    should see. `spread` has each person's covariances of the bodies' joints.
    """
    strong = strong_detections(observations, found.evidence.inlier)
    limbs = limbs_that_hide(config.joints)
    elsewhere = elsewhere_variance(found.joints, observations.frame, strong, views, limbs)
    for person, of_bodies in zip(people, spread, strict=True):
        seen = np.asarray(strong[person.rows].any(axis=-1))
        moved = np.square(CONSTANT_VELOCITY.start[0] * waited_s(seen, person.times_s))
        moved = np.minimum(elsewhere[person.rows], moved)
        person.window.widen_unseen(of_bodies, moved / person.widen)  # a length, whatever the graph
        found.covariance[person.rows] = person.widen * person.window.of_joints(of_bodies)


def _of_views(evidence: ViewEvidence, most_m: float, status: NDArray[np.str_]) -> Estimates:
    """Joints and covariances from the views only, where they determine them; no bodies, with
    the `status` (N,) of their fits.
    """
    placed = np.asarray(evidence.sigma_m <= most_m)
    covariance = np.full((*placed.shape, 3, 3), np.nan)
    covariance[placed] = np.linalg.inv(evidence.information[placed])
    joints = np.where(placed[..., None], evidence.target, np.nan)
    fit = BodyFit.failed(status, placed.shape[1])
    return Estimates.of(joints, covariance, evidence, fit)


def _put(found: Estimates, person: BodyGraph, marginals: Marginals) -> None:
    """Store a person's solution."""
    rows, window, state, fit = person.rows, person.window, person.state, found.fit
    found.joints[rows] = joints = window.joints(state)
    found.velocity[rows] = velocities(joints, window.times_s)
    if window.over_time:
        found.velocity_covariance[rows] = marginals.velocities()
    found.evidence.put(rows, window.last.evidence)
    fit.put_bodies(rows, window.parameters(state), np.zeros((len(rows), 3)))
    fit.joints[rows] = joints - state.deviation
    fit.covariance[rows] = person.widen * marginals.of_bodies
    fit.residual_m[rows] = np.sqrt(np.square(state.deviation).sum(axis=-1).mean(axis=-1))
    fit.status[rows] = FitStatus.OK


def _filled(free: Array, ok: Mask, times_s: Array) -> Array:
    """Bodies (T, P), where those that are not `ok` (T,) are replaced by the nearest in time that
    are.
    """
    known = np.flatnonzero(ok)
    return free[known[np.abs(times_s[:, None] - times_s[known]).argmin(axis=1)]]
