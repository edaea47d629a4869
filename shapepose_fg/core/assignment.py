"""One-to-one pairs of least total cost."""

import numpy as np

from shapepose_fg.core.arrays import Array, Index


def least_cost_pairs(cost: Array) -> tuple[Index, Index]:
    """Rows, rising, and columns of the pairs, each row or column once, whose costs (R, C) have the least sum.

    As many pairs as can be. ValueError where costs are not finite.
    """
    # That of scipy.optimize loads for another quarter of a second; tracks are joined with this one, too.
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import min_weight_full_bipartite_matching

    if not np.isfinite(cost).all():
        raise ValueError("costs must be finite")
    if cost.size == 0:
        return np.zeros(0, dtype=np.intp), np.zeros(0, dtype=np.intp)
    # A cost of 0 would be no pair; what all costs have in common decides nothing.
    rows, columns = min_weight_full_bipartite_matching(csr_array(cost - cost.min() + 1.0))
    return rows.astype(np.intp), columns.astype(np.intp)
