"""Reads and writes times of frames as text: a line per frame, in seconds; one column, or one for
each camera.
"""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import cast

import numpy as np

from shapepose_fg.core.arrays import Array, Index, Mask
from shapepose_fg.core.camera import Rig
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.frame_sets import CameraClock, FrameSets, align
from shapepose_fg.core.frame_times import MOST_FPS, FrameTimes
from shapepose_fg.core.storage.files import write_content
from shapepose_fg.core.validation import is_number
from shapepose_fg.io.number_table import MISSING, read_number_table, refuse_first

_FRAME, _TIME = "frame", "time_s"
"""Columns with a special meaning; every other column belongs to a camera."""


def read_timestamps(path: str | Path, rig: Rig, frames: int) -> tuple[FrameTimes, FrameSets | None]:
    """The times of a recording of `frames` frames, from a text file (docs/conventions.md).

    Numbers are separated by commas or spaces. Without a header each line is a time in seconds,
    frame 0 first. The header names the columns: `time_s`, or the rig's cameras; and `frame`, if
    lines have frame numbers. If times of frames with the same number differ by more than a frame,
    or if a camera lacks frames, pictures are grouped to synchronised frame sets, and the times of
    these are returned. InputError, one sentence that names file, line and cure.
    """
    path = Path(path)
    time_s, clocks = _times(path, rig, frames)
    if len(clocks) == 1:
        return FrameTimes(time_s[:, 0], source=str(path)), None
    slowest = max(clock.period for clock in clocks)
    if np.isfinite(time_s).all() and (np.ptp(time_s, axis=1) <= slowest).all():
        return FrameTimes(time_s, source=str(path)), None
    try:
        found = align(clocks, True, "give times of one clock")
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    # Frames that a camera lacks keep their numbers, as in the detections.
    number = [np.append(np.flatnonzero(np.isfinite(each)), -1) for each in time_s.T]
    picture = np.column_stack(
        [own[place] for own, place in zip(number, found.picture.T, strict=True)]
    )
    notes = tuple(f"{path}: {each}" for each in found.notes)
    return FrameTimes(cast(Array, found.time_s), source=str(path)), FrameSets(
        picture, found.time_s, notes
    )


def read_own_times(path: Path, rig: Rig, frames: int) -> tuple[FrameTimes, Mask]:
    """The times of each camera's own frames, if the offsets between cameras are unknown; and (T, V)
    which frames exist.

    Times of missing frames continue at the camera's rate. Raises InputError as `read_timestamps`
    does, and if cameras have different rates.
    """
    time_s, clocks = _times(path, rig, frames)
    periods = [clock.period for clock in clocks]
    if max(periods) > 1.01 * min(periods):
        slow, fast = (clocks[periods.index(end(periods))].name for end in (max, min))
        what = (
            f"cameras {slow} and {fast} have {1 / max(periods):.3g} and {1 / min(periods):.3g} Hz"
        )
        raise InputError(
            f"{path}: {what}, but synchronisation needs a common rate; give detections of one rate"
        )
    known = np.isfinite(time_s)
    filled = time_s.copy()
    for own, has, clock in zip(filled.T, known.T, clocks, strict=True):
        frame, step = np.arange(frames), clock.period
        own[~has] = np.interp(frame[~has], frame[has], own[has])
        last, first = int(frame[has][-1]), int(frame[has][0])
        own[last + 1 :] = own[last] + step * (frame[last + 1 :] - last)
        own[:first] = own[first] + step * (frame[:first] - first)
    every = np.broadcast_to(known, (frames, len(rig))) if known.shape[1] == 1 else known
    return FrameTimes(filled[:, 0] if filled.shape[1] == 1 else filled, source=str(path)), every


def _times(path: Path, rig: Rig, frames: int) -> tuple[Array, list[CameraClock]]:
    """The times (T, C) of frames, common (C = 1) or for each camera, NaN for missing frames; and
    the clocks.
    """

    def heads(line: int, words: list[str]) -> tuple[list[str], bool]:
        # Cameras may have numbers as names; a file without header has one column.
        header = not is_number(words[0]) or (len(words) > 1 and set(rig.names) <= set(words))
        return (words if header else [_TIME]), header

    in_seconds = "write seconds like 0.033"
    names, numbers, lines = read_number_table(
        path, heads, in_seconds, lambda name: name not in (_FRAME, _TIME)
    )
    twice = next((name for name, count in Counter(names).items() if count > 1), None)
    if twice is not None:
        raise InputError(f"{path}: column {twice} occurs twice; give each its own name")
    wanted = [_TIME] if _TIME in names else rig.names
    missing = [name for name in wanted if name not in names]
    if len(missing) > 0:
        problem = (
            f"times of camera {missing[0]} are missing; the columns are {' '.join(names)[:80]}"
        )
        raise InputError(
            f"{path}: {problem}; name a column {_TIME}, or one for each camera of the calibration"
        )
    picked = np.arange(frames)
    if _FRAME in names:
        picked = _lines_of_frames(path, numbers[:, names.index(_FRAME)], lines, frames)
    elif len(numbers) != frames:
        problem = f"must hold a time for each of the {frames} frames, got {len(numbers)}"
        raise InputError(
            f"{path}: {problem}; add a column frame if the file has more frames than the recording"
        )
    time_s = numbers[picked][:, [names.index(name) for name in wanted]]
    clocks = [
        _clock(path, name, each, lines[picked]) for name, each in zip(wanted, time_s.T, strict=True)
    ]
    return time_s, clocks


def nameable(names: Sequence[str]) -> bool:
    """Whether these camera names can be used as column names."""
    return not any(set(name) & set(", \t#") for name in names)


def write_timestamps(path: Path, names: Sequence[str], times: Array) -> None:
    """Write the times of frames, from 0 on, as `read_timestamps` reads them: (T,), or (T, V) for
    each camera, NaN for missing frames.
    """
    if times.ndim == 2 and not nameable(names):
        raise InputError(
            f"{path}: a camera's name has a blank, a comma or #; rename it in the calibration"
        )
    columns = [_TIME] if times.ndim == 1 else names
    rows = [", ".join([_FRAME, *columns])]
    for frame, row in enumerate((times - np.nanmin(times)).reshape(len(times), -1).tolist()):
        rows.append(
            ", ".join([str(frame), *(f"{each:.6f}" if each == each else MISSING for each in row)])
        )
    write_content(path, "\n".join(rows) + "\n")


def _clock(path: Path, name: str, time_s: Array, lines: Index) -> CameraClock:
    """The clock of one camera, or of all, from the times of its frames `time_s` (T,), NaN for
    missing ones.
    """
    known = np.isfinite(time_s)
    time_s, lines = time_s[known], lines[known]
    steps, late = np.diff(time_s), " must be later than the frame before"
    refuse_first(path, lines[1:], steps <= 0, late, "sort frames by time")
    step = float(np.median(steps)) if len(steps) > 0 else np.inf
    # Maximum time between frames, s; a longer one means that the file has another unit.
    if len(steps) > 0 and not 1 / MOST_FPS <= step <= 10.0:
        raise InputError(f"{path}: frames are {step:.3g} s apart; write seconds")
    if len(known) > 0 and len(time_s) == 0:
        raise InputError(f"{path}: camera {name} has no times; leave it out with --without")
    return CameraClock(name, time_s, step)


def _lines_of_frames(path: Path, numbers: Array, lines: Index, frames: int) -> Index:
    """(T,) row of the table for each frame of the recording; other rows are ignored."""
    refuse_first(
        path,
        lines,
        (numbers != np.round(numbers)) | (numbers < 0),
        lambda row: f" must name a frame, 0 or more, got {numbers[row]:g}",
        "correct it",
    )
    found, first, count = np.unique(numbers, return_index=True, return_counts=True)
    if (count > 1).any():
        raise InputError(
            f"{path}: frame {found[np.argmax(count > 1)]:.0f} occurs twice; keep one line"
        )
    missing = np.setdiff1d(np.arange(frames), found)
    if len(missing) > 0:
        has = f"the recording has frames 0 to {frames - 1}"
        raise InputError(f"{path}: the time of frame {missing[0]} is missing; {has}; add its line")
    return first[np.searchsorted(found, np.arange(frames))]
