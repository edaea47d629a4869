"""Rotations of the world to the axes of other programs."""

import numpy as np

from shapepose_fg.core.arrays import Array
from shapepose_fg.core.camera import Axis


def y_up(up: Axis) -> Array:
    """(3, 3) rotation from a world with the up axis `up` to y up, for BVH and glTF.

    Z up becomes (x, z, -y), which Blender's importers invert: in Blender the coordinates are again
    those of the world.
    """
    # For each up axis, the smallest rotation that maps it to y.
    return np.array(
        {
            "y": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
            "-y": [[1, 0, 0], [0, -1, 0], [0, 0, -1]],
            "z": [[1, 0, 0], [0, 0, 1], [0, -1, 0]],
            "-z": [[1, 0, 0], [0, 0, -1], [0, 1, 0]],
            "x": [[0, -1, 0], [1, 0, 0], [0, 0, 1]],
            "-x": [[0, 1, 0], [-1, 0, 0], [0, 0, 1]],
        }[up],
        dtype=np.float64,
    )


def z_up(up: Axis) -> Array:
    """(3, 3) rotation to z up, for AMASS; the identity if z is already up."""
    # (x, y, z) to (x, -z, y): the rotation that Blender's importers apply to files with y
    # up.
    return np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]) @ y_up(up)


def opensim_axes(up: Axis) -> Array:
    """(3, 3) rotation to y up for TRC and C3D; the same as in Pose2Sim, so that the same cameras
    give equal coordinates.
    """
    # Rotation about y that turns a world with z up into (y, z, x), as written by Pose2Sim.
    return np.array([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]]) @ y_up(up)
