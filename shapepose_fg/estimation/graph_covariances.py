"""All marginal covariances of a graph at once, of which `gtsam.Marginals` gives one per call."""

import gtsam
import numpy as np

from shapepose_fg.core.arrays import Array


def graph_covariances(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, ordering: gtsam.Ordering
) -> dict[tuple[int, int], Array]:
    """Covariance of each variable, (key, key), and of each pair that elimination in this order
    connects, such as a body with the joints of its frame and with the next body.

    They are those of the linearised graph, computed backwards over its Bayes net. Raises
    RuntimeError if the system is singular.
    """
    net = graph.linearize(values).eliminateSequential(ordering)
    found, last, after = dict[tuple[int, int], Array](), list[int](), np.empty((0, 0))
    for n in range(net.size() - 1, -1, -1):
        conditional = net.at(n)
        key, *others = conditional.keys()
        R = np.asarray(conditional.R())
        inverse = np.linalg.inv(R)
        own = inverse @ inverse.T
        if others:
            if others != last:
                after = np.block([[found[a, b] for b in others] for a in others])
                last = others
            gain = inverse @ conditional.S()
            across = -gain @ after
            own -= across @ gain.T
            ends = np.cumsum([len(found[each, each]) for each in others])[:-1]
            for other, part in zip(others, np.split(across, ends, axis=1), strict=True):
                found[key, other], found[other, key] = part, part.T
        found[key, key] = (own + own.T) / 2
    return found
