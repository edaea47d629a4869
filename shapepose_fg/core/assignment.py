"""Who is whom: the pairing of least total cost, without SciPy, whose optimisers load for a quarter of a second."""

import numpy as np

from shapepose_fg.core.arrays import Array, Index


def least_cost_pairs(cost: Array) -> tuple[Index, Index]:
    """Rows, rising, and columns of the pairs, each row or column once, whose costs (R, C) have the least sum.

    As many pairs as can be. ValueError where costs are not finite. Shortest augmenting paths: Jonker and
    Volgenant, "A Shortest Augmenting Path Algorithm for Dense and Sparse Linear Assignment Problems", Computing
    38, 1987.
    """
    if not np.isfinite(cost).all():
        raise ValueError("costs must be finite")
    if len(cost) > cost.shape[1]:
        columns, rows = least_cost_pairs(cost.T)
        order = np.argsort(rows, kind="stable")
        return rows[order], columns[order]
    price, row_of = np.zeros(cost.shape[1]), np.full(cost.shape[1], -1)
    worth, column_of = np.zeros(len(cost)), np.full(len(cost), -1)
    for row in range(len(cost)):
        # The shortest way from the row to a column that nobody has; those on it change their columns.
        far, via = np.full(len(price), np.inf), np.full(len(price), -1)
        reached, at, gone = np.zeros(len(price), dtype=bool), row, 0.0
        while at >= 0:
            way = gone + cost[at] - worth[at] - price
            nearer = ~reached & (way < far)
            far[nearer], via[nearer] = way[nearer], at
            end = int(np.where(reached, np.inf, far).argmin())
            reached[end], at, gone = True, int(row_of[end]), float(far[end])
        taken = reached & (row_of >= 0)
        worth[row] += gone
        worth[row_of[taken]] += gone - far[taken]
        price[reached] -= gone - far[reached]
        while end >= 0:
            at = int(via[end])
            row_of[end], column_of[at], end = at, end, int(column_of[at])
    return np.arange(len(cost)), column_of
