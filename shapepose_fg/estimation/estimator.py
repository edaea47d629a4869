"""From whose 2D detections are whose to joints, velocities and bodies: stage II as one object."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace

import gtsam
import numpy as np
from numpy.typing import NDArray

from factors import make_camera
from shapepose_fg.body.fitting.evidence import LEAST_JOINTS
from shapepose_fg.body.fitting.fitter import BodyFit, BodyFitter, check_fitter
from shapepose_fg.core.camera import Rig, Views
from shapepose_fg.core.observations import Observations
from shapepose_fg.core.reconstruction import Status
from shapepose_fg.estimation.alternation import Solution, Window, alternate, final_bodies
from shapepose_fg.estimation.body_step import joint_targets
from shapepose_fg.estimation.calibration import Calibration, Clues, from_body, lasting_mean
from shapepose_fg.estimation.contact import feet_of
from shapepose_fg.estimation.doubt import association_spread, exchange_spread, limbs_to_exchange
from shapepose_fg.estimation.draft import NARROWING, changed_targets, drafted, limb_steps
from shapepose_fg.estimation.estimator_config import EstimatorConfig
from shapepose_fg.estimation.in_time import near_in_time, smoothed_in_time, waited_s
from shapepose_fg.estimation.limb_lengths import limb_lengths, limbs_of, with_lengths
from shapepose_fg.estimation.linearisation import (
    ViewEvidence,
    linearise,
    mean_confidence,
    observation_sigmas,
    triangulate,
    weakest_sigma,
)
from shapepose_fg.estimation.motion_model import MotionModel
from shapepose_fg.estimation.outcome import SEEN_M, Problem, how_known, problems, reported_covariance, strong
from shapepose_fg.estimation.plain_view import SPEED_M_S, elsewhere_variance, limbs_that_hide
from shapepose_fg.estimation.smoothing import smoothed
from shapepose_fg.estimation.state_covariances import state_covariances
from shapepose_fg.estimation.window_graph import WindowGraph
from shapepose_fg.estimation.window_solution import WindowSolution

ExtraFactors = Callable[[WindowGraph, NDArray[np.int64]], Iterable[gtsam.NonlinearFactor]]
"""Your own factors for a person's window, made from its keys (T, J)."""


@dataclass(frozen=True)
class Estimates:
    """N rows after stage II, in the order of the observations."""

    joints: NDArray[np.float64]
    """(N, J, 3) X, metres in the world; NaN where unknown."""
    covariance: NDArray[np.float64]
    """(N, J, 3, 3) covariance of each joint, m², errors that last in it; NaN where unknown."""
    velocity: NDArray[np.float64]
    """(N, J, 3) m/s; NaN where unknown, and in rows that stand alone."""
    velocity_covariance: NDArray[np.float64]
    """(N, J, 3, 3) m²/s²; NaN where the velocity is."""
    confidence: NDArray[np.float64]
    """(N, J) w_i of Eq. 4, mean confidence over all views of the observations that were kept."""
    inlier: NDArray[np.bool_]
    """(N, J, V) delta_ij of Eq. 2: which observations were kept."""
    contradicts: NDArray[np.bool_]
    """(N, J) joints whose views the body contradicts."""
    residual_px: NDArray[np.float64]
    """(N, J, V, 2) projection of the joint minus observation; NaN where unseen or unknown."""
    known: NDArray[np.uint8]
    """(N, J) a `Known` each."""
    fit: BodyFit
    """Theta: the bodies, N rows."""
    status: NDArray[np.str_]
    """(N,) a `Status` each."""
    problems: tuple[Problem, ...] = field(default=())
    """What went wrong, joint by joint; rows of these have the status `not solved`."""

    def __len__(self) -> int:
        return len(self.joints)

    def rows(self, index: NDArray[np.intp]) -> "Estimates":
        """Some of the rows."""
        kept = {name: getattr(self, name)[index] for name in _COLUMNS}
        place = {row: n for n, row in enumerate(np.asarray(index).tolist())}
        problems = (replace(each, row=place[each.row]) for each in self.problems if each.row in place)
        return Estimates(**kept, fit=self.fit.rows(index), problems=tuple(problems))


_COLUMNS = (
    "joints covariance velocity velocity_covariance confidence inlier contradicts residual_px known status".split()
)
"""The arrays of `Estimates`."""


class Estimator:
    """Stage II: rig, settings and fitter in one place.

    Rows of one track at several frames are a window, one factor graph; a row whose track has no other is the
    paper's frame-by-frame method, by the same code.
    """

    def __init__(
        self, rig: Rig, fitter: BodyFitter, joints: tuple[str, ...], config: EstimatorConfig | None = None
    ) -> None:
        """`joints` are the names of the detector's joints: the motion model goes by them."""
        self.rig = rig
        check_fitter(fitter)
        self.fitter = fitter
        self.config = EstimatorConfig() if config is None else config
        self.joints = joints
        self._limbs = limbs_of(joints)
        self._hiding = limbs_that_hide(joints)
        self._exchanged = limbs_to_exchange(joints)
        self._motion = MotionModel.load(joints, self.config.motion)
        self._calibration = Calibration.load(joints)

    def estimate(
        self, observations: Observations, extra_factors: ExtraFactors | None = None, views: Views | None = None
    ) -> Estimates:
        """Joints, covariances and bodies of N rows, sorted in any way; (track, frame) must differ.

        `extra_factors` adds factors of your own to every window. `views` are the cameras row by row, where they
        are not the rig's.
        """
        return self.solve(observations, extra_factors, views)[0]

    def solve(
        self, observations: Observations, extra_factors: ExtraFactors | None = None, views: Views | None = None
    ) -> tuple[Estimates, list[WindowSolution]]:
        """The same, and every window with the graph that says it."""
        config = self.config
        views = Views.of(self.rig) if views is None else views
        if len(views) != observations.confidence.shape[2] or views.rows_known not in (None, len(observations)):
            raise ValueError(
                f"views must be of the {len(observations)} rows' {observations.confidence.shape[2]} views"
            )
        X = observations.initial
        if config.refine.complete_start:
            X = triangulate(observations, views, config.observations)
        X = self._completed(X, observations, views)
        sigmas = observation_sigmas(observations, X, views, config.observations, self.joints)
        windows = self._windows(observations, sigmas, views, extra_factors)
        solution = alternate(observations, views, sigmas, X, windows, self.fitter, config)
        return self._estimates(observations, sigmas, views, windows, X, solution)

    def draft(
        self, observations: Observations, views: Views | None = None, *, over_time: bool = False
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """About where the joints of N rows are (N, J, 3), metres, and how surely (N, J, 3, 3), without any graph.

        Enough to give detections out again: what the views say, and where that is little, or contradicts the body,
        what the body says. Views are asked around where they put the joints, and then around the body, ever nearer
        to it (`refine.draft_reach_m`). A joint's views are in the body, too, so that these covariances are too
        small. `over_time` smooths them along each track (`smoothing.smoothed`).
        """
        config = self.config
        views = Views.of(self.rig) if views is None else views
        X = triangulate(observations, views, config.observations)
        sigmas = observation_sigmas(observations, X, views, config.observations, self.joints)
        evidence = linearise(observations, sigmas, X, views, config.observations)
        enough = (evidence.sigma_m <= config.refine.max_sigma_m).sum(axis=1) >= LEAST_JOINTS
        fitted = joint_targets(evidence, enough)
        body = self.fitter.fit_whole(fitted)
        for wider in NARROWING if config.refine.draft_reach_m > 0 else ():
            around = np.where(body.ok[:, None, None], body.joints, X)
            reach_m = wider * config.refine.draft_reach_m
            evidence = linearise(observations, sigmas, around, views, config.observations, reach_m)
            targets = joint_targets(evidence, enough)
            rows = changed_targets(fitted, targets)
            if len(rows) == 0:
                continue
            again = self.fitter.fit_whole(targets.rows(rows))
            fitted = fitted.with_rows(rows, targets.rows(rows))
            placed = np.flatnonzero(again.ok)
            body = body.with_rows(rows[placed], again.rows(placed))
        places, covariance = drafted(evidence, body, config.refine.contradiction)
        if not over_time:
            return places, covariance
        times_s = observations.time_s.mean(axis=1)
        return smoothed(places, covariance, observations.track, times_s, self._motion)

    def _completed(self, X: NDArray[np.float64], observations: Observations, views: Views) -> NDArray[np.float64]:
        """X_0 (N, J, 3) with joints that are not placed where a draft has them, in windows of several frames.

        A view that sees one counts from the first round on, then, and windows need no second.
        """
        _, whose, rows_of = np.unique(observations.track, return_inverse=True, return_counts=True)
        unknown = np.asarray(np.isnan(X).any(axis=2))
        rows = np.flatnonzero(unknown.any(axis=1) & (rows_of[whose] > 1))
        if len(rows) == 0:
            return X
        places, _ = self.draft(observations.rows(rows), views.rows(rows))
        complete = X.copy()
        complete[rows] = np.where(unknown[rows][..., None], places, X[rows])
        return complete

    def _windows(
        self,
        observations: Observations,
        sigmas: NDArray[np.float64],
        views: Views,
        extra_factors: ExtraFactors | None,
    ) -> list[Window]:
        """One window per track, or per row, with the user's factors in it."""
        time_s = observations.time_s
        if np.any(np.ptp(time_s, axis=1) > 1e-3):
            raise ValueError(
                "views of one frame must be exposed within 1 ms of each other: synchronise them first"
            )
        windows = []
        still = _cameras(views)
        for rows in window_rows(observations):
            moving = views.rows_known is not None
            cameras = [_cameras(views, row) if moving else still for row in rows.tolist()]
            graph = WindowGraph(
                cameras,
                observations.xy[rows],
                sigmas[rows],
                self.config.graph,
                self.config.observations.robust_kernel,
                self._motion,
                track=int(observations.track[rows[0]]),
                frames=observations.frame[rows],
                times_s=time_s[rows].mean(axis=1),
                feet=feet_of(self.joints) if self.config.motion.contact else (),
            )
            for factor in extra_factors(graph, graph.keys) if extra_factors is not None else ():
                graph.add(factor)
            windows.append(Window(rows, graph))
        return windows

    def _estimates(
        self,
        observations: Observations,
        sigmas: NDArray[np.float64],
        views: Views,
        windows: Sequence[Window],
        first: NDArray[np.float64],
        solution: Solution,
    ) -> tuple[Estimates, list[WindowSolution]]:
        """Covariances, codes and statuses of what was solved."""
        X = solution.joints
        covariance, velocity_covariance = (np.full((*X.shape, 3), np.nan) for _ in range(2))
        velocity = np.full(X.shape, np.nan)
        found = state_covariances([window.graph for window in windows])
        for window, (of_positions, of_velocities) in zip(windows, found, strict=True):
            graph, rows = window.graph, window.rows
            covariance[rows] = of_positions
            if graph.temporal:
                velocity[rows] = graph.velocity()
                velocity_covariance[rows] = of_velocities
                covariance[rows] = reported_covariance(solution, window, covariance[rows], self._motion.views)
        if self.config.motion.keep_limbs:
            X = self._limbs_kept(X, covariance, windows, solution)
        fit = final_bodies(solution, covariance, windows, self.fitter)
        final = linearise(observations, sigmas, X, views, self.config.observations)
        covariance = self._calibrated(X, covariance, observations, sigmas, final, windows, solution, views)
        reported, sizes = strong(solution, observations), self.rig.image_sizes
        elsewhere = elsewhere_variance(X, observations.frame, reported, views, sizes, self._hiding)
        for window in windows:
            waited = waited_s(np.asarray(reported[window.rows].any(axis=-1)), window.graph.times_s)
            moved = np.minimum(elsewhere[window.rows], (SPEED_M_S * waited) ** 2)
            covariance[window.rows] += moved[..., None, None] * np.eye(3)
        wrong = problems(observations, windows, solution, first, covariance)
        enough = np.where(solution.enough, Status.BODY_UNDETERMINED, Status.TOO_FEW_VIEWS)
        status = np.where(fit.ok, Status.OK, enough)
        status[[problem.row for problem in wrong]] = Status.NOT_SOLVED
        solutions = [
            WindowSolution(
                rows=window.rows,
                joints=X[window.rows],
                covariance=covariance[window.rows],
                bodies=fit.rows(window.rows),
                window=window.graph,
                solved=solution.joints[window.rows],
                solved_covariance=of_positions,
                lasting=self._motion.views,
            )
            for window, (of_positions, _) in zip(windows, found, strict=True)
        ]
        estimates = Estimates(
            joints=X,
            covariance=covariance,
            velocity=velocity,
            velocity_covariance=velocity_covariance,
            confidence=mean_confidence(observations, solution.inlier),
            inlier=solution.inlier,
            contradicts=solution.contradicts,
            residual_px=final.residual_px,
            known=how_known(solution, observations, covariance),
            fit=fit,
            status=status,
            problems=wrong,
        )
        return estimates, solutions

    def _calibrated(
        self,
        X: NDArray[np.float64],
        covariance: NDArray[np.float64],
        observations: Observations,
        sigmas: NDArray[np.float64],
        final: ViewEvidence,
        windows: Sequence[Window],
        solution: Solution,
        views: Views,
    ) -> NDArray[np.float64]:
        """Covariances (N, J, 3, 3) with all doubts: over time as calibrated, in frames alone of the detections."""
        body, count, solved = solution.body, solution.inlier.sum(axis=-1), solution.joints
        of_body = from_body(solved, covariance, body.xyz, body.information)
        association = association_spread(observations, sigmas, final, body, views, self.config.observations)
        moved = np.nan_to_num(solved - observations.initial)
        draft = moved[..., None] * moved[..., None, :]
        exchange = exchange_spread(solved, solution.fit.joints, observations.frame, self._exchanged)
        alone = np.ones(len(X), dtype=bool)
        for window in windows:
            rows, times_s = window.rows, window.graph.times_s
            alone[rows] = not window.graph.temporal
            association[rows] = lasting_mean(association[rows], times_s, count[rows] > 0)
            for clue in (of_body, draft, exchange):
                clue[rows] = lasting_mean(clue[rows], times_s)
        clues = Clues(observations.frame, X, count, covariance, of_body, association, draft, exchange)
        return np.where(
            alone[:, None, None, None],
            covariance + self._calibration.association * association,
            self._calibration.covariance(clues),
        )

    def _limbs_kept(
        self,
        X: NDArray[np.float64],
        covariance: NDArray[np.float64],
        windows: Sequence[Window],
        solution: Solution,
    ) -> NDArray[np.float64]:
        """Joints that no view saw, in windows of several frames, where a body can have them, and limbs as long as
        the body's where views leave an end open.

        Not those with factors of the user's own. Steps are averaged over time: bodies are fitted frame by frame.
        """
        unseen = ~np.asarray(solution.inlier.any(axis=-1))
        for window in windows:
            unseen[window.rows] &= window.graph.temporal & ~window.graph.touched
        steps = limb_steps(X, covariance, unseen, self.fitter)
        weak, placed = weakest_sigma(solution.views.information) > SEEN_M, X.copy()
        for window in windows:
            rows = window.rows
            if not window.graph.temporal:
                continue
            moved = near_in_time(weak[rows], window.graph.times_s, STEP_S) & ~window.graph.touched
            lengths = limb_lengths(solution.fit.joints[rows], self._limbs)
            stepped = smoothed_in_time(steps[rows], window.graph.times_s, STEP_S)
            into = np.minimum(waited_s(~unseen[rows], window.graph.times_s) / STEP_S, 1.0)
            stepped = X[rows] + into[..., None] * stepped
            placed[rows] = with_lengths(stepped, covariance[rows], moved, lengths, self._limbs)
        return placed


STEP_S = 0.1
"""Time over which what a body changes of unseen joints is averaged, seconds, one sigma."""


def window_rows(observations: Observations) -> list[NDArray[np.intp]]:
    """Rows of each window, frames rising: those of one track.

    ValueError where a person is twice in a frame.
    """
    order = np.lexsort((observations.frame, observations.track))
    track, frame = observations.track[order], observations.frame[order]
    if np.any((np.diff(track) == 0) & (np.diff(frame) == 0)):
        raise ValueError("a track may have one row a frame: tell people apart by their track")
    return np.split(order, np.flatnonzero(np.diff(track)) + 1) if len(order) else []


def _cameras(views: Views, row: int = 0) -> tuple[gtsam.PinholeCameraCal3_S2, ...]:
    """GTSAM's cameras of a row."""
    K, cTw = (array[row] if array.ndim == 4 else array for array in (views.K, views.cTw))
    wTc = np.linalg.inv(np.concatenate([cTw, np.tile([[[0.0, 0.0, 0.0, 1.0]]], (len(cTw), 1, 1))], axis=1))
    return tuple(map(make_camera, K, wTc))
