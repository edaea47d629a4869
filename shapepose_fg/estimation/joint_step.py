"""The X step in single frames: solves people's joints, given the views and the body."""

from collections.abc import Sequence

import numpy as np

from factors import DEFAULT_WIDTH_SIGMA
from shapepose_fg.body.fitting.fitter import JointTargets
from shapepose_fg.core.arrays import Array
from shapepose_fg.core.camera import Views
from shapepose_fg.core.kernel_geometry import ROBUST
from shapepose_fg.core.observations import Observations
from shapepose_fg.estimation.estimator_config import EstimatorConfig
from shapepose_fg.estimation.kernels import ready, solve_chains
from shapepose_fg.estimation.linearisation import ViewEvidence
from shapepose_fg.estimation.window_graph import WindowGraph

UNDETERMINED_M = 10.0
"""Standard deviation, metres, above which a joint is undetermined, in its worst direction."""
_SIGMA_M = 0.02
"""Usual standard deviation of a joint seen by several views, metres."""
_HELD = 1e-6
"""Information of the prior that keeps joints in place, 1/m²: one kilometre."""


def solve_between(
    observed: Observations,
    sigmas_px: Array,
    cameras: Views,
    evidence: ViewEvidence,
    of_body: JointTargets,
    config: EstimatorConfig,
) -> Array:
    """X (R, J, 3) of people in single frames, metres, without a graph, for the rounds before the
    last; NaN where neither views nor body place a joint.

    The result is about that of GTSAM, which starts from it in the last round. A joint that moves by
    more than `UNDETERMINED_M` keeps its initial position.
    """
    initial = _start(evidence.points, evidence.sigma_m, of_body, config)
    scale, kernel = 1.0 / np.sqrt(config.graph.weight_2d), config.observations.robust_kernel
    width = 1.0 if kernel is None else DEFAULT_WIDTH_SIGMA[kernel] / scale
    known = np.isfinite(initial).all(axis=-1, keepdims=True)
    used = evidence.inlier & (sigmas_px > 0) & known
    weights = np.where(used, 1.0 / np.where(used, scale * sigmas_px, 1.0) ** 2, 0.0)
    pulls, (R, J) = of_body.where(of_body.known, config.graph.weight_shape), initial.shape[:2]
    start = np.where(known, initial, 0.0)
    # A very weak prior: with one view the depth would be undetermined.
    information = pulls.information + _HELD * np.eye(3)
    right = (pulls.information @ pulls.xyz[..., None])[..., 0] + _HELD * start
    # The error is quadratic in the step: a hundredth of a sigma corresponds to the tolerance 1e-4.
    settled_m, found = _SIGMA_M * float(np.sqrt(config.graph.tolerance)), start.copy()
    same = len(cameras.projection) == 1
    for n, rows in enumerate([slice(None)] if same else [slice(n, n + 1) for n in range(R)]):
        states, xy, weight, own, to = (
            ready(each[rows].reshape(-1, *each.shape[2:]))
            for each in (found, observed.xy, weights, information, right)
        )
        states = states[:, None]
        solve_chains(
            states, np.arange(len(states)), own[:, None], np.empty((len(states), 0, 3, 3)),
            to[:, None], cameras.projection[n : n + 1], xy[None], weight[None],
            np.zeros((1, *weight.shape)), ROBUST[kernel], width, config.graph.max_iterations,
            settled_m, np.empty((0, 1, 1, 1)),
        )  # fmt: skip
        found[rows] = states.reshape(-1, J, 3)
    far = np.abs(found - start).max(axis=-1, keepdims=True) > UNDETERMINED_M
    return np.where(known, np.where(far, start, found), np.nan)


def solve_joints(
    parts: Sequence[tuple[WindowGraph, slice]],
    evidence: ViewEvidence,
    of_body: JointTargets,
    config: EstimatorConfig,
    near: Array | None = None,
) -> None:
    """Solve people's graphs, each with its part of the rows of views and body; results are in
    `positions`.

    People coupled by factors must all be included. They start at `near` (R, J, 3), the result of
    `solve_between`, if given.
    """
    for person, part in parts:
        points, sigma_m, body = evidence.points[part], evidence.sigma_m[part], of_body.rows(part)
        initial = _start(points, sigma_m, body, config)
        used = evidence.inlier[part] & np.isfinite(initial[..., :1])
        person.prepare(used, body, initial if near is None else near[part])
    for person, _ in parts:
        if person is person.ties.people[0]:
            person.optimise()


def _start(points: Array, sigma_m: Array, body: JointTargets, config: EstimatorConfig) -> Array:
    """Initial positions of joints (R, J, 3) from the views, at `points`, or from the body; NaN if
    neither.
    """
    placed = sigma_m <= config.refine.max_sigma_m
    return np.where(placed[..., None], points, np.where(body.known[..., None], body.xyz, np.nan))
