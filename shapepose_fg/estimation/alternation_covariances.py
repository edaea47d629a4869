"""Covariances of the joints of solved single frames, by GTSAM."""

from collections.abc import Sequence

import gtsam
import numpy as np

from shapepose_fg.core.arrays import Array
from shapepose_fg.estimation.frame_graph import WindowGraph

UNDETERMINED_M = 10.0
"""Standard deviation, metres, above which a joint is undetermined, in its worst direction; also
that of weak priors on joints, since one behind its cameras would make a system singular."""


def state_covariances(graphs: Sequence[WindowGraph]) -> list[Array]:
    """For each solved graph, covariances (1, J, 3, 3) of positions, m².

    NaN for joints not in the problem, and for undetermined ones (`UNDETERMINED_M`): singular
    systems raise no error.
    """
    known = dict[int, gtsam.Marginals]()
    return [_of_graph(graph, known) for graph in graphs]


def _of_graph(graph: WindowGraph, known: dict[int, gtsam.Marginals]) -> Array:
    """Marginals of one person; coupled people share one graph, which is factorised once: `known` is
    the cache.
    """
    found = np.full((*graph.keys.shape, 3, 3), np.nan)
    keys = graph.keys[graph.present].tolist()
    if graph.failure or len(keys) == 0:
        return found
    for make in (lambda: graph.graph, lambda: _damped(graph)):
        try:
            marginals = known.get(id(graph.ties)) or gtsam.Marginals(make(), graph.values)
            of_keys = [marginals.marginalCovariance(key) for key in keys]
        except RuntimeError:
            known.pop(id(graph.ties), None)
            continue
        known[id(graph.ties)] = marginals
        found[graph.present] = of_keys
        return determined(found)
    return found


def _damped(graph: WindowGraph) -> gtsam.NonlinearFactorGraph:
    """The problem with a prior of 100 m on all variables; results wider than 10 m are then
    undetermined.
    """
    damped = gtsam.NonlinearFactorGraph(graph.graph)
    wide = gtsam.noiseModel.Isotropic.Sigma(3, 100.0)
    for key in (key for person in graph.ties.people for key in person.keys.ravel().tolist()):
        if graph.values.exists(key):
            damped.push_back(gtsam.PriorFactorPoint3(key, graph.values.atPoint3(key), wide))
    return damped


def determined(covariance: Array) -> Array:
    """Return covariances (..., 3, 3), with NaN for those above `UNDETERMINED_M` in some
    direction.
    """
    largest = np.trace(covariance, axis1=-2, axis2=-1)  # upper bound
    doubtful = np.isfinite(largest) & (largest >= UNDETERMINED_M**2)
    largest[doubtful] = np.linalg.eigvalsh(covariance[doubtful])[..., -1]
    return np.where((largest < UNDETERMINED_M**2)[..., None, None], covariance, np.nan)
