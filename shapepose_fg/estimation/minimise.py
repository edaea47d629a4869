"""Minimises a factor graph by GTSAM: one Gauss-Newton step if that suffices, else
Levenberg-Marquardt.
"""

import re

import gtsam

from shapepose_fg.estimation.estimator_config import WindowGraphConfig


class NotFinite(RuntimeError):
    """The solution is not finite."""


def confirmed(
    graph: gtsam.NonlinearFactorGraph,
    values: gtsam.Values,
    ordering: gtsam.Ordering,
    config: WindowGraphConfig,
) -> gtsam.Values | None:
    """The values after a Gauss-Newton step if the error decreases by at most the tolerance; else
    None.
    """
    linear = graph.linearize(values)
    try:
        solved = linear.eliminateSequential(ordering)
        step = solved.optimize()
    except RuntimeError:  # an undetermined joint; damping solves the others
        return None
    nowhere = gtsam.VectorValues.Zero(step)
    # After elimination the error is zero at the step, so that the error without it is the decrease.
    settled = solved.error(nowhere) <= config.tolerance * linear.error(nowhere)
    return values.retract(step) if settled else None


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
