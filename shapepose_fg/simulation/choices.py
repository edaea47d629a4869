"""Choices that are the same on every processor."""

import numpy as np
from numpy.typing import ArrayLike

from shapepose_fg.core.arrays import Array

_DECIMALS = 9


def comparable(values: ArrayLike) -> Array:
    """Values for comparisons, rounded: those that would be equal but for a processor's rounding are.

    Motions that repeat themselves or are symmetrical give many such values. Of equals the first is chosen.
    """
    return np.round(np.asarray(values, dtype=np.float64), _DECIMALS)
