"""Stage II on one page: joints, bodies and graphs from a window of frames with assigned
detections.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import compress

import numpy as np

from shapepose_fg.body.fitting.fitter import BodyFitter
from shapepose_fg.core.camera import Views
from shapepose_fg.core.detections import Input
from shapepose_fg.core.observations import Observations, rows_in
from shapepose_fg.core.skeleton import Skeleton
from shapepose_fg.estimation.alternation import alternate
from shapepose_fg.estimation.asynchronous_views import widened
from shapepose_fg.estimation.body_solution import solve_bodies
from shapepose_fg.estimation.draft import Draft, draft
from shapepose_fg.estimation.estimator_config import EstimatorConfig
from shapepose_fg.estimation.in_time import near_in_time
from shapepose_fg.estimation.motion_densities import MotionModel
from shapepose_fg.estimation.smoothing import smoothed
from shapepose_fg.estimation.user_factors import ExtraFactors, functions_of
from shapepose_fg.estimation.window_solution import WindowSolution
from shapepose_fg.tracking.reassociation import LEAST_PROBABILITY, changed, reassociate

_SETTLED = 0.002
"""Share of changed detections below which reassociation ends: in crowds after three or four rounds
with six cameras, after eight or more with three."""
_CHANGED_S, _SMOOTHED_S = 0.2, 0.5
"""Time around a changed detection, s: within the first one, others may change in the next round;
within the second one, joints are estimated again."""


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
    With the paper's `EstimatorConfig`, or a fitter without a body model, each row is solved by
    Algorithm 1 (`estimation/alternation.py`).

    `views` are the cameras, by row if they move. `extra_factors`, one function or several, add
    factors of your own to every window. Without `assigning`, detections are not reassigned.
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

    drafted: Draft | None = None
    if assigning is not None and len(observations) > 0:
        observations, views, drafted = _assigned(
            observations, views, fitter, config, assigning, motion
        )
    assigned = time.perf_counter()

    functions = functions_of(extra_factors)
    if not config.refine.with_body:
        X = observations.initial
        solution = alternate(observations, X, views, fitter, config, functions)
    else:
        first = draft(observations, views, fitter, config, drafted)
        if fitter.model is None:
            solution = alternate(observations, first.start, views, fitter, config, functions)
        else:
            solution = solve_bodies(first, views, fitter.model, config, motion, functions)
    solution.seconds.update(
        {"associate again": assigned - began, "solve": time.perf_counter() - assigned}
    )
    return solution


def _assigned(
    observations: Observations,
    views: Views,
    fitter: BodyFitter,
    config: EstimatorConfig,
    assigning: Assigning,
    motion: MotionModel,
) -> tuple[Observations, Views, Draft | None]:
    """The rows with the detections near people's initial joints and bodies, iterated; their views;
    and the last initial estimates.

    Over time, a further round is for frames near those in which a detection changed.
    """
    drafted: Draft | None = None
    frames = assigning.frames
    frame_s = np.array([each.time_s.mean() for each in frames])
    to_assign = np.ones(len(frames), dtype=bool)
    for n in range(assigning.rounds):
        around = near_in_time(to_assign[:, None], frame_s, _SMOOTHED_S)[:, 0]
        changed_frames = [each.frame for each in compress(frames, around)]
        near = np.flatnonzero(np.isin(observations.frame, changed_frames))
        before, seen_by = observations.rows(near), views.rows(near)
        found = draft(before, seen_by, fitter, config, drafted)
        drafted = found if drafted is None else drafted.updated(found)
        places, covariance = found.places, found.covariance
        least = n / max(assigning.rounds - 1, 1) * LEAST_PROBABILITY
        if assigning.over_time:
            times_s, least = before.time_s.mean(axis=1), None
            places, covariance = smoothed(places, covariance, before.track, times_s, motion)
            covariance = widened(covariance, before, places, seen_by)
        again = list(compress(frames, to_assign))
        now = reassociate(again, before, places, covariance, assigning.skeleton, least)
        kept = observations.rows(~np.isin(observations.frame, [each.frame for each in again]))
        new = Observations.concatenate([kept, now])
        new = new.rows(np.argsort(new.frame, kind="stable"))
        views = views if views.rows_known is None else views.rows(rows_in(observations, new))
        observations = new
        if assigning.over_time:
            other = changed(before.rows(rows_in(before, now)), now)
            if other.sum() <= _SETTLED * new.seen.sum():
                break
            marked = np.isin([each.frame for each in frames], now.frame[other.any(axis=(1, 2))])
            to_assign = near_in_time(marked[:, None], frame_s, _CHANGED_S)[:, 0]
    return observations, views, drafted
