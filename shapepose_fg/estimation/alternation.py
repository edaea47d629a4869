"""Stage II: joints and bodies in alternation, as in Algorithm 1 of the paper, over windows of frames."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.body.fitting.evidence import LEAST_JOINTS
from shapepose_fg.body.fitting.fitter import BodyFit, BodyFitter, FitStatus, JointTargets
from shapepose_fg.core.camera import Views
from shapepose_fg.core.observations import Observations
from shapepose_fg.estimation.body_step import BodyStep, Tie, disagreement
from shapepose_fg.estimation.contact import walking
from shapepose_fg.estimation.estimator_config import EstimatorConfig
from shapepose_fg.estimation.in_time import interpolated
from shapepose_fg.estimation.linearisation import ViewEvidence, linearise, mean_confidence
from shapepose_fg.estimation.message import Message
from shapepose_fg.estimation.motion_model import LOST_M
from shapepose_fg.estimation.window_graph import WindowGraph


@dataclass(frozen=True)
class Window:
    """The rows of one person that are solved together."""

    rows: NDArray[np.intp]
    """(T,) rows of the observations, frames rising."""
    graph: WindowGraph
    """Their factor graph."""


@dataclass
class Solution:
    """N rows on their way through the alternation; each round changes those that still move."""

    joints: NDArray[np.float64]
    """(N, J, 3) X, metres; NaN where unknown."""
    inlier: NDArray[np.bool_]
    """(N, J, V) delta_ij of Eq. 2: which observations were kept."""
    contradicts: NDArray[np.bool_]
    """(N, J) joints whose views the body contradicts (`disagreement`): gated anew from the body's place."""
    views: Message
    """What the views alone say of N rows, all of the error in it."""
    body: Message
    """What the body says of each joint without the joint's own views; zero where it does not pull."""
    enough: NDArray[np.bool_]
    """(N,) rows whose views place enough joints to place a person."""
    fit: BodyFit
    """Theta: the bodies, N rows."""

    @classmethod
    def start(cls, X: NDArray[np.float64], views: int) -> "Solution":
        """Nothing but X_0 (N, J, 3)."""
        N, J = X.shape[:2]

        def nothing() -> Message:
            return Message(np.full((N, J, 3), np.nan), np.zeros((N, J, 3, 3)))

        none = np.zeros(N, dtype=bool)
        fit = BodyFit.failed(np.full(N, FitStatus.TOO_FEW_JOINTS), J)
        seen, wrong = np.zeros((N, J, views), dtype=bool), np.zeros((N, J), dtype=bool)
        return cls(X.copy(), seen, wrong, nothing(), nothing(), none, fit)


def alternate(
    observations: Observations,
    views: Views,
    sigmas: NDArray[np.float64],
    X: NDArray[np.float64],
    windows: Sequence[Window],
    fitter: BodyFitter,
    config: EstimatorConfig,
) -> Solution:
    """Refine N rows, from X_0 (N, J, 3).

    In each round the body is fitted to what the views alone say of all joints, and then pulls the joints. What it
    says of a joint leaves that joint's own views out (`BodyFit.prior_xyz`), so that nothing is counted twice and
    the covariances stay honest. Motion acts on the joints, never on what the body is fitted to. `config.refine`
    switches to what the paper does in place of it.
    """
    solution = Solution.start(X, len(views))
    moving = list(windows)
    for n in range(config.refine.alternations):
        rows = np.concatenate([window.rows for window in moving]) if moving else np.zeros(0, dtype=np.intp)
        observed, sigma, here, start = (
            observations.rows(rows),
            sigmas[rows],
            views.rows(rows),
            solution.joints[rows],
        )
        evidence = linearise(observed, sigma, start, here, config.observations)
        if n == 0:
            placed = evidence.sigma_m <= config.refine.max_sigma_m
            solution.enough[rows] = placed.sum(axis=1) >= LEAST_JOINTS
        enough = solution.enough[rows]
        step = BodyStep(fitter, _groups(moving), config)
        targets = step.targets(evidence, enough)
        body = step.fit(targets, solution.fit.rows(rows))  # the Theta step
        fitted = evidence.target
        wrong = disagreement(evidence, body) > config.refine.contradiction
        if wrong.any():
            # Gated anew around the body's place; and the body is fitted again, without what was thrown away.
            there = np.where(wrong[..., None], body.prior_xyz, start)
            evidence = linearise(observed, sigma, there, here, config.observations)
            again = np.flatnonzero(wrong.any(axis=-1))
            targets = step.targets(evidence, enough)
            body = body.with_rows(again, step.fit(targets, body, again))
        # delta of Eq. 4; and what its views do not determine needs the body however sure its one view is.
        pulled = mean_confidence(observed, evidence.inlier) <= config.graph.rho_3d
        pulled |= evidence.sigma_m > config.refine.max_sigma_m
        said = step.message(body, targets, pulled, _ties(moving))
        X_new = _solve(moving, evidence, said, config)
        solution.joints[rows], solution.inlier[rows] = X_new, evidence.inlier
        solution.contradicts[rows] |= wrong
        for kept, new in ((solution.views, Message(evidence.target, evidence.information)), (solution.body, said)):
            kept.xyz[rows], kept.information[rows] = new.xyz, new.information
        solution.fit = solution.fit.with_rows(rows, body)
        # Settled: the body was fitted to where the joints are now, and pulled joints stay where they were.
        before = np.where((said.known | wrong)[..., None], start, fitted)
        shift = np.linalg.norm(X_new - before, axis=-1)
        settled = ((shift < config.refine.settled_m) | np.isnan(X_new).any(axis=-1)).all(axis=1)
        more = n + 1 < config.refine.window_alternations
        moving = [
            window
            for window, done in zip(moving, _by_window(settled, moving), strict=True)
            if not done.all() and (more or not window.graph.temporal or window.graph.touched.any())
        ]
        if len(moving) == 0:
            break
    return solution


def final_bodies(
    solution: Solution,
    covariance: NDArray[np.float64],
    windows: Sequence[Window],
    fitter: BodyFitter,
) -> BodyFit:
    """The bodies that are returned: where there are factors of the user's own, fitted to the joints as solved.

    The bodies follow these factors so. What they say goes nowhere else: joints and covariances are done.
    """
    chosen = [
        window
        for window in windows
        if window.graph.touched.any() and (window.graph.temporal or solution.fit.ok[window.rows].all())
    ]
    if len(chosen) == 0:
        return solution.fit
    rows = np.concatenate([window.rows for window in chosen])
    rows = rows[solution.fit.ok[rows]]
    xyz, information = solution.joints[rows], np.zeros((len(rows), *covariance.shape[1:]))
    known = np.isfinite(xyz).all(axis=-1) & np.isfinite(covariance[rows]).all(axis=(2, 3))
    information[known] = np.linalg.inv(covariance[rows][known])
    information = (information + information.swapaxes(2, 3)) / 2
    fit = fitter.fit_whole(JointTargets(np.nan_to_num(xyz), information), solution.fit.rows(rows))
    return solution.fit.with_rows(rows[fit.ok], fit.rows(np.flatnonzero(fit.ok)))


def _groups(windows: Sequence[Window]) -> NDArray[np.intp] | None:
    """(R,) a number for each row that says whose shape it has; None where every row is alone."""
    lengths = [len(window.rows) for window in windows]
    return np.repeat(np.arange(len(lengths)), lengths) if any(length > 1 for length in lengths) else None


def _ties(windows: Sequence[Window]) -> list[Tie]:
    """Joints that the user's factors tie to each other, with the rows of the windows where they do."""
    return [
        (
            joints,
            np.flatnonzero(np.concatenate([np.full(len(w.rows), joints in w.graph.coupled) for w in windows])),
        )
        for joints in sorted({each for window in windows for each in window.graph.coupled}, key=sorted)
    ]


def _by_window(values: NDArray, windows: Sequence[Window]) -> list[NDArray]:
    """Values (R, ...) of the windows' rows, one after the other, cut into windows again."""
    return np.split(values, np.cumsum([len(window.rows) for window in windows])[:-1]) if windows else []


def _solve(
    windows: Sequence[Window], evidence: ViewEvidence, body: Message, config: EstimatorConfig
) -> NDArray[np.float64]:
    """The X step for every window: (R, J, 3)."""
    placed = evidence.sigma_m <= config.refine.max_sigma_m
    known = placed | body.known
    start = np.where(placed[..., None], evidence.points, np.where(body.known[..., None], body.xyz, np.nan))
    badly = evidence.sigma_m > LOST_M
    X = np.full(evidence.points.shape, np.nan)
    first = 0
    for window in windows:
        part = slice(first, first + len(window.rows))
        first = part.stop
        inlier, initial, lost = evidence.inlier[part], start[part], None
        if window.graph.temporal:
            initial = np.where(np.isfinite(evidence.points[part]), evidence.points[part], initial)
            initial = interpolated(initial, window.graph.times_s)
            # X_0 alone is no evidence: a joint that nobody says anything of has nothing that determines it.
            mentioned = (inlier.any(axis=-1) | body.known[part]).any(axis=0) | window.graph.touched
            initial[:, ~mentioned] = np.nan
            lost = badly[part]
        else:
            inlier = inlier & known[part][..., None]
        views = Message(evidence.target[part], evidence.information[part])
        problem = inlier, views, body.rows(np.arange(part.start, part.stop))
        X[part] = window.graph.solve(*problem, initial, lost, walking(window.graph, problem, initial, lost))
    return X
