"""Covariances of all joints of solved windows at once: each joint is a chain of states, and chains go together.

GTSAM's `Marginals` gives the same numbers for any graph, one variable a call, at four times the cost. It is asked
for frames that stand alone, and where a factor of the user's own ties joints, or frames that do not follow each
other.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from shapepose_fg.core.arrays import Array
from shapepose_fg.estimation.window_graph import WindowGraph

UNDETERMINED_M = 10.0
"""A variable that the problem leaves less certain than this in some direction, metres or m/s, is not
determined."""


@dataclass(frozen=True)
class Chains:
    """The information of C chains of T states with n numbers each; the states of a chain hang on their neighbours
    only.
    """

    diagonal: Array
    """(C, T, n, n) of each state with itself."""
    below: Array
    """(C, T - 1, n, n) of each state, rows, with the one before it, columns."""

    def covariances(self) -> Array:
        """(C, T, n, n) marginal covariance of each state; NaN in all states of a chain that is not determined.

        The blocks on the diagonal of the inverse: block Cholesky down the chains, and back, for all together.
        """
        try:
            return self._blocks_of_inverse()
        except np.linalg.LinAlgError:
            if len(self.diagonal) == 1:
                return np.full_like(self.diagonal, np.nan)
        # NumPy does not say which one failed.
        single = (Chains(self.diagonal[n : n + 1], self.below[n : n + 1]) for n in range(len(self.diagonal)))
        return np.concatenate([chain.covariances() for chain in single])

    def _blocks_of_inverse(self) -> Array:
        steps = self.diagonal.shape[1]
        inverse, gain = np.empty_like(self.diagonal), np.empty_like(self.below)
        for t in range(steps):
            pivot = self.diagonal[:, t]
            if t > 0:
                gain[:, t - 1] = inverse[:, t - 1] @ self.below[:, t - 1].swapaxes(1, 2)
                pivot = pivot - self.below[:, t - 1] @ gain[:, t - 1]
            root = np.linalg.inv(np.linalg.cholesky((pivot + pivot.swapaxes(1, 2)) / 2))
            inverse[:, t] = root.swapaxes(1, 2) @ root
        for t in range(steps - 2, -1, -1):
            inverse[:, t] += gain[:, t] @ inverse[:, t + 1] @ gain[:, t].swapaxes(1, 2)
        return inverse


def state_covariances(graphs: Sequence[WindowGraph]) -> list[tuple[Array, Array]]:
    """For each solved graph of T frames the covariances (T, J, 3, 3) of positions, m², and of velocities, m²/s².

    NaN where a variable is not in the problem, and where the problem leaves it undetermined (`UNDETERMINED_M`):
    singular systems raise no error.
    """
    result: list[tuple[Array, Array] | None] = [None] * len(graphs)
    alike: dict[tuple[int, int], list[tuple[int, Chains]]] = {}
    for n, graph in enumerate(graphs):
        chains = _chains(graph) if graph.temporal and not graph.failure else None
        if chains is not None:
            alike.setdefault(chains.diagonal.shape[1::2], []).append((n, chains))
    for members in alike.values():
        together = Chains(
            np.concatenate([chains.diagonal for _, chains in members]),
            np.concatenate([chains.below for _, chains in members]),
        )
        found = np.split(together.covariances(), len(members))
        for (n, _), covariance in zip(members, found, strict=True):
            of_states = np.where(graphs[n].present[..., None, None], covariance.swapaxes(0, 1), np.nan)
            result[n] = _determined(of_states[..., :3, :3]), _determined(of_states[..., 3:6, 3:6])
    return [
        (_by_gtsam(graph, graph.keys), _by_gtsam(graph, graph.velocity_keys)) if each is None else each
        for graph, each in zip(graphs, result, strict=True)
    ]


def _by_gtsam(graph: WindowGraph, keys: NDArray[np.int64]) -> Array:
    """Marginal covariance (T, J, 3, 3) of `keys` (T, J), one variable after the other, of whatever graph."""
    result = np.full((*keys.shape, 3, 3), np.nan)
    inside = [(place, int(key)) for place, key in np.ndenumerate(keys) if graph.values.exists(int(key))]
    for damped in (False, True) if len(inside) > 0 and not graph.failure else ():
        try:
            found = gtsam.Marginals(_damped(graph) if damped else graph.graph, graph.values)
            for place, key in inside:
                result[place] = found.marginalCovariance(key)
            break
        except RuntimeError:
            result[:] = np.nan
    return _determined(result)


def _damped(graph: WindowGraph) -> gtsam.NonlinearFactorGraph:
    """The problem with a prior of 100 m on all variables: what is then wider than 10 m is not determined."""
    damped = gtsam.NonlinearFactorGraph(graph.graph)
    wide = gtsam.noiseModel.Isotropic.Sigma(3, 100.0)
    for key in graph.values.keys():  # noqa: SIM118 - GTSAM's, not a dictionary's
        damped.push_back(gtsam.PriorFactorPoint3(key, graph.values.atPoint3(key), wide))
    return damped


def _determined(covariance: Array) -> Array:
    """The same (..., 3, 3), NaN where it is more than `UNDETERMINED_M` in some direction."""
    known = np.asarray(np.isfinite(covariance).all(axis=(-2, -1)))
    largest = np.linalg.eigvalsh(np.where(known[..., None, None], covariance, 0.0))[..., -1]
    return np.where((known & (largest < UNDETERMINED_M**2))[..., None, None], covariance, np.nan)


def _chains(graph: WindowGraph) -> Chains | None:
    """The linearised problem of a graph, joint by joint; None where it is more than a chain of each joint."""
    states = graph.states
    T, J, S = states.shape
    present = np.array([graph.values.exists(key) for key in states.ravel().tolist()], dtype=bool).reshape(T, J, S)
    if not present.any():
        return None
    used = np.flatnonzero(present.any(axis=(0, 1)))
    states, present = states[..., used], present[..., used]
    n = 3 * len(used)
    # GTSAM's columns: variables in the order of their keys, three numbers each, and the right-hand side.
    order = np.argsort(states[present])
    frame, joint, part = (index[order] for index in np.nonzero(present))
    row, column, value = graph.graph.linearize(graph.values).sparseJacobian_()
    inside = column <= 3 * len(order)
    shape = (int(row.max()), 3 * len(order))
    A = scipy.sparse.csr_array((value[inside], (row[inside] - 1, column[inside] - 1)), shape=shape)
    H = (A.T @ A).tocoo()
    (first, at), (second, other) = (np.divmod(index, 3) for index in H.coords)
    step = frame[first] - frame[second]
    if np.any(joint[first] != joint[second]) or np.any(np.abs(step) > 1):
        return None
    at, other = at + 3 * part[first], other + 3 * part[second]
    diagonal, below = np.zeros((J, T, n, n)), np.zeros((J, T - 1, n, n))
    here, after = step == 0, step == 1
    diagonal[joint[first[here]], frame[first[here]], at[here], other[here]] = H.data[here]
    below[joint[first[after]], frame[second[after]], at[after], other[after]] = H.data[after]
    absent = np.repeat(~present, 3, axis=2).swapaxes(0, 1)
    diagonal[absent[..., None] & np.eye(n, dtype=bool)] = 1.0
    return Chains(diagonal, below)
