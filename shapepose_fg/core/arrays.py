"""Short names of array types (shapes are given in docstrings), and keys of pairs of integers."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
"""Real numbers."""
Index = NDArray[np.intp]
"""Indices into other arrays."""
Mask = NDArray[np.bool_]
"""Boolean arrays."""
Real = NDArray[np.floating]
"""Real numbers of any precision."""
Whole = NDArray[np.integer]
"""Integers of any size."""


def pair_keys(*tables: tuple[Whole, Whole]) -> list[Whole]:
    """Keys (N,) of pairs of non-negative integers (N,) and (N,), one array for each of the tables:
    equal pairs of any tables have the same key, and keys ascend by the first integer, then the
    second.
    """
    size = 1 + max(int(second.max(initial=0)) for _, second in tables)
    return [first.astype(np.int64) * size + second for first, second in tables]
