"""Stage II on one page: joints, bodies and graphs from a window of frames with assigned
detections.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass

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
from shapepose_fg.estimation.motion_densities import MotionModel
from shapepose_fg.estimation.smoothing import smoothed
from shapepose_fg.estimation.user_factors import ExtraFactors, functions_of
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
    With the paper's `EstimatorConfig`, or a fitter without a body model, each row is solved by
    Algorithm 1 (`estimation/alternation.py`).
    `views` are the cameras, by row if they move. `extra_factors`, one function or several, add
    factors of your own to every window. Without `assigning` detections keep their people.
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

    functions = functions_of(extra_factors)
    if config.refine.with_body and fitter.model is not None:
        solution = solve_bodies(observations, views, fitter, config, motion, functions)
    else:
        solution = alternate(observations, views, fitter, config, functions)
    solution.seconds.update(
        {"associate again": assigned - began, "solve": time.perf_counter() - assigned}
    )
    return solution
