"""A body's skin with fewer vertices, to be drawn in every frame."""

import numpy as np
from numpy.typing import NDArray

CELL_M = 0.02
"""Edge of the cells of which each keeps one vertex: a finger's width, which nobody misses in a room."""


def thinned(
    vertices: NDArray[np.float64], faces: NDArray[np.integer], cell_m: float = CELL_M
) -> tuple[NDArray[np.intp], NDArray[np.int32]]:
    """Which vertices (M,) of a mesh stay, and its triangles (F, 3) among these; for a T-pose, metres.

    Of the vertices in a cell of a grid the one nearest to their middle stands for all of them, and triangles that
    become lines or occur twice go (Rossignac and Borrel 1993).
    """
    cells = np.floor(vertices / cell_m).astype(np.int64)
    _, cell, count = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    cell = cell.reshape(-1)
    middle = np.stack([np.bincount(cell, axis) for axis in vertices.T], axis=1) / count[:, None]
    order = np.lexsort((np.linalg.norm(vertices - middle[cell], axis=1), cell))
    kept = order[np.r_[0, np.cumsum(count)[:-1]]]
    merged = cell[faces]
    whole = (merged != np.roll(merged, 1, axis=1)).all(axis=1)
    # A triangle is the same whichever vertex comes first.
    first = np.argmin(merged, axis=1)[:, None]
    turned = np.take_along_axis(merged, (first + np.arange(3)) % 3, axis=1)
    return kept, np.unique(turned[whole], axis=0).astype(np.int32)
