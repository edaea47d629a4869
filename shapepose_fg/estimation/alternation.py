"""Stage II: joints and bodies in alternation, as in Algorithm 1 of the paper, over windows of frames."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
from annotated_types import Interval
from numpy.typing import NDArray

from shapepose_fg.body.fitting.fitter import BodyFit, BodyFitter, FitStatus, JointTargets
from shapepose_fg.bounds import Count, Factor, Metres, Repeats, Settings
from shapepose_fg.camera import Views
from shapepose_fg.estimation.draft import MODEL_SIGMA_M, WholeFitter
from shapepose_fg.estimation.linearisation import (
    ObservationConfig,
    ViewEvidence,
    linearise,
    mean_confidence,
)
from shapepose_fg.estimation.motion_model import MotionConfig
from shapepose_fg.estimation.window_graph import Message, WindowGraph, WindowGraphConfig
from shapepose_fg.observations import Observations


@dataclass(frozen=True)
class RefineConfig(Settings):
    """How the alternation runs."""

    alternations: Repeats = 3
    """N of Algorithm 1: how often the body is fitted and the joints are solved, at the most."""
    window_alternations: Repeats = 1
    """The same for windows of several frames, which start from a draft of all joints (`Estimator.draft`): a second
    round, at twice the time, changed the mean error by 0.1 to 0.2 mm. Windows with factors of the user's own take
    as many as frames alone: what such a factor says may be far from what the views said."""
    settled_m: Annotated[float, Interval(ge=0, le=10)] = 0.002
    """A window whose joints all moved less in a round is done: most frames are after one or two. 0: none is."""
    max_sigma_m: Metres = 0.5
    """A joint whose views leave it less certain than this in some direction is not determined by them."""
    disagreement: Factor = 6.0
    """A joint that its views put this many standard deviations from where the body can have it is seen wrongly:
    its gates are decided anew from the body's place, and the body is fitted again without what was thrown away. 4
    threw away more joints that were right than wrong ones, in simulated crowds whose detections had been given out
    again."""
    min_joints: Count = 4
    """Fewer joints than this determined by the views are not a person that can be placed in space."""


@dataclass(frozen=True)
class EstimatorConfig:
    """The settings of stage II."""

    observations: ObservationConfig = field(default_factory=ObservationConfig)
    """How far a 2D observation is trusted."""
    graph: WindowGraphConfig = field(default_factory=WindowGraphConfig)
    """What goes into the factor graph of a person."""
    refine: RefineConfig = field(default_factory=RefineConfig)
    """How joints and bodies alternate."""
    motion: MotionConfig = field(default_factory=MotionConfig)
    """How frames hang together."""


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
    the covariances stay honest. Motion acts on the joints, never on what the body is fitted to.
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
            solution.enough[rows] = placed.sum(axis=1) >= config.refine.min_joints
        groups = _groups(moving)
        enough = solution.enough[rows]
        body = fitter.fit(joint_targets(evidence, enough), solution.fit.rows(rows), groups)  # the Theta step
        fitted = evidence.target
        wrong = disagreement(evidence, body) > config.refine.disagreement
        if wrong.any():
            # Gated anew around the body's place; and the body is fitted again, without what was thrown away.
            there = np.where(wrong[..., None], body.prior_xyz, start)
            evidence = linearise(observed, sigma, there, here, config.observations)
            again = np.flatnonzero(wrong.any(axis=-1))
            targets = joint_targets(evidence, enough)
            body = body.with_rows(again, _fit(fitter, targets, body, groups, again))
        said = _message(observed, evidence, body, moving, groups, enough, fitter, config)
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
    whole = fitter.fit_whole if isinstance(fitter, WholeFitter) else fitter.fit
    fit = whole(JointTargets(np.nan_to_num(xyz), information), solution.fit.rows(rows))
    return solution.fit.with_rows(rows[fit.ok], fit.rows(np.flatnonzero(fit.ok)))


def disagreement(evidence: ViewEvidence, fit: BodyFit) -> NDArray[np.float64]:
    """How far (N, J) each joint's views put it from where the body can have it, in standard deviations.

    The smaller of two distances, each against the sum of both covariances: to where the rest of the body puts the
    joint (`prior_xyz`), and to the joint of the body that was fitted with it. The first is a Gaussian around one
    pose: a forearm that is bent further lies far outside it though no bone is too long for it. The second is there
    to tell; it stays away from what no pose reaches, since its kernel is robust. Where the views leave a
    direction open, they cannot disagree in it. 0 for rows without a body.
    """
    model = MODEL_SIGMA_M**2 * np.eye(3)
    prior = _sigmas_apart(evidence, fit.prior_xyz, fit.prior_covariance)
    fitted = _sigmas_apart(evidence, fit.joints, np.nan_to_num(fit.covariance) + model)
    return np.where(fit.ok[:, None], np.fmin(prior, fitted), 0.0)


def _sigmas_apart(
    evidence: ViewEvidence, xyz: NDArray[np.float64], covariance: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Distance (N, J) of what the views say from `xyz` (N, J, 3) +- `covariance`, standard deviations; NaN
    unknown.
    """
    known = np.asarray(np.isfinite(xyz).all(axis=2))
    apart = np.where(known[..., None], np.nan_to_num(evidence.target - xyz), 0.0)
    other = np.where(known[..., None, None], covariance, np.eye(3))
    # (L^-1 + C)^-1 = L (I + C L)^-1, which holds for information L that is singular, too.
    information = evidence.information
    weight = information @ np.linalg.inv(np.eye(3) + other @ information)
    squared = np.einsum("...i,...ij,...j->...", apart, weight, apart)
    return np.where(known, np.sqrt(np.maximum(squared, 0.0)), np.nan)


def joint_targets(evidence: ViewEvidence, enough: NDArray[np.bool_]) -> JointTargets:
    """What the body is fitted to: what the views say of all joints, of rows whom they determine (`enough`)."""
    information = np.where(enough[:, None, None, None], evidence.information, 0.0)
    return JointTargets(np.nan_to_num(evidence.target), information)


def _groups(windows: Sequence[Window]) -> NDArray[np.intp] | None:
    """(R,) a number for each row that says whose shape it has; None where every row is alone."""
    lengths = [len(window.rows) for window in windows]
    return np.repeat(np.arange(len(lengths)), lengths) if any(length > 1 for length in lengths) else None


def _by_window(values: NDArray, windows: Sequence[Window]) -> list[NDArray]:
    """Values (R, ...) of the windows' rows, one after the other, cut into windows again."""
    return np.split(values, np.cumsum([len(window.rows) for window in windows])[:-1]) if windows else []


def _fit(
    fitter: BodyFitter,
    targets: JointTargets,
    last: BodyFit,
    groups: NDArray[np.intp] | None,
    rows: NDArray[np.intp],
) -> BodyFit:
    """Fit some of the rows."""
    some = JointTargets(targets.xyz[rows], targets.information[rows])
    return fitter.fit(some, last.rows(rows), None if groups is None else groups[rows])


def _message(
    observed: Observations,
    evidence: ViewEvidence,
    body: BodyFit,
    windows: Sequence[Window],
    groups: NDArray[np.intp] | None,
    enough: NDArray[np.bool_],
    fitter: BodyFitter,
    config: EstimatorConfig,
) -> Message:
    """What the body says of the joints that it pulls: delta of Eq. 4, and joints that their views do not
    determine.

    The latter need the body however sure their one view is.
    """
    xyz, covariance = body.prior_xyz.copy(), body.prior_covariance.copy()
    ok = np.repeat(body.ok[:, None], xyz.shape[1], axis=1)
    targets = joint_targets(evidence, enough)
    for joints in sorted({each for window in windows for each in window.graph.coupled}, key=sorted):
        # Tied to each other, each would get the others' views twice: through the tie, and through the body.
        tied = np.concatenate([np.full(len(w.rows), joints in w.graph.coupled) for w in windows])  # one flag a row
        rows, columns = np.flatnonzero(tied), np.array(sorted(joints))
        information = targets.information.copy()
        information[:, columns] = 0.0
        alone = _fit(fitter, JointTargets(targets.xyz, information), body, groups, rows)
        here = np.ix_(rows, columns)
        xyz[here], covariance[here] = alone.prior_xyz[:, columns], alone.prior_covariance[:, columns]
        ok[here] = alone.ok[:, None]
    doubtful = mean_confidence(observed, evidence.inlier) <= config.graph.rho_3d
    pulled = (doubtful | (evidence.sigma_m > config.refine.max_sigma_m)) & ok
    information = np.zeros_like(covariance)
    information[pulled] = np.linalg.inv(covariance[pulled])
    return Message(np.where(pulled[..., None], xyz, np.nan), information)


def _solve(
    windows: Sequence[Window], evidence: ViewEvidence, body: Message, config: EstimatorConfig
) -> NDArray[np.float64]:
    """The X step for every window: (R, J, 3)."""
    placed = evidence.sigma_m <= config.refine.max_sigma_m
    known = placed | body.known
    start = np.where(placed[..., None], evidence.points, np.where(body.known[..., None], body.xyz, np.nan))
    badly = evidence.sigma_m > config.motion.lost_m
    X = np.full(evidence.points.shape, np.nan)
    first = 0
    for window in windows:
        part = slice(first, first + len(window.rows))
        first = part.stop
        inlier, initial, lost = evidence.inlier[part], start[part], None
        if window.graph.temporal:
            initial = np.where(np.isfinite(evidence.points[part]), evidence.points[part], initial)
            initial = interpolated(initial, window.graph.times_s)
            lost = badly[part]
        else:
            inlier = inlier & known[part][..., None]
        views = Message(evidence.target[part], evidence.information[part])
        X[part] = window.graph.solve(inlier, views, body.rows(np.arange(part.start, part.stop)), initial, lost)
    return X


def interpolated(points: NDArray[np.float64], times_s: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points (T, J, 3) with gaps closed in a straight line, and the ends held; joints never known stay NaN."""
    known = np.asarray(np.isfinite(points).all(axis=2))
    result = points.copy()
    for joint in np.flatnonzero(known.any(axis=0) & ~known.all(axis=0)).tolist():
        there = known[:, joint]
        for axis in range(3):
            result[:, joint, axis] = np.interp(times_s, times_s[there], points[there, joint, axis])
    return result
