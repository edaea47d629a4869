"""One-to-one pairs of least total cost."""

import numpy as np

from shapepose_fg.core.arrays import Array, Index


def least_cost_pairs(cost: Array) -> tuple[Index, Index]:
    """One-to-one pairs with the least total cost: row and column indices of the costs (R, C), rows
    ascending.

    There are min(R, C) pairs. ValueError if costs are not finite.
    """
    # scipy.optimize's solver takes a quarter of a second longer to import; `tracking` uses this
    # one, too.
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import min_weight_full_bipartite_matching

    if not np.isfinite(cost).all():
        raise ValueError("costs must be finite")
    if cost.size == 0:
        return np.zeros(0, dtype=np.intp), np.zeros(0, dtype=np.intp)
    # A cost of 0 would mean "no edge". A constant added to all costs does not change the solution.
    rows, columns = min_weight_full_bipartite_matching(csr_array(cost - cost.min() + 1.0))
    return rows.astype(np.intp), columns.astype(np.intp)
