"""Classes in which errors are told: states and groups of joints, quantiles, confidences, lags."""

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.simulation.measurement.sample_tables import MIRROR

SEEN, HIDDEN = 0.7, 0.3
"""A joint is visible when more than this share of it is seen, hidden when less than that."""
LEVELS = np.array([0.0, 0.02, 0.05, 0.1, 0.25, 0.5, 0.75, 0.9, 0.95, 0.98, 1.0])
"""Where distributions are told by their quantiles."""
KNOTS = np.array([0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9])
"""Confidences at which errors are told."""
LAGS = np.array([1, 2, 3, 4, 5, 6, 8, 10, 15, 20, 30, 40])
"""Frames over which memories are fitted."""
LONGEST_S = 6.0
"""Of what lasts longer, a recording of 12 seconds tells nothing."""
PRIOR = 20
"""All joints together count as this many cases of each of them."""
GROUPS = tuple(j for j in range(25) if j <= MIRROR[j])
"""The first of each joint and its mirror: 14."""
GROUP = np.array([GROUPS.index(min(j, int(MIRROR[j]))) for j in range(25)])
"""(25,) the group of each joint."""


def joint_states(expected: dict[str, NDArray]) -> NDArray[np.intp]:
    """(M,) 0 visible, 1 hidden by itself, 2 hidden by another, -1 in between."""
    hidden = np.where(expected["hidden_by"] >= 0, 2, 1)
    return np.where(expected["seen"] > SEEN, 0, np.where(expected["seen"] < HIDDEN, hidden, -1))


def rounded(values: NDArray, digits: int = 3) -> list:
    """Nested lists of numbers for JSON."""
    return np.round(values, digits).tolist()
