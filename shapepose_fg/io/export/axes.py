"""From the axes of the world to those of a file format."""

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.camera import Axis

_TO_Y_UP: dict[Axis, list[list[int]]] = {
    "y": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
    "-y": [[1, 0, 0], [0, -1, 0], [0, 0, -1]],
    "z": [[1, 0, 0], [0, 0, 1], [0, -1, 0]],
    "-z": [[1, 0, 0], [0, 0, -1], [0, 1, 0]],
    "x": [[0, -1, 0], [1, 0, 0], [0, 0, 1]],
    "-x": [[0, 1, 0], [-1, 0, 0], [0, 0, 1]],
}
"""The smallest turn that takes each axis to y."""
_Z_FROM_Y = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
"""(x, y, z) to (x, -z, y): what Blender's importers do with a file whose y is up."""
_FORWARD_X = np.array([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]])
"""About y: with it a world whose z is up becomes (y, z, x), as Pose2Sim writes it."""


def y_up(up: Axis) -> NDArray[np.float64]:
    """(3, 3) rotation from a world with the axis `up` upwards to y up: BVH and glTF.

    Z up becomes (x, z, -y), which Blender's importers undo: there the numbers are those of the world again.
    """
    return np.array(_TO_Y_UP[up], dtype=np.float64)


def z_up(up: Axis) -> NDArray[np.float64]:
    """(3, 3) rotation to z up, as AMASS has it; the identity where z is up."""
    return _Z_FROM_Y @ y_up(up)


def opensim_axes(up: Axis) -> NDArray[np.float64]:
    """(3, 3) rotation to y up in TRC and C3D: Pose2Sim's, so that the same cameras give the same numbers."""
    return _FORWARD_X @ y_up(up)
