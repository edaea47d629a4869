"""What options say of each camera: values by name, how its pictures are placed, and when they were taken."""

import re
from collections.abc import Mapping, Sequence

import numpy as np

from shapepose_fg.core.camera import Rig
from shapepose_fg.core.errors import InputError
from shapepose_fg.io.footage.footage import Footage
from shapepose_fg.io.footage.lockstep import CameraClock
from shapepose_fg.io.footage.placement import Placement, PlacementKind, place


def per_camera(option: str, given: Sequence[str], rig: Rig, *, one_for_all: bool) -> list[str | None]:
    """(V,) what an option says of each camera: CAMERA=VALUE, or where it may be one VALUE for all."""
    values: dict[str, str] = {}
    rest: str | None = None
    for text in given:
        name, separator, value = text.rpartition("=")
        if not separator and one_for_all and rest is None:
            rest = text
        elif not separator:
            raise InputError(f"{option} {text}: must be CAMERA=VALUE, such as {option} {rig.names[0]}=VALUE")
        elif name not in rig.names:
            raise InputError(
                f"{option} {text}: the calibration has no camera {name!r}; it has {' '.join(rig.names)}"
            )
        elif name in values:
            raise InputError(f"{option} {text}: camera {name} is given twice; give it once")
        else:
            values[name] = value
    return [values.get(name, rest) for name in rig.names]


def placements_of(
    given: Sequence[str], sizes: Mapping[str, tuple[int, int]], rig: Rig
) -> tuple[dict[str, Placement], list[str]]:
    """Where calibrated pixels lie in the pictures of cameras, `sizes` (width, height), and what was concluded.

    `given` are kinds of placement, for all cameras or CAMERA=KIND.
    """
    words = dict(zip(rig.names, per_camera("--image-placement", given, rig, one_for_all=True), strict=True))
    placements, notes = {}, []
    for camera in rig.cameras:
        word = words[camera.name]
        if word is not None and word not in set(PlacementKind):
            raise InputError(f"--image-placement {word}: must be one of {' '.join(PlacementKind)}")
        if camera.name in sizes:
            wanted = None if word is None else PlacementKind(word)
            placements[camera.name], concluded = place(camera.name, sizes[camera.name], camera.image_size, wanted)
            notes += [] if concluded is None else [concluded]
    return placements, notes


def clocks_of(
    footage: Sequence[Footage], rates: Sequence[str | None], starts: Sequence[str | None], rig: Rig
) -> tuple[list[CameraClock], bool]:
    """When each camera took its frames, and whether in seconds: without any rate frames are counted."""
    fps = [_rate(text) for text in rates]
    timed = [rate is not None or each.time_s is not None for rate, each in zip(fps, footage, strict=True)]
    has_clock = any(timed)
    if has_clock and not all(timed):
        name = rig.names[timed.index(False)]
        raise InputError(f"camera {name}: pictures do not say when they were taken; give --fps {name}=RATE")
    # Pictures of one number belong together: all are counted from the first number that any camera has.
    first = min((each.number[0] for each in footage if each.time_s is None), default=0)
    clocks = []
    for name, each, rate, text in zip(rig.names, footage, fps, starts, strict=True):
        number = each.number - (first if each.time_s is None else 0)
        if rate is not None:
            taken, period = number / rate, 1 / rate
        elif each.time_s is not None:
            taken = each.time_s
            period = float(np.median(np.diff(taken))) if len(taken) > 1 else 1 / 30
        else:
            taken, period = number.astype(np.float64), 1.0
        clocks.append(CameraClock(name, taken + _start(text, period, has_clock), period))
    return clocks, has_clock


def _rate(text: str | None) -> float | None:
    """Frames a second."""
    if text is None:
        return None
    try:
        rate = float(text)
    except ValueError:
        rate = 0.0
    if not 0.01 <= rate <= 1e5:
        raise InputError(f"--fps {text}: must be a number of frames a second, such as 25")
    return rate


def _start(text: str | None, period: float, has_clock: bool) -> float:
    """When a camera's first frame was taken, in seconds, or in frames where there is no clock."""
    if text is None:
        return 0.0
    match = re.fullmatch(r"([-+]?(?:\d+\.?\d*|\.\d+))\s*([sf])", text.strip())
    if match is None:
        raise InputError(f"--start {text}: must be seconds such as 0.2s, or the camera's own frames such as 12f")
    if match[2] == "s" and not has_clock:
        raise InputError(
            f"--start {text}: nothing says how many frames a second there are; give --fps, or frames (12f)"
        )
    return float(match[1]) * (1.0 if match[2] == "s" else period)
