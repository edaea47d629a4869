"""What came of a solved window: errors that last, how each joint is known, and what went wrong."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.observations import Observations
from shapepose_fg.core.reconstruction import Known
from shapepose_fg.estimation.alternation import Solution, Window
from shapepose_fg.estimation.in_time import carried
from shapepose_fg.estimation.linearisation import weakest_sigma
from shapepose_fg.estimation.motion_model import Lasting

RUNAWAY_M = 1.0
"""A joint with a factor of the user's own that ends this far from where its views first put it has run away."""
RUNAWAY_SIGMA = 20.0
"""So has one that ends this many standard deviations, and half a metre, from what views and body say of it."""
_HALF_M = 0.5
WEAK_SCORE = 0.3
"""Detections of a lower score are weak: in simulated crowds one in 18 is not the person's, of others one in 60."""
WEAK_PROBABILITY = 0.5
"""So are those that are as probably somebody else's."""
SEEN_M = 0.1
"""A joint is seen in a frame whose views leave it no less certain than this in any direction, metres."""


@dataclass(frozen=True)
class Problem:
    """What went wrong with one joint of one person in one frame."""

    row: int
    """Row of the estimates."""
    track: int
    """Who."""
    frame: int
    """When."""
    joint: int
    """Which joint, an index into the skeleton."""
    reason: str
    """What happened, in words."""


def reported_covariance(
    solution: Solution, window: Window, marginal: NDArray[np.float64], views: Lasting
) -> NDArray[np.float64]:
    """(T, J, 3, 3) covariance of the joints, m²: `marginal` of the graph, and the errors that the graph left out.

    The graph of several frames holds only the share of the errors that is new in every frame. Added is the share
    that lasts, of what views and body leave in one frame, C_t; and of the share that motion smooths, that part
    which it does not take away in truth, because errors fade over a few frames and not from one to the next
    (`Lasting.kept`). Where a joint is not seen, what was left in the nearest frame in which it was is carried
    along; a view that still sees it brings its own lasting error in, through the gain that it has. Joints solved
    with offsets have it all in `marginal`.
    """
    said = solution.views.information[window.rows]
    information = said + solution.body.information[window.rows]
    simple = np.broadcast_to(~window.graph.with_offsets, said.shape[:2])
    seen = (weakest_sigma(said) <= SEEN_M) & simple
    f, kept = views.white_share, views.kept
    left = np.zeros(information.shape)
    left[seen] = np.linalg.inv(information[seen])
    left = carried(left, seen, window.graph.times_s)
    own = (1 - f) / f**2 * marginal @ said @ marginal
    total = np.where(seen[..., None, None], (1 - kept) * marginal, marginal + own) + (1 - f + kept * f) * left
    return np.where(simple[..., None, None], total, marginal)


def strong(solution: Solution, observations: Observations) -> NDArray[np.bool_]:
    """(N, J, V) the observations that are used and not weak."""
    sure = (observations.confidence >= WEAK_SCORE) & (observations.probability > WEAK_PROBABILITY)
    return solution.inlier & sure


def how_known(
    solution: Solution, observations: Observations, covariance: NDArray[np.float64]
) -> NDArray[np.uint8]:
    """(N, J) a `Known` for each joint, `covariance` (N, J, 3, 3) being its own.

    It is seen where two views' detections are used that are not weak. A joint that no view saw is carried by
    motion where it is known much better (half the variance) than the body knows it.
    """
    pulled = solution.body.known
    information = np.where(pulled[..., None, None], solution.body.information, np.eye(3))
    said = np.trace(np.linalg.inv(information), axis1=2, axis2=3)
    moved = ~pulled | (np.trace(covariance, axis1=2, axis2=3) < 0.5 * said)
    code = np.where(moved, Known.MOTION, Known.BODY)
    code = np.where(solution.inlier.any(axis=-1), Known.WEAK, code)
    code = np.where(strong(solution, observations).sum(axis=-1) >= 2, Known.SEEN, code)
    return np.where(np.isfinite(solution.joints).all(axis=-1), code, Known.UNKNOWN).astype(np.uint8)


def problems(
    observations: Observations,
    windows: Sequence[Window],
    solution: Solution,
    first: NDArray[np.float64],
    covariance: NDArray[np.float64],
) -> tuple[Problem, ...]:
    """Joints that could not be solved, by person, frame and joint; `first` (N, J, 3) is where views first put
    them.
    """
    X = solution.joints
    finite = np.asarray(np.isfinite(X).all(axis=2))
    reasons = np.full(finite.shape, "", dtype=object)
    information = solution.views.information + solution.body.information
    pulls = _pull(solution.views, X) + _pull(solution.body, X)
    known = finite & (weakest_sigma(information) < np.inf)
    away = np.zeros(X.shape)
    away[known] = np.linalg.solve(information[known], pulls[known][..., None])[..., 0]
    sigmas = np.sqrt(np.maximum(np.einsum("...i,...i->...", away, pulls), 0.0))
    far = np.linalg.norm(away, axis=2)
    reasons[known & (far > _HALF_M) & (sigmas > RUNAWAY_SIGMA)] = "ran away from what views and body say of it"
    for window in windows:
        graph, rows = window.graph, window.rows
        touched = np.ix_(rows, np.flatnonzero(graph.touched))
        with np.errstate(invalid="ignore"):
            ran = np.linalg.norm(X[touched] - first[touched], axis=2) > RUNAWAY_M
        reasons[touched] = np.where(ran, "ran away from its views", reasons[touched])
        if graph.failure:
            reasons[rows] = np.where(finite[rows], graph.failure, reasons[rows])
    lost = finite & ~np.isfinite(covariance).all(axis=(2, 3)) & (reasons == "")
    reasons[lost] = "nothing determines it: its system is singular"
    return tuple(
        Problem(int(n), int(observations.track[n]), int(observations.frame[n]), int(j), str(reasons[n, j]))
        for n, j in np.argwhere(reasons != "")
    )


def _pull(message, X: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N, J, 3) information times the way from `X` to where the message has the joint, 1/m."""
    return np.einsum("...ij,...j->...i", message.information, np.nan_to_num(message.xyz) - np.nan_to_num(X))
