"""Choices that do not depend on the processor's rounding."""

import numpy as np
from numpy.typing import ArrayLike

from shapepose_fg.core.arrays import Array


def comparable(values: ArrayLike) -> Array:
    """Values rounded for comparisons, so that those that differ only by rounding become equal.

    Periodic or symmetric motions give many ties, of which the first is then chosen.
    """
    return np.round(np.asarray(values, dtype=np.float64), 9)
