"""Shared by all visualisations: a colour per person, bones between joints, and simplified
surfaces.
"""

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.arrays import Array, Index, Real, Whole
from shapepose_fg.core.skeleton import BODY_25

PALETTE = ("#3f7fb8", "#e0962f", "#2f9e80", "#c06c9c", "#6cb6dd", "#c8623f", "#7d70b8", "#a8a03c")
"""Colours after Okabe and Ito, distinguishable with every kind of colour vision."""
CELL_M = 0.02
"""Edge length of the grid cells in each of which `thinned` keeps one vertex, m: a finger's width,
invisible at room distance."""


def colour_of(person: int) -> tuple[float, float, float]:
    """Colour of an identity, the same in all files of a result: red, green and blue, 0 to 1 in
    sRGB.
    """
    red, green, blue = (
        int(PALETTE[person % len(PALETTE)][at : at + 2], 16) / 255 for at in (1, 3, 5)
    )
    return red, green, blue


def bones_of(joint_names: tuple[str, ...]) -> Index:
    """(B, 2) pairs of joint indices to connect by lines. Each joint of BODY_25 is connected with
    the nearest available joint towards the hip.
    """
    rows = zip(BODY_25.joints, BODY_25.parents, strict=True)
    parents = {name: BODY_25.joints[parent] for name, parent in rows if parent >= 0} | {
        "Head": "Neck"
    }
    pairs = []
    for place, name in enumerate(joint_names):
        parent = parents.get(name)
        while parent is not None and parent not in joint_names:
            parent = parents.get(parent)
        if parent is not None:
            pairs.append((joint_names.index(parent), place))
    return np.array(pairs, dtype=np.intp).reshape(-1, 2)


def vertex_normals(vertices: Real, faces: Whole) -> Array:
    """Unit normals (N, 3): the mean of the adjacent faces', weighted by their areas."""
    a, b, c = (np.asarray(vertices, dtype=np.float64)[faces[:, m]] for m in range(3))
    normal = np.cross(b - a, c - a)
    total = np.stack(
        [
            np.bincount(faces.ravel(), np.repeat(normal[:, axis], 3), minlength=len(vertices))
            for axis in range(3)
        ],
        axis=1,
    )
    return total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-12)


def thinned(
    vertices: Array, faces: Whole, cell_m: float = CELL_M, corner: Array | float = 0.0
) -> tuple[Index, NDArray[np.int32], Index]:
    """Simplify a mesh by vertex clustering (Rossignac and Borrel 1993).

    Returns indices (M,) of the vertices that remain, triangles (G, 3) of these, and for each vertex
    (N,) the one that represents it. The grid has cells of `cell_m`, metres, and starts at `corner`.
    In each cell, the vertex nearest to the mean represents all; triangles that become degenerate or
    duplicate are removed. With `cell_m` 0, all remain.
    """
    if cell_m <= 0:
        every = np.arange(len(vertices))
        return every, faces.astype(np.int32), every
    cells = np.floor((vertices - corner) / cell_m).astype(np.int64)
    _, cell, count = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    cell = cell.reshape(-1)
    middle = np.stack([np.bincount(cell, axis) for axis in vertices.T], axis=1) / count[:, None]
    order = np.lexsort((np.linalg.norm(vertices - middle[cell], axis=1), cell))
    kept = order[np.r_[0, np.cumsum(count)[:-1]]]
    merged = cell[faces]
    whole = (merged != np.roll(merged, 1, axis=1)).all(axis=1)
    # The same triangle may start at any of its vertices.
    first = np.argmin(merged, axis=1)[:, None]
    turned = np.take_along_axis(merged, (first + np.arange(3)) % 3, axis=1)
    return kept, np.unique(turned[whole], axis=0).astype(np.int32), cell
