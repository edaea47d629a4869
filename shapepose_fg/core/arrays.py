"""Short names of array types; shapes are given in docstrings."""

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
