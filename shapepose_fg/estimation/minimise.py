"""Minimises a factor graph by GTSAM."""

import re

import gtsam

from shapepose_fg.estimation.estimator_config import WindowGraphConfig


class NotFinite(RuntimeError):
    """The solution is not finite."""


def descend(
    graph: gtsam.NonlinearFactorGraph,
    values: gtsam.Values,
    ordering: gtsam.Ordering | None,
    config: WindowGraphConfig,
    *,
    over_time: bool,
) -> gtsam.Values:
    """The minimum by Levenberg-Marquardt, starting at `values`; without an `ordering` GTSAM finds
    one.

    Raises RuntimeError if the system is singular, NotFinite if the error is not finite.
    """
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(config.max_iterations)
    # With hundreds of joints this tolerance is a few thousandths of a sigma.
    parameters.setRelativeErrorTol(config.tolerance * (10.0 if over_time else 1.0))
    if ordering is not None:
        parameters.setOrdering(ordering)
    optimizer = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters)
    found = optimizer.optimize()
    if not float(optimizer.error()) < float("inf"):
        raise NotFinite("the solver diverged to values that are not finite")
    return found


def undetermined_key(error: RuntimeError) -> int | None:
    """The variable near which GTSAM found an indeterminate system; None for other errors."""
    found = re.search(r"[Ii]ndeterminate? linear system.*?variable\s+(\d+)", str(error), re.DOTALL)
    return None if found is None else int(found[1])
