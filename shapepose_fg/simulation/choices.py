"""Choices that are independent of the processor's rounding."""

import numpy as np
from numpy.typing import ArrayLike

from shapepose_fg.core.arrays import Array

_DECIMALS = 9


def comparable(values: ArrayLike) -> Array:
    """Values rounded for comparisons: those that differ by a processor's rounding only become equal.

    Periodic or symmetrical motions give many such values. Of equal ones the first is chosen.
    """
    return np.round(np.asarray(values, dtype=np.float64), _DECIMALS)
