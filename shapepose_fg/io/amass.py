"""Reads motions in the format of AMASS (.npz with `poses`, `trans`, `betas` and a frame rate)."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from shapepose_fg.core.arrays import Array, Whole
from shapepose_fg.core.errors import naming
from shapepose_fg.core.storage.npz import read_npz
from shapepose_fg.core.storage.schema import Column, checked_columns

LARGEST = 1e6
"""Limit of positions, m, and angles, rad; beyond it a file is damaged."""
_COLUMNS = {
    "poses": Column("N P", most=LARGEST, finite=True),
    "trans": Column("N 3", most=LARGEST, finite=True),
    "betas": Column("B", most=LARGEST, finite=True, missing=0.0),
    "frames": Column("N", np.int64, missing=-1),
}
_RATES = ("mocap_framerate", "mocap_frame_rate")


@dataclass(frozen=True)
class AmassMotion:
    """A motion of one person, z up."""

    poses: Array
    """(F, P) axis-angle of the joints, rad, P at least 66: the root, then SMPL's 21 body joints."""
    trans: Array
    """(F, 3) SMPL's translation, m."""
    betas: Array
    """(B,) shape."""
    frames: Whole
    """(F,) number of each frame; -1 if the file has none."""
    fps: float
    """Frame rate, Hz; NaN if the file has none."""
    body: str
    """Name of the body model to which the shape belongs; empty if the file does not name it."""


def read_amass(file: Path) -> AmassMotion:
    """Read a motion; InputError, naming the file, if it is not a motion, or is damaged."""
    arrays = read_npz(file, (*_COLUMNS, *_RATES, "body"), "download it again")
    with naming(file, "give motions in AMASS's format"):
        columns = checked_columns(_COLUMNS, arrays, {})
        count, width = columns["poses"].shape
        if count == 0 or width < 66 or width % 3:
            raise ValueError(f"poses must be (F, 66 or more), got {(count, width)}")
        rate = next((arrays[name] for name in _RATES if name in arrays), np.array(np.nan))
        return AmassMotion(**columns, fps=float(rate.item()), body=str(arrays.get("body", "")))
