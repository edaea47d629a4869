"""Algorithm 1 of the paper, frame by frame: body fits (Theta step) and joints (X step) in turn.

It is used by the paper's preset and by fitters without a body model; otherwise joints and bodies
are one problem (`body_solution.py`).
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from shapepose_fg.body.fitting.evidence import LEAST_JOINTS
from shapepose_fg.body.fitting.fitter import BodyFit, BodyFitter, FitStatus, JointTargets
from shapepose_fg.core.arrays import Array, Mask
from shapepose_fg.core.camera import Views
from shapepose_fg.core.notes import Problem
from shapepose_fg.core.observations import Observations, window_rows
from shapepose_fg.estimation.draft import MODEL_SIGMA_M
from shapepose_fg.estimation.estimator_config import EstimatorConfig
from shapepose_fg.estimation.frame_graph import FrameGraph, state_covariances
from shapepose_fg.estimation.gated_views import (
    ViewEvidence,
    linearise,
    mean_confidence,
    observation_sigmas,
)
from shapepose_fg.estimation.user_factors import FactorFunction, add_factors
from shapepose_fg.estimation.window_solution import RUNAWAY_M, Estimates, WindowSolution

JOINT_SIGMA_M = 0.03
"""Standard deviation of all joints to which a body is fitted, metres."""


def alternate(
    observations: Observations,
    first: Array,
    views: Views,
    fitter: BodyFitter,
    config: EstimatorConfig,
    functions: Sequence[FactorFunction] = (),
) -> WindowSolution:
    """Joints, covariances and bodies of N rows by Algorithm 1, each row by itself, from X_0:
    `first` (N, J, 3), metres.

    Each round fits bodies to X_n, gates the detections there (Eq. 2), and solves each person's
    graph by GTSAM: Eq. 1 for what gates leave, Eq. 3 for joints with a mean confidence of at most
    rho_3D (Eq. 4), and the factors of `functions`. Covariances are the marginals of the last graph.
    """
    X = first
    sigmas = observation_sigmas(observations, X, views, config.observations, config.joints)
    people = list[FrameGraph]()
    for row in np.concatenate([np.empty(0, np.intp), *window_rows(observations)])[:, None]:
        given = observations.rows(row), sigmas[row], views.rows(row)
        people.append(FrameGraph(*given, config, row, first[row]))
    if len(functions) > 0:
        add_factors(people, functions)
    evidence = linearise(observations, sigmas, X, views, config.observations)
    placed = np.asarray(evidence.sigma_m <= config.refine.max_sigma_m)
    enough = placed.sum(axis=1) >= LEAST_JOINTS
    fit = BodyFit.failed(np.full(len(X), FitStatus.TOO_FEW_JOINTS), X.shape[1])
    for _ in range(config.refine.alternations if len(people) > 0 else 0):
        fit = fitter.fit(_targets(X, enough), fit)  # the Theta step
        evidence = linearise(observations, sigmas, X, views, config.observations)
        pulled = mean_confidence(observations, evidence.inlier) <= config.graph.rho_3d
        pulled |= evidence.sigma_m > config.refine.max_sigma_m
        of_body = body_constraints(fit, pulled, config.graph.shape_sigma_m)
        before, X = X, _solved(people, evidence, of_body, config)  # the X step
        moved = np.linalg.norm(X - before, axis=-1)
        if (np.isnan(X).any(axis=-1) | (moved < config.refine.settled_m)).all():
            break
    covariance = np.full((*X.shape, 3), np.nan)
    for person, of_positions in zip(people, state_covariances(people), strict=True):
        covariance[person.rows] = of_positions
    failed = _problems(observations, X, covariance, people)
    final = linearise(observations, sigmas, X, views, config.observations)
    found = Estimates.of(X, covariance, replace(final, inlier=evidence.inlier), fit)
    found.add_other_errors(observations, sigmas, views, config, held=False)
    nothing = np.zeros(X.shape[:2], dtype=bool)
    return found.solution(observations, people, failed, enough, nothing)


def _targets(X: Array, enough: Mask) -> JointTargets:
    """Targets of the bodies at X (N, J, 3), for rows with `enough` (N,) joints."""
    known = np.isfinite(X).all(axis=-1) & enough[:, None]
    return JointTargets(np.nan_to_num(X), known[..., None, None] * np.eye(3) / JOINT_SIGMA_M**2)


def body_constraints(fit: BodyFit, pulled: Mask, sigma_m: float) -> JointTargets:
    """E_shape of Eq. 3 for the joints `pulled` (N, J): all with the standard deviation `sigma_m`,
    metres; 0: with the body's own covariance and that of a detector's joint from the body's.
    """
    pulled = pulled & fit.ok[:, None]
    information = np.zeros_like(fit.covariance)
    own = fit.covariance[pulled] + MODEL_SIGMA_M**2 * np.eye(3)
    information[pulled] = np.eye(3) / sigma_m**2 if sigma_m > 0 else np.linalg.inv(own)
    return JointTargets(np.where(pulled[..., None], fit.joints, np.nan), information)


def _solved(
    people: Sequence[FrameGraph],
    evidence: ViewEvidence,
    of_body: JointTargets,
    config: EstimatorConfig,
) -> Array:
    """Joints (N, J, 3) of the solved graphs; NaN where neither views nor body place a joint."""
    placed = (evidence.sigma_m <= config.refine.max_sigma_m)[..., None]
    of_body_xyz = np.where(of_body.known[..., None], of_body.xyz, np.nan)
    initial = np.where(placed, evidence.points, of_body_xyz)
    for each in people:
        used = evidence.inlier[each.rows] & np.isfinite(initial[each.rows][..., :1])
        each.prepare(used, of_body.rows(each.rows), initial[each.rows])
    X = np.full(initial.shape, np.nan)
    for each in people:
        if each is each.ties.people[0]:
            each.optimise()
    for each in people:
        X[each.rows] = each.positions
    return X


def _problems(
    rows: Observations, X: Array, covariance: Array, people: Sequence[FrameGraph]
) -> tuple[Problem, ...]:
    """Joints that could not be solved."""
    finite = np.asarray(np.isfinite(X).all(axis=2))
    reasons = np.full(finite.shape, "", dtype=object)
    lost = finite & ~np.isfinite(covariance).all(axis=(2, 3))
    reasons[lost] = "undetermined: its system is singular"
    for person in people:
        displacement_m = np.linalg.norm(X[person.rows] - person.first, axis=2)
        ran = person.touched & (displacement_m > RUNAWAY_M)
        reasons[person.rows] = np.where(ran, "diverged from its views", reasons[person.rows])
        if person.failure:
            solved = finite[person.rows]
            reasons[person.rows] = np.where(solved, person.failure, reasons[person.rows])
    return tuple(
        Problem(int(n), int(rows.track[n]), int(rows.frame[n]), int(j), str(reasons[n, j]))
        for n, j in np.argwhere(reasons != "")
    )
