"""Times of each camera's pictures, from the footage or from the user's options."""

import re
from collections.abc import Sequence

import numpy as np

from shapepose_fg.core.errors import InputError
from shapepose_fg.core.frame_sets import CameraClock
from shapepose_fg.core.validation import is_number
from shapepose_fg.io.footage.footage import Footage
from shapepose_fg.io.footage.places import per_camera


def clocks_of(
    footage: Sequence[Footage], fps: Sequence[str], start: Sequence[str], cameras: Sequence[str]
) -> tuple[list[CameraClock], bool]:
    """The clock of each camera, and whether it is in seconds; without any frame rate it is in
    frames.

    `fps` and `start` are options in the form that `per_camera` reads.
    """
    rates = [typed_rate(text) for text in per_camera("--fps", fps, cameras, one_for_all=True)]
    starts = per_camera("--start", start, cameras)
    timed = [
        rate is not None or each.time_s is not None
        for rate, each in zip(rates, footage, strict=True)
    ]
    has_clock = any(timed)
    if has_clock and not all(timed):
        name = cameras[timed.index(False)]
        raise InputError(f"camera {name}: the pictures have no times; give --fps {name}=RATE")
    # Pictures with the same number belong together: all are counted from the lowest number of any
    # camera.
    first = min((each.number[0] for each in footage if each.time_s is None), default=0)
    clocks = []
    for name, each, rate, text in zip(cameras, footage, rates, starts, strict=True):
        number = each.number - (first if each.time_s is None else 0)
        if rate is not None:
            taken, period = number / rate, 1 / rate
        elif each.time_s is not None:
            taken = each.time_s
            period = float(np.median(np.diff(taken))) if len(taken) > 1 else 1 / 30
        else:
            taken, period = number.astype(np.float64), 1.0
        clocks.append(CameraClock(name, taken + typed_start(text, period, has_clock), period))
    return clocks, has_clock


def typed_rate(text: str | None) -> float | None:
    """Parse a frame rate, Hz."""
    if text is None:
        return None
    if not is_number(text) or not 0.01 <= float(text) <= 1e5:
        raise InputError(f"--fps {text}: must be a frame rate in Hz, such as 25")
    return float(text)


def typed_start(text: str | None, period: float, has_clock: bool) -> float:
    """Parse the time of a camera's first frame: in seconds, or in frames if there is no clock."""
    if text is None:
        return 0.0
    match = re.fullmatch(r"([-+]?(?:\d+\.?\d*|\.\d+))\s*([sf])", text.strip())
    if match is None:
        raise InputError(
            f"--start {text}: must be seconds, such as 0.2s, or frames of the camera, such as 12f"
        )
    if match[2] == "s" and not has_clock:
        raise InputError(
            f"--start {text}: the frame rate is unknown; give --fps, or frames such as 12f"
        )
    return float(match[1]) * (1.0 if match[2] == "s" else period)
