"""A factor graph minimised by GTSAM: one Gauss-Newton step where that is enough, else Levenberg-Marquardt."""

import re

import gtsam

from shapepose_fg.estimation.estimator_config import WindowGraphConfig


class NotFinite(RuntimeError):
    """The solver left the finite numbers."""


def confirmed(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, ordering: gtsam.Ordering, config: WindowGraphConfig
) -> gtsam.Values | None:
    """The values after a Gauss-Newton step, where the error falls by no more than the tolerance; else None."""
    linear = graph.linearize(values)
    try:
        solved = linear.eliminateSequential(ordering)
        step = solved.optimize()
    except RuntimeError:  # a joint is not determined: damped, the others are solved all the same
        return None
    nowhere = gtsam.VectorValues.Zero(step)
    # What is eliminated has no error left at the step: what it has without is what the step takes away.
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
    """The minimum from `values` on, by Levenberg-Marquardt; without an `ordering` GTSAM finds one.

    RuntimeError where the system is singular, or leaves the finite numbers.
    """
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(config.max_iterations)
    # Of hundreds of joints that hardly move any more, a few thousandths of a sigma.
    parameters.setRelativeErrorTol(config.tolerance * (10.0 if over_time else 1.0))
    if ordering is not None:
        parameters.setOrdering(ordering)
    optimizer = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters)
    found = optimizer.optimize()
    if not float(optimizer.error()) < float("inf"):
        raise NotFinite("the solver diverged to values that are not finite")
    return found


def undetermined_key(error: RuntimeError) -> int | None:
    """The variable near which GTSAM found a system without a solution; None where the error is another."""
    found = re.search(r"[Ii]ndeterminate? linear system.*?variable\s+(\d+)", str(error), re.DOTALL)
    return None if found is None else int(found[1])
