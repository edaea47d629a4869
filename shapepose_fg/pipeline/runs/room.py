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
    people = np.mean([len(detections[frame]) for frame in spread.tolist()]) / (len(rig) * len(joints))
    tables = (Reconstruction.empty(joints), ObservationTable.empty(joints, rig.names))
    columns = [table.columns()[name] for table in tables for name in table.ROWS]
    row = sum(column.dtype.itemsize * prod(column.shape[1:]) for column in columns)
    return int(2 * row * people * len(frames))


def check_room(folder: Path, needed: int) -> None:
    """InputError where the disk of `folder` has less room than that."""
    free = shutil.disk_usage(folder).free
    if free < needed:
        raise InputError(
            f"{folder}: about {decimal(needed)} are needed here, and {decimal(free)} are free; make room, give"
            " another --output, or take a part with --frames"
        )
