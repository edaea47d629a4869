"""Reads a recording for reconstruction: synchronised detections of all cameras, and their times."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from shapepose_fg.core.arrays import Array, Index, Mask
from shapepose_fg.core.camera import Rig
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.frame_times import FrameTimes
from shapepose_fg.core.skeleton import Skeleton
from shapepose_fg.core.storage.files import BIG, read_text, write_content
from shapepose_fg.core.storage.kept_arrays import InFolder
from shapepose_fg.io.detection_table import DetectionTable
from shapepose_fg.io.detections import read_detections
from shapepose_fg.io.detections.people import DeclaredJoints
from shapepose_fg.io.detections.view_streams import in_moments
from shapepose_fg.io.timestamps import read_own_times, read_timestamps

TIMES = "times.csv"
"""Name of the file with frame times, beside the detections."""


def times_beside(detections: Path, fps: float | None, timestamps: Path | None) -> Path | None:
    """The file with the frame times: the given one; without a frame rate, the one beside the
    detections; or None.
    """
    if fps is not None and timestamps is not None:
        raise InputError(
            "--fps and --timestamps: both determine the times of frames; give one of them"
        )
    beside = detections / TIMES
    return timestamps or (beside if fps is None and beside.is_file() else None)


def read_recording(
    detections: Path,
    rig: Rig,
    skeleton: Skeleton | str | Path | DeclaredJoints | None,
    kept: Path,
    fps: float | None = None,
    timestamps: Path | None = None,
    own_frames: bool = False,
) -> tuple[DetectionTable, FrameTimes | None]:
    """Detections of all cameras, in the empty folder `kept`, and the times of the frames; None if
    these are unknown.

    `timestamps` is a file for `read_timestamps`, by default times.csv beside the detections. If
    cameras started at different times, or have different frame rates, their frames are grouped to
    synchronised frame sets, which then are the frames of the recording. With `own_frames` (unknown
    start times), each camera keeps all of its own frames. InputError, one sentence that names file,
    place and cure.
    """
    file = times_beside(detections, fps, timestamps)
    recording = read_detections(
        detections, rig, skeleton, InFolder(kept), own_frames=own_frames or file is not None
    )
    count = len(recording)
    if file is None:
        return recording, None if fps is None else FrameTimes.from_fps(fps, count)
    if own_frames:
        times, exists = read_own_times(file, rig, count)
        return recording if exists.all() else replace(recording, picture=_own(exists)), times
    times, moments = read_timestamps(file, rig, count)
    if moments is None:
        return recording, times
    together = in_moments(recording, moments.picture, InFolder(kept / "moments"))
    what = f"{file}: pictures of equal times are combined into {len(moments)} frames"
    return replace(together, notes=(*recording.notes, what, *moments.notes)), times


def own_times(recording: DetectionTable, times: FrameTimes, views: int) -> Array:
    """(T, V) times of each camera's own frames, on its own clock, seconds; NaN for missing
    frames.
    """
    own = times.of_views(views)
    return own if recording.picture is None else np.where(recording.picture >= 0, own, np.nan)


def _own(exists: Mask) -> Index:
    """(T, V) frame number for frames that a camera has, otherwise -1."""
    return np.where(exists, np.arange(len(exists))[:, None], -1)


def write_moments(file: Path, rig: Rig, picture: Index) -> None:
    """Write the number of each camera's own picture in each frame, `picture` (T, V), -1 for
    none.
    """
    rows = [", ".join(["frame", *rig.names])]
    rows += [", ".join(map(str, [frame, *row])) for frame, row in enumerate(picture.tolist())]
    write_content(file, "\n".join(rows) + "\n")


def read_moments(file: Path) -> dict[str, Index]:
    """Read a file written by `write_moments`: (T,) picture numbers by camera name; InputError for
    any other content.
    """
    lines = [re.split(r",\s*", line) for line in read_text(file, most=BIG).splitlines()]
    names, *rows = lines if len(lines) > 0 else [[""]]
    try:
        numbers = np.array(rows, dtype=np.intp).reshape(len(rows), len(names))
    except ValueError:
        raise InputError(
            f"{file}: lines must have the same number of whole numbers; reconstruct again"
        ) from None
    if (
        names[0] != "frame"
        or (numbers[:, 0] != np.arange(len(rows))).any()
        or (numbers[:, 1:] < -1).any()
    ):
        raise InputError(
            f"{file}: there must be a line for each frame from 0 on; reconstruct again"
        )
    return dict(zip(names[1:], numbers.T[1:], strict=True))
