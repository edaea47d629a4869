"""A finding in a sentence or two: which camera, what it looks like, and what to do."""

from collections.abc import Callable

import numpy as np

from shapepose_fg.core.camera import Rig
from shapepose_fg.setup_check.changes import Kind
from shapepose_fg.setup_check.diagnosis import Finding

_ADULT_M = 1.7
_UNITS = ((1e-3, "m, and was read as mm"), (1e-2, "m, and was read as cm"), (1e-1, "cm, and was read as mm"))
"""What a length that is so many times too small was in truth; the other way round where it is too large."""


def sentence(finding: Finding, rig: Rig) -> str:
    """What was found, as it is printed."""
    who = _names(finding, rig)
    if finding.kind in _SAID:
        words = _SAID[finding.kind].format(who=who)
    else:
        words = _MADE[finding.kind](finding, rig, who)
    return words if words.startswith(rig.names) else f"{words[0].upper()}{words[1:]}"


_SAID = {
    Kind.EXCHANGED: "{who} look exchanged: each sees what the other should see; exchange their names in the"
    " calibration, or their detections",
    Kind.INVERTED: "the extrinsics of {who} look inverted: camera from world was taken for world from camera, or"
    " the other way round; write the inverse",
    Kind.TRANSPOSED: "the rotation of {who} looks transposed, with the translation as it is; transpose it",
    Kind.AXES: "the camera axes of {who} look like those of OpenGL or Blender, y up and z backwards; turn y and z"
    " round",
    Kind.UNFIT: "{who} fits the others in nothing that was tried; check that its calibration and its detections"
    " are its own",
}
"""What is said whatever the amount."""


def _names(finding: Finding, rig: Rig) -> str:
    names = [rig.names[view] for view in finding.cameras]
    if len(names) == len(rig) > 2:
        return "all cameras"
    return " and ".join(part for part in (", ".join(names[:-1]), *names[-1:]) if part)


def _turned(finding: Finding, rig: Rig, who: str) -> str:
    size = rig.cameras[finding.cameras[0]].image_size
    degrees = f"{finding.amount:.1f}" if finding.amount < 10 else f"{finding.amount:.0f}"
    moved = f" and moved by {_length(finding.moved)}" if finding.moved > 0.1 else ""
    if len(finding.shift_px) == 0:
        return f"{who} looks turned by about {degrees} degrees{moved}; calibrate its pose again"
    x, y = finding.shift_px[0]
    if np.hypot(x, y) < 0.002 * max(size):
        return f"{who} looks turned by about {degrees} degrees about its axis; calibrate its pose again"
    return (
        f"{who} looks turned by about {degrees} degrees (or its principal point should lie {_shift(x, y)}, which"
        " people hardly tell from a turn); calibrate it again"
    )


def _moved(finding: Finding, rig: Rig, who: str) -> str:
    return (
        f"{who} looks moved by about {_length(finding.moved)} and turned by {finding.amount:.1f}"
        " degrees; calibrate its pose again"
    )


def _late(finding: Finding, rig: Rig, who: str) -> str:
    frames = abs(round(finding.amount))
    count = f"{frames} frame{'s' if frames != 1 else ''}"
    if finding.amount > 0:
        return (
            f"{who} looks about {count} late: what the others show at frame 100 it shows at frame {100 + frames};"
            f" leave out its first {count}"
        )
    return (
        f"{who} looks about {count} early: what the others show at frame 100 it shows at frame {100 - frames};"
        f" leave out the first {count} of all others"
    )


def _focal(finding: Finding, rig: Rig, who: str) -> str:
    what, factor = "long" if finding.amount > 1 else "short", finding.amount
    who = f"{who} has a focal length in the calibration that looks"
    if 0.8 < factor < 1.25:
        return f"{who} {100 * abs(factor - 1):.0f} % too {what}; check its intrinsics"
    return f"{who} {factor:.2g} times what fits, too {what}; check its intrinsics and the size of its pictures"


def _resized(finding: Finding, rig: Rig, who: str) -> str:
    width, height = rig.cameras[finding.cameras[0]].image_size
    small = f"{width * finding.amount:.0f} x {height * finding.amount:.0f}"
    return (
        f"the detections of {who} look as if they were made on pictures {finding.amount:.2g}"
        f" times the calibrated size ({small} instead of {width} x {height}); give detections on pictures of the"
        " calibrated size, or the calibration of these"
    )


def _principal_point(finding: Finding, rig: Rig, who: str) -> str:
    by = ", ".join(
        f"{_shift(x, y)} in {rig.names[view]}"
        for view, (x, y) in zip(finding.cameras, finding.shift_px, strict=True)
    )
    return (
        f"principal points look off, they should lie {by} (at most a turn of {finding.amount:.1f} degrees);"
        " check that pictures have the calibrated sizes and are not cropped, or calibrate the intrinsics again"
    )


def _duplicate(finding: Finding, rig: Rig, who: str) -> str:
    first, second = (rig.names[view] for view in finding.cameras)
    pair = finding.duplicate
    if pair is None or (pair.same_pose and pair.same_detections):
        return f"{first} and {second} are one camera listed twice; take one of them out"
    if pair.same_detections:
        return f"{first} and {second} have the same detections; one of them has the other's files: give its own"
    return (
        f"{first} and {second} have one and the same pose; one of them has the other's calibration: give its own"
    )


def _unit(finding: Finding, rig: Rig, who: str) -> str:
    stature = finding.amount
    factor = stature / _ADULT_M
    size = f"people come out {_length(stature)} tall"
    for unit, truth in _UNITS:
        if 0.55 < factor / unit < 1.45:
            return f"{size}: the calibration is probably in {truth}; say its unit with --unit"
        if 0.55 < factor * unit < 1.45:
            wrong = {1e-3: "mm, and was read as m", 1e-2: "cm, and was read as m", 1e-1: "mm, and was read as cm"}
            return f"{size}: the calibration is probably in {wrong[unit]}; say its unit with --unit"
    times = f"{1 / factor:.2g} times too small" if factor < 1 else f"{factor:.2g} times too large"
    return (
        f"{size}: lengths in the calibration are about {times}; check its unit, and the size of the squares of the"
        " board that it was made with"
    )


def _up(finding: Finding, rig: Rig, who: str) -> str:
    return (
        f"people stand along {finding.axis}, and the calibration says that {rig.up} is up; give --up"
        f" {finding.axis} unless they lie"
    )


def _nobody(finding: Finding, rig: Rig, who: str) -> str:
    if len(finding.cameras) > 0:
        sees = "sees" if len(finding.cameras) == 1 else "see"
        return f"{who} {sees} nobody in the frames that were looked at; check the detections"
    if finding.amount < 1:
        return "no camera sees a person in the frames that were looked at; check the detections"
    return (
        f"nobody is seen by two cameras that agree, although cameras saw {finding.amount:.0f} people; check that"
        " calibration and detections are of one recording, and that the cameras are in the same order"
    )


def _sizes(finding: Finding, rig: Rig, who: str) -> str:
    view = finding.cameras[0]
    width, height = rig.cameras[view].image_size
    x, y = (round(value) for value in finding.shift_px[0])
    return (
        f"the pictures of {rig.names[view]} are {x} x {y} pixels, and the calibration says {width} x {height};"
        " say how the one became the other, or calibrate the pictures as they are"
    )


_MADE: dict[Kind, Callable[[Finding, Rig, str], str]] = {
    **{Kind.TURNED: _turned, Kind.MOVED: _moved, Kind.LATE: _late, Kind.FOCAL: _focal, Kind.RESIZED: _resized},
    **{Kind.PRINCIPAL_POINT: _principal_point, Kind.DUPLICATE: _duplicate, Kind.UNIT: _unit, Kind.UP: _up},
    **{Kind.NOBODY: _nobody, Kind.PICTURE_SIZE: _sizes},
}


def _shift(x: float, y: float) -> str:
    """A shift in a picture, in words."""
    parts = [(abs(x), "right" if x > 0 else "left"), (abs(y), "down" if y > 0 else "up")]
    told = [f"{size:.0f} px {way}" for size, way in parts if size >= 0.5]
    return " and ".join(told) or "under a pixel"


def _length(metres: float) -> str:
    """A length in a unit that suits it."""
    if metres < 0.01:
        return f"{1e3 * metres:.2g} mm"
    if metres < 1:
        return f"{100 * metres:.0f} cm"
    return f"{metres:.1f} m" if metres < 100 else f"{metres:,.0f} m"
