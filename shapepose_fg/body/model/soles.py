"""The lowest points of bodies: of each foot, and of the whole skin."""

import numpy as np
import torch
from numpy.typing import NDArray

from shapepose_fg.body.model.body_model import BodyModel, BodyParameters
from shapepose_fg.skeleton import SMPL_24

_BONES = tuple([SMPL_24.index(f"{side}_{name}") for name in ("ankle", "foot")] for side in ("right", "left"))
_OF_FEET, _BEYOND = 3, 10
"""Of the feet's vertices every third is looked at, of the rest of the skin every tenth, 1 to 3 cm apart."""
_ROWS = 256
"""Bodies whose vertices are made at a time."""

Array = NDArray[np.float64]
Bodies = tuple[Array, Array, Array, Array]
"""`betas` (B, 10), `global_orient` (B, 3), `body_pose` (B, 23, 3) and `transl` (B, 3) as in `BodyParameters`."""


def feet_vertices(model: BodyModel) -> list[NDArray[np.intp]]:
    """Vertices of the right foot, and of the left."""
    bone = model.arrays.weights.argmax(axis=1)
    return [np.flatnonzero(np.isin(bone, bones))[::_OF_FEET] for bones in _BONES]


def lowest_of_feet(model: BodyModel, bodies: Bodies, up: Array) -> Array:
    """(B, 2, 3) the lowest point of each foot, right and left, metres; NaN where there is no body."""
    feet = feet_vertices(model)
    points = _vertices(model, bodies, np.concatenate(feet))
    parts = points[:, : len(feet[0])], points[:, len(feet[0]) :]
    rows = np.arange(len(points))
    return np.stack([part[rows, (part @ up).argmin(axis=1)] for part in parts], axis=1)


def lowest(model: BodyModel, bodies: Bodies, normal: Array) -> Array:
    """(B,) how low bodies reach along a `normal` (3,), metres, to 1 cm."""
    chosen = np.union1d(np.concatenate(feet_vertices(model)), np.arange(0, model.num_vertices, _BEYOND))
    return np.asarray((_vertices(model, bodies, chosen) @ normal).min(axis=1))


@torch.no_grad()
def _vertices(model: BodyModel, bodies: Bodies, only: NDArray[np.intp]) -> Array:
    """(B, M, 3) some of the vertices."""
    columns = [torch.from_numpy(column).to(model.dtype) for column in bodies]
    parts = [
        model.vertices(BodyParameters(*(column[at : at + _ROWS] for column in columns)), only)
        for at in range(0, len(columns[0]), _ROWS)
    ]
    return torch.cat(parts).double().numpy() if parts else np.zeros((0, len(only), 3))
