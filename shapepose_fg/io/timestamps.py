"""When frames were taken, from a text file: a line per frame, in seconds; one column, or one for each camera."""

import re
from collections import Counter
from pathlib import Path

import numpy as np

from shapepose_fg.core.arrays import Array, Index
from shapepose_fg.core.camera import Rig
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.frame_times import FrameTimes
from shapepose_fg.core.storage.files import read_text
from shapepose_fg.io.validation import is_number

_FRAME, _TIME = "frame", "time_s"
"""Columns with a meaning of their own; every other column is a camera's."""
_MOST_BYTES = 2**28
"""A line a frame: a day of 30 cameras."""
_SHORTEST_STEP_S, _LONGEST_STEP_S = 1e-6, 10.0
"""Frames nearer or farther apart than this are no recording of motion: the file is in another unit."""
_SAME_CLOCK_S = 1.0
"""Cameras that took one frame farther apart than this do not share a clock."""


def read_timestamps(path: str | Path, rig: Rig, frames: int) -> FrameTimes:
    """The times of a recording of `frames` frames, from a text file (docs/conventions.md).

    Numbers are apart by commas or spaces. Without a header each line is a time in seconds, frame 0 first. The
    header names the columns: `time_s`, or the rig's cameras; and `frame`, if lines say which frame they are of.
    InputError, one sentence that names file, line and cure.
    """
    path = Path(path)
    names, numbers, lines = _table(path, rig)
    twice = next((name for name, count in Counter(names).items() if count > 1), None)
    if twice is not None:
        raise InputError(f"{path}: column {twice} occurs twice; give each its own name")
    wanted = [_TIME] if _TIME in names else rig.names
    missing = [name for name in wanted if name not in names]
    if len(missing) > 0:
        problem = f"no times of camera {missing[0]}, the columns are {' '.join(names)[:80]}"
        raise InputError(f"{path}: {problem}; name a column {_TIME}, or one for each camera of the calibration")
    picked = np.arange(frames)
    if _FRAME in names:
        picked = _lines_of_frames(path, numbers[:, names.index(_FRAME)], lines, frames)
    elif len(numbers) != frames:
        problem = f"must hold a time for each of the {frames} frames, got {len(numbers)}"
        raise InputError(f"{path}: {problem}; add a column frame where it is of more frames than the recording")
    time_s = numbers[picked][:, [names.index(name) for name in wanted]]
    steps, apart = np.diff(time_s, axis=0), np.ptp(time_s, axis=1)
    if (steps <= 0).any():
        line = lines[picked][int(np.argmax((steps <= 0).any(axis=1))) + 1]
        what = f"line {line} must be later than the frame before"
        raise InputError(f"{path}: {what}; put frames in order of their times")
    if len(time_s) > 1 and not _SHORTEST_STEP_S <= (step := np.median(steps)) <= _LONGEST_STEP_S:
        raise InputError(f"{path}: frames would be {step:.3g} s apart; write seconds")
    if (apart > _SAME_CLOCK_S).any():
        frame = int(np.argmax(apart > _SAME_CLOCK_S))
        what = f"the cameras' times of frame {frame} are {apart[frame]:.3g} s apart"
        raise InputError(f"{path}: {what}; give times of one clock")
    return FrameTimes(time_s[:, 0] if len(wanted) == 1 else time_s, source=str(path))


def _table(path: Path, rig: Rig) -> tuple[list[str], Array, Index]:
    """Names of the columns, the numbers (T, C), and the line of the file that each row is from."""
    names, rows, lines = list[str](), list[list[float]](), list[int]()
    for line, text in enumerate(read_text(path, most=_MOST_BYTES).splitlines(), start=1):
        words = [word for word in re.split(r"[,\s]+", text.split("#")[0].strip()) if word]
        if len(words) == 0:
            continue
        if len(names) == 0:
            # Cameras may be called by numbers; without a header there is one column.
            header = not is_number(words[0]) or (len(words) > 1 and set(rig.names) <= set(words))
            names = words if header else [_TIME]
            if header:
                continue
        if len(words) != len(names):
            cure = "name the columns in a first line" if names == [_TIME] else "correct the line"
            raise InputError(f"{path}: line {line} must hold {len(names)} numbers, got {len(words)}; {cure}")
        wrong = [word[:20] for word in words if not is_number(word)]
        if len(wrong) > 0:
            raise InputError(f"{path}: line {line} must hold numbers, got {wrong[0]!r}; write seconds like 0.033")
        rows.append([float(word) for word in words])
        lines.append(line)
    return names, np.array(rows).reshape(len(rows), len(names)), np.array(lines, dtype=np.intp)


def _lines_of_frames(path: Path, numbers: Array, lines: Index, frames: int) -> Index:
    """(T,) the row of each frame of the recording; frames that it does not have are passed over."""
    odd = np.flatnonzero((numbers != np.round(numbers)) | (numbers < 0))
    if len(odd) > 0:
        line, number = lines[odd[0]], numbers[odd[0]]
        raise InputError(f"{path}: line {line} must name a frame, 0 or more, got {number:g}; correct it")
    found, first, count = np.unique(numbers, return_index=True, return_counts=True)
    if (count > 1).any():
        raise InputError(f"{path}: frame {found[np.argmax(count > 1)]:.0f} occurs twice; keep one line of it")
    missing = np.setdiff1d(np.arange(frames), found)
    if len(missing) > 0:
        has = f"the recording has frames 0 to {frames - 1}"
        raise InputError(f"{path}: no time of frame {missing[0]}, {has}; add its line")
    return first[np.searchsorted(found, np.arange(frames))]
