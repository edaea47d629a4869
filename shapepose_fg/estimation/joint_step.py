"""The X step: solves people's joints, given the views and the body."""

from collections.abc import Sequence

import numpy as np

from shapepose_fg.body.fitting.fitter import JointTargets
from shapepose_fg.core.arrays import Array
from shapepose_fg.core.camera import Views
from shapepose_fg.core.observations import Observations
from shapepose_fg.estimation.contact import feet_of
from shapepose_fg.estimation.estimator_config import EstimatorConfig
from shapepose_fg.estimation.in_time import interpolated
from shapepose_fg.estimation.joint_chains import Projections, solved_apart
from shapepose_fg.estimation.linearisation import ViewEvidence
from shapepose_fg.estimation.motion_model import LOST_M
from shapepose_fg.estimation.window_graph import WindowGraph

_SIGMA_M = 0.02
"""Usual standard deviation of a joint seen by several views, metres."""


def solve_between(
    observed: Observations,
    sigmas_px: Array,
    cameras: Views,
    evidence: ViewEvidence,
    of_body: JointTargets,
    config: EstimatorConfig,
) -> Array:
    """X (R, J, 3) of people in single frames, metres, without a graph, for the rounds before the
    last.

    The result is about that of GTSAM, which starts from it in the last round.
    """  # fmt: skip
    initial = _start(evidence.points, evidence.sigma_m, of_body, config)
    scale = 1.0 / np.sqrt(config.graph.weight_2d)  # as in `WindowGraph`
    used = evidence.inlier & (sigmas_px > 0) & np.isfinite(initial[..., :1])
    kernel, in_step = config.observations.robust_kernel, np.zeros(used.shape)
    seen = Projections(cameras, observed.xy, sigmas_px * scale, used, in_step, kernel, scale)
    pulls, solver = of_body.where(of_body.known, config.graph.weight_shape), config.graph
    # The error is quadratic in the step: a hundredth of a sigma corresponds to the tolerance 1e-4.
    return solved_apart(
        seen, pulls, initial, solver.max_iterations, _SIGMA_M * float(np.sqrt(solver.tolerance))
    )


def solve_joints(
    parts: Sequence[tuple[WindowGraph, slice]],
    evidence: ViewEvidence,
    of_body: JointTargets,
    config: EstimatorConfig,
    near: Array | None = None,
) -> None:
    """Solve people's graphs, each with its part of the rows of views and body; results are in
    `positions`.

    People coupled by factors must all be included. Single frames may start at `near` (R, J, 3), the
    result of `solve_between`.
    """
    for person, part in parts:
        _prepare(person, evidence, of_body, part, config, None if near is None else near[part])
    for person, _ in parts:
        if person is person.ties.people[0]:
            person.optimise()


def _prepare(
    person: WindowGraph,
    evidence: ViewEvidence,
    of_body: JointTargets,
    part: slice,
    config: EstimatorConfig,
    near: Array | None,
) -> None:
    """Set up the problem of one person."""
    views, body = evidence.message.rows(part), of_body.rows(part)
    inlier, sigma_m, points = evidence.inlier[part], evidence.sigma_m[part], evidence.points[part]
    initial = _start(points, sigma_m, body, config)
    if not person.temporal:
        used = inlier & np.isfinite(initial[..., :1])
        person.prepare(used, views, body, initial if near is None else near)
        return
    initial = interpolated(np.where(np.isfinite(points), points, initial), person.times_s)
    # X_0 is not evidence: a joint without other information is undetermined.
    mentioned = (inlier.any(axis=-1) | body.known).any(axis=0) | person.touched
    initial[:, ~mentioned] = np.nan
    lost = sigma_m > LOST_M
    feet = feet_of(config.joints if config.motion.contact else ())
    person.prepare(inlier, views, body, initial, lost, feet)


def _start(points: Array, sigma_m: Array, body: JointTargets, config: EstimatorConfig) -> Array:
    """Initial positions of joints (R, J, 3) from the views, at `points`, or from the body; NaN if
    neither.
    """
    placed = sigma_m <= config.refine.max_sigma_m
    return np.where(placed[..., None], points, np.where(body.known[..., None], body.xyz, np.nan))
