"""Stage II with the body in the graph: from observations of a window to joints, covariances and
bodies.
"""

from dataclasses import replace

import numpy as np

from shapepose_fg.body.fitting.evidence import LEAST_JOINTS
from shapepose_fg.body.fitting.fitter import BodyFit, BodyFitter, FitStatus
from shapepose_fg.core.arrays import Array, Index, Mask
from shapepose_fg.core.camera import Views
from shapepose_fg.core.observations import Observations
from shapepose_fg.core.reconstruction import Known, Status
from shapepose_fg.estimation.body_step import joint_targets
from shapepose_fg.estimation.body_window import BodyWindow
from shapepose_fg.estimation.body_window_graph import BodyGraph
from shapepose_fg.estimation.draft import first_places
from shapepose_fg.estimation.estimator_config import EstimatorConfig
from shapepose_fg.estimation.in_time import velocities
from shapepose_fg.estimation.linearisation import (
    ViewEvidence,
    linearise,
    mean_confidence,
    observation_sigmas,
)
from shapepose_fg.estimation.motion_model import MotionModel
from shapepose_fg.estimation.state import window_rows
from shapepose_fg.estimation.window_solution import PersonGraph, WindowSolution, tied

LASTS = 2.0
"""Covariances over time are this many times those of errors that are new in every frame: detectors'
errors last.

Solution and gates do not change: detections, bodies, motion and priors all are that much less
certain."""
GATE_M = 0.1
"""rho_2D of Eq. 2 in windows, as a length at the joint's depth, at the initial estimate and in
every round."""
_WEAK_SCORE, _WEAK_PROBABILITY = 0.3, 0.5
_OUTSIDE_M = 0.02


def solve_bodies(
    observations: Observations,
    views: Views,
    fitter: BodyFitter,
    config: EstimatorConfig,
    motion: MotionModel,
) -> WindowSolution:
    """Joints, covariances and bodies of N rows; each track over its rows, or a row by itself."""
    assert fitter.model is not None
    gates = replace(config.observations, rho_2d_m=min(GATE_M, config.observations.rho_2d_m))
    X = first_places(observations, views, fitter, config)
    sigmas = observation_sigmas(observations, X, views, config.observations, config.joints)
    evidence = linearise(observations, sigmas, X, views, gates)
    enough = (evidence.sigma_m <= config.refine.max_sigma_m).sum(axis=1) >= LEAST_JOINTS
    start = fitter.fit_whole(joint_targets(evidence, enough))
    # What the initial estimate discards stays out: bodies can be drawn to the other leg's
    # detections.
    sigmas = np.where(evidence.inlier, sigmas, 0.0)
    N, J, _ = sigmas.shape
    covariance, speeds = np.full((N, J, 3, 3), np.nan), np.full((N, J, 3, 3), np.nan)
    velocity, inlier, residual = (
        np.full((N, J, 3), np.nan),
        evidence.inlier.copy(),
        evidence.residual_px.copy(),
    )
    fit, people = BodyFit.failed(start.status, J), list[BodyGraph]()
    joints = np.full((N, J, 3), np.nan)
    for rows in window_rows(observations):
        if not start.ok[rows].any():
            joints[rows], covariance[rows] = _of_views(evidence, rows, config.refine.max_sigma_m)
            continue
        here = observations.rows(rows), sigmas[rows], views.rows(rows)
        window = BodyWindow(*here, fitter.model, gates, motion, config.law)
        free = window.energy.parameters(start.rows(rows), np.zeros((len(rows), 3)))
        try:
            state = window.solve(_filled(free, start.ok[rows], window.times_s))
            marginals = window.covariances(state)
        except np.linalg.LinAlgError:
            joints[rows], covariance[rows] = _of_views(evidence, rows, config.refine.max_sigma_m)
            continue
        widen = LASTS if len(rows) > 1 else 1.0
        joints[rows], covariance[rows] = window.joints(state), widen * marginals.joints()
        last = window.last.evidence
        inlier[rows], residual[rows] = last.inlier, last.residual_px
        if len(rows) > 1:
            velocity[rows] = velocities(joints[rows], window.times_s)
            speeds[rows] = widen * marginals.velocities()
        fit.put_bodies(rows, window.parameters(state), np.zeros((len(rows), 3)))
        fit.joints[rows] = joints[rows] - state.deviation
        fit.covariance[rows] = covariance[rows]
        fit.residual_m[rows] = np.sqrt((state.deviation**2).sum(axis=-1).mean(axis=-1))
        fit.status[rows] = FitStatus.OK
        frames = observations.frame[rows].astype(np.int64)
        people.append(
            BodyGraph(window, state, int(observations.track[rows[0]]), frames, widen, rows)
        )
    found = np.isfinite(joints).all(axis=-1)
    strong = (
        inlier
        & (observations.confidence >= _WEAK_SCORE)
        & (observations.probability > _WEAK_PROBABILITY)
    )
    known = np.where(
        strong.sum(axis=-1) >= 2, Known.SEEN, np.where(inlier.any(axis=-1), Known.WEAK, Known.BODY)
    )
    status = np.where(
        fit.ok, Status.OK, np.where(enough, Status.BODY_UNDETERMINED, Status.TOO_FEW_VIEWS)
    )
    return WindowSolution(
        observations, joints, covariance, velocity, speeds, mean_confidence(observations, inlier), inlier,
        np.zeros((N, J), dtype=bool), residual, np.where(found, known, Known.UNKNOWN).astype(np.uint8), fit, status,
        people=tied([
            PersonGraph(
                window=each, joints=joints[each.rows], covariance=covariance[each.rows],
                bodies=fit.rows(each.rows),
            )
            for each in people
        ]),
    )  # fmt: skip


def _filled(free: Array, ok: Mask, times_s: Array) -> Array:
    """Bodies (T, P), those that are not `ok` (T,) as the nearest in time that are."""
    there = np.flatnonzero(ok)
    return free[there[np.abs(times_s[:, None] - times_s[there]).argmin(axis=1)]]


def _of_views(evidence: ViewEvidence, rows: Index, most_m: float) -> tuple[Array, Array]:
    """What the views alone say of joints, where they determine them; NaN elsewhere."""
    placed = (evidence.sigma_m[rows] <= most_m)[..., None]
    covariance = np.full((*placed.shape[:2], 3, 3), np.nan)
    information = evidence.information[rows]
    covariance[placed[..., 0]] = np.linalg.inv(information[placed[..., 0]])
    return np.where(placed, evidence.target[rows], np.nan), covariance
