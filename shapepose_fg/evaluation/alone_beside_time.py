"""Real footage without truth: what each frame alone says beside what it says together with its neighbours.

Time brings evidence that a frame alone does not have, so that a joint which both put at the same place is mostly
right, and one that they do not is mostly wrong in the frame alone. A simulator flatters a method whose priors are
those of the simulated people; this does not.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from shapepose_fg.core.reconstruction import Known, Reconstruction

APART_M = 0.15
"""A joint this far away is elsewhere: a hand's length, or rho_2D."""
SAME_M = 0.5
"""Two rows whose joints are farther apart in the mean are not one person."""


@dataclass(frozen=True)
class Beside:
    """Frames alone beside the same frames over time."""

    apart: NDArray[np.intp]
    """(J,) joints seen over time that the frame alone has more than `APART_M` away, or not at all."""
    seen: NDArray[np.intp]
    """(J,) joints seen over time, of people whom the frame alone has, too."""
    missing: int
    """People of a frame whom it alone does not have."""

    @property
    def share(self) -> float:
        """`apart` of `seen`, all joints together."""
        return float(self.apart.sum() / max(self.seen.sum(), 1))


def beside(alone: Reconstruction, timed: Reconstruction) -> Beside:
    """Compare two results of the same frames; rows are matched frame by frame, one-to-one, by all their joints."""
    J = timed.joints.shape[1]
    apart, seen, missing = np.zeros(J, dtype=np.intp), np.zeros(J, dtype=np.intp), 0
    for frame in np.unique(timed.frame).tolist():
        theirs, rows = np.flatnonzero(alone.frame == frame), np.flatnonzero(timed.frame == frame)
        distance = np.linalg.norm(timed.joints[rows, None] - alone.joints[None, theirs], axis=-1)
        there = np.isfinite(distance)
        mean = np.where(there, distance, 0.0).sum(axis=-1) / np.maximum(there.sum(axis=-1), 1)
        mean = np.where(there.any(axis=-1), mean, np.inf)
        mine, other = linear_sum_assignment(np.minimum(mean, 1e3))
        same = mean[mine, other] < SAME_M
        mine, other = mine[same], other[same]
        missing += len(rows) - len(mine)
        known = Known.observed(timed.known[rows[mine]])
        elsewhere = ~(distance[mine, other] <= APART_M)
        apart += (known & elsewhere).sum(axis=0)
        seen += known.sum(axis=0)
    return Beside(apart, seen, missing)
