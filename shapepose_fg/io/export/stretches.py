"""Holes in a person's motion, for formats that cannot have any: short ones are filled, long ones cut the file."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from shapepose_fg.io.export.skinned import Motion


@dataclass(frozen=True)
class Stretch:
    """Frames of a motion without a hole."""

    index: NDArray[np.intp]
    """(F,) frames of the take, one after the other."""
    rotations: NDArray[np.float64]
    """(F, 24, 4) as in `Motion`."""
    pelvis: NDArray[np.float64]
    """(F, 3) as in `Motion`."""
    filled: NDArray[np.bool_]
    """(F,) frames that lie in a hole, between those before and after it."""


def stretches(motion: Motion, longest_hole: int) -> list[Stretch]:
    """The motion in parts without holes; a hole of up to `longest_hole` frames is interpolated.

    Rotations turn at a constant rate from the one before the hole to the one after it, the pelvis moves on a line.
    """
    cuts = np.flatnonzero(np.diff(motion.index) > longest_hole + 1) + 1
    parts = np.split(np.arange(len(motion.index)), cuts)
    return [_filled(motion, part) for part in parts]


def _filled(motion: Motion, part: NDArray[np.intp]) -> Stretch:
    given = motion.index[part]
    index = np.arange(given[0], given[-1] + 1)
    if len(index) == len(given):
        return Stretch(index, motion.rotations[part], motion.pelvis[part], np.zeros(len(index), dtype=bool))
    bones = motion.rotations[part].swapaxes(0, 1)
    rotations = np.stack([Slerp(given, Rotation.from_quat(bone))(index).as_quat() for bone in bones], axis=1)
    pelvis = np.stack([np.interp(index, given, axis) for axis in motion.pelvis[part].T], axis=1)
    return Stretch(index, rotations, pelvis, ~np.isin(index, given))
