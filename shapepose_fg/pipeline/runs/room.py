"""Whether there is room for a run: asked before the work, by what its frames show."""

import shutil
from math import prod
from pathlib import Path

import numpy as np
from rich.filesize import decimal

from shapepose_fg.core.camera import Rig
from shapepose_fg.core.detections import DetectionSequence
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.observation_table import ObservationTable
from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.core.storage.npz_writer import Column

_LOOKED_AT = 200
"""Frames, spread over the run, by which people are counted."""


def expected_bytes(detections: DetectionSequence, rig: Rig, frames: range) -> int:
    """What a run needs on the disk at the most: its rows twice, as parts and, compressed or not, as results.

    As many people are expected as a view has detections of each joint, in the mean over views, joints and frames.
    """
    joints = detections.skeleton.joints
    if len(frames) == 0:
        return 0
    spread = np.unique(np.linspace(frames.start, frames.stop - 1, min(len(frames), _LOOKED_AT)).astype(int))
    seen = np.mean([len(detections[frame]) for frame in spread.tolist()])
    people = seen / (len(rig) * len(joints))
    empty = (Reconstruction.empty(joints).columns(), ObservationTable.empty(joints, rig.names).columns())
    row = sum(_row_bytes(column) for columns in empty for column in columns.values() if column.shape[:1] == (0,))
    return int(2 * row * people * len(frames))


def check_room(folder: Path, needed: int) -> None:
    """InputError where the disk of `folder` has less room than that."""
    free = shutil.disk_usage(folder).free
    if free < needed:
        raise InputError(
            f"{folder}: about {decimal(needed)} are needed here, and {decimal(free)} are free; make room, give"
            " another --output, or take a part with --frames"
        )


def _row_bytes(column: Column) -> int:
    return column.dtype.itemsize * prod(column.shape[1:])
