"""Short names for the arrays of NumPy that most signatures speak of; shapes stand in the docstrings."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
"""Real numbers."""
Index = NDArray[np.intp]
"""Places in other arrays."""
Mask = NDArray[np.bool_]
"""Which entries are meant."""
Real = NDArray[np.floating]
"""Real numbers of any precision."""
Whole = NDArray[np.integer]
"""Whole numbers of any size."""
