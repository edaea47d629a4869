"""Covariances of all joints of solved windows: each joint is a chain of states, processed by one
compiled pass.

GTSAM's `Marginals` gives the same values for any graph, one variable per call. It is used for
single frames, and for joints with user factors.
"""

from collections.abc import Sequence

import gtsam
import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.arrays import Array
from shapepose_fg.estimation.joint_chains import determined
from shapepose_fg.estimation.window_graph import WindowGraph


def state_covariances(graphs: Sequence[WindowGraph]) -> list[tuple[Array, Array]]:
    """For each solved graph of T frames, covariances (T, J, 3, 3) of positions, m², and of
    velocities, m²/s².

    NaN for variables not in the problem, and for undetermined ones (`joint_chains.UNDETERMINED_M`):
    singular systems raise no error.
    """
    asked = dict[int, gtsam.Marginals]()
    return [_of_graph(graph, asked) for graph in graphs]


def _of_graph(graph: WindowGraph, known: dict[int, gtsam.Marginals]) -> tuple[Array, Array]:
    of_positions, of_velocities = (np.full((*graph.keys.shape, 3, 3), np.nan) for _ in range(2))
    if graph.failure:
        return of_positions, of_velocities
    asked = graph.present & (graph.touched | (not graph.temporal))
    points = graph.positions
    for chains in graph.chains:
        of_positions[:, chains.joints], of_velocities[:, chains.joints] = chains.covariances(points)
    if asked.any():
        asked_of = [graph.keys[asked]] + ([graph.velocity_keys[asked]] if graph.temporal else [])
        for into, found in zip(
            (of_positions, of_velocities), _by_gtsam(graph, np.stack(asked_of), known), strict=False
        ):
            into[asked] = found
    return of_positions, of_velocities


def _by_gtsam(
    graph: WindowGraph, keys: NDArray[np.int64], known: dict[int, gtsam.Marginals]
) -> Array:
    """Marginal covariances (K, D, 3, 3) of `keys` (K, D), one variable at a time, for any graph.

    Coupled people share one graph, which is factorised once: `known` is the cache.
    """
    for make in (lambda: graph.graph, lambda: _damped(graph)):
        try:
            marginals = known.get(id(graph.ties)) or gtsam.Marginals(make(), graph.values)
            found = np.array(
                [[marginals.marginalCovariance(key) for key in row] for row in keys.tolist()]
            )
        except RuntimeError:
            known.pop(id(graph.ties), None)
            continue
        known[id(graph.ties)] = marginals
        return determined(found)
    return np.full((*keys.shape, 3, 3), np.nan)


def _damped(graph: WindowGraph) -> gtsam.NonlinearFactorGraph:
    """The problem with a prior of 100 m on all variables; results wider than 10 m are then
    undetermined.
    """
    damped = gtsam.NonlinearFactorGraph(graph.graph)
    wide = gtsam.noiseModel.Isotropic.Sigma(3, 100.0)
    for key in (key for person in graph.ties.people for key in person.states.ravel().tolist()):
        if graph.values.exists(key):
            damped.push_back(gtsam.PriorFactorPoint3(key, graph.values.atPoint3(key), wide))
    return damped
