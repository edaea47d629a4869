"""Reads calibration files as a `Rig`: recognises the format, and names values that the user must
give because the file does not define them.

A format of your own is an entry in `FORMATS`, with a function that converts the `Content` of a file
to a `WrittenRig`, or returns None if the file has another format. `xml_files.py` is an example.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import get_args

import numpy as np

from shapepose_fg.core.camera import Axis, Rig, choose
from shapepose_fg.core.errors import InputError, naming
from shapepose_fg.core.rig_file import CAMERAS
from shapepose_fg.core.validation import describe
from shapepose_fg.io.calibration.colmap import COLMAP
from shapepose_fg.io.calibration.content import Content, load
from shapepose_fg.io.calibration.json_and_toml import JSON_AND_TOML
from shapepose_fg.io.calibration.opencv_and_ros import OPENCV, ROS
from shapepose_fg.io.calibration.written import METRES, CalibrationFormat, Unit, WrittenRig
from shapepose_fg.io.calibration.xml_files import QUALISYS, VICON
from shapepose_fg.io.camera_names import listing
from shapepose_fg.io.trajectories import read_trajectory

FORMATS: tuple[CalibrationFormat, ...] = (*JSON_AND_TOML, QUALISYS, VICON, *OPENCV, COLMAP, ROS)
"""All known formats, in the order in which they are tried."""

_MISSING = {
    "unit": "pass --unit m, cm or mm",
    "up": "pass --up with the axis that points up (x -x y -y z -z)",
    "image_size": "pass --image-size WIDTHxHEIGHT, the size of the calibrated pictures in pixels",
}
"""Values that the user can give, and the option for each, in the order of the error message."""


@np.errstate(over="ignore", invalid="ignore")  # from numbers such as 1e300, which are refused
def read_rig(
    path: str | Path,
    *,
    up: Axis | None = None,
    unit: Unit | None = None,
    image_size: tuple[int, int] | None = None,
    cameras: Sequence[str] | None = None,
    without: Sequence[str] = (),
) -> Rig:
    """Read the cameras of a calibration file or folder; the format is recognised by the content.

    The formats are `FORMATS`; docs/calibration_files.md lists their units and up axes. `up` and
    `unit` override the file. `image_size` (width, height) is for formats that do not state the
    size of the pictures. `cameras` are names of the cameras to read, all by default; `without`
    are names of cameras to leave out. InputError, one sentence that names the file, the key and
    the cure, if a required value is given neither by the file nor by the caller. `notes` of the
    rig list what was left out.
    """
    path = Path(path)
    for name, value, known in (("up", up, get_args(Axis)), ("unit", unit, METRES)):
        if value is not None and value not in known:
            raise InputError(f"{name} must be one of {' '.join(known)}, got {value!r}")
    content = load(path)
    if content.syntax == "pickle":
        raise InputError(
            f"{path}: this is a Python pickle (as OpenCap writes), which could run any program "
            "when opened; if you trust it, convert it to a rig file as in docs/calibration_files.md"
        )
    if (known := recognised(content)) is None:
        raise InputError(_unknown(content))
    form, written = known
    with naming(path):
        wanted = choose([camera.name for camera in written.cameras], cameras, without)
    unwanted = [camera.name for camera in written.cameras if camera.name not in wanted]
    one = len(unwanted) == 1
    which = f"camera {listing(unwanted)} is" if one else f"cameras {listing(unwanted)} are"
    requested = [f"{which} left out as requested"] if unwanted else []
    kept = [camera for camera in written.cameras if camera.name in wanted]
    written = replace(written, cameras=kept, notes=[*written.notes, *requested])
    up, unit = up or written.up, unit or written.unit
    sizes_missing = any(camera.image_size is None for camera in written.cameras)
    if image_size is not None and not sizes_missing:
        raise InputError(
            f"{path}: this format ({form.name}) contains the picture sizes; leave out --image-size"
        )
    given = {"unit": unit, "up": up, "image_size": image_size if sizes_missing else True}
    missing = [name for name, value in given.items() if value is None]
    if up is None or unit is None or missing:
        cures = " and ".join(written.cures.get(name, _MISSING[name]) for name in missing)
        names = f"{' and '.join(missing)} {'is' if len(missing) == 1 else 'are'}"
        raise InputError(f"{path}: recognised as {form.name}, where {names} missing; {cures}")
    with naming(path):
        finished = tuple(
            camera.finished(METRES[unit], image_size, path) for camera in written.cameras
        )
        carriers = {camera.carrier for camera in finished}
        trajectories = tuple(each for each in written.trajectories if each.name in carriers)
        notes = tuple(f"{path}: {each}" for each in written.notes)
        return with_first_poses(
            Rig(finished, up, trajectories=trajectories, notes=notes, unwanted=tuple(unwanted))
        )


def cameras_of(folder: Path) -> Rig:
    """The cameras of the result in `folder`; InputError with the cure if there are none."""
    file = folder / CAMERAS
    if not file.exists():
        raise InputError(
            f"{file}: this file with the cameras of the result is missing; write it with "
            "`people.save(folder, rig)` or `write_rig(rig, file)`, or copy the calibration to "
            "this path"
        )
    return read_rig(file)


def recognised(content: Content) -> tuple[CalibrationFormat, WrittenRig] | None:
    """The first format that recognises the content, and its cameras; None for an unknown format.
    InputError if damaged.
    """
    read = ((each, each.read(content)) for each in FORMATS)
    return next(((form, written) for form, written in read if written is not None), None)


def with_first_poses(rig: Rig) -> Rig:
    """The rig with the pose of each moving camera set to the start of its trajectory."""
    if not rig.moves:
        return rig
    first = {each.name: each.wTb[0] for each in rig.trajectories}
    cameras = (
        replace(each, wTc=first[each.carrier] @ each.bTc) if each.carrier else each
        for each in rig.cameras
    )
    return replace(rig, cameras=tuple(cameras))


def with_trajectories(rig: Rig, given: Sequence[str]) -> Rig:
    """The rig with moving cameras as in `given`, a list of `CAMERA=FILE`: the file has the poses of
    the camera itself.

    The calibrated poses of these cameras are ignored. InputError if a file cannot be used.
    """
    cameras, trajectories = {each.name: each for each in rig.cameras}, list(rig.trajectories)
    for each in given:
        name, _, file = each.partition("=")
        if name not in cameras or not file:
            cure = f"write CAMERA=FILE with one of {listing(list(rig.names))}"
            raise InputError(f"--trajectory {each[:80]}: must name a camera and a file; {cure}")
        if cameras[name].carrier or any(
            file == other.partition("=")[2] for other in given if other is not each
        ):
            cure = (
                'give the pose of each camera on its carrier in a rig file, with "trajectory" '
                'and "bTc"'
            )
            raise InputError(
                f"--trajectory {each[:80]}: the camera has a trajectory already, or the file is"
                f" given for another camera, too; {cure}"
            )
        trajectories.append(read_trajectory(file, name))
        cameras[name] = replace(cameras[name], carrier=name, bTc=np.eye(4))
    with naming("--trajectory"):
        return with_first_poses(
            replace(rig, cameras=tuple(cameras.values()), trajectories=tuple(trajectories))
        )


@np.errstate(over="ignore", invalid="ignore")
def is_calibration(path: Path) -> bool:
    """Whether a file or folder has one of the formats; it may be damaged."""
    try:
        content = load(path)
    except InputError:
        return False
    try:
        return content.syntax != "pickle" and recognised(content) is not None
    except InputError:
        return True


def _unknown(content: Content) -> str:
    """A sentence about the actual content of a path that is no calibration, and about the known
    formats.
    """
    value = content.value
    if content.syntax == "folder":
        return (
            f"{content.path}: this is a folder; give the file inside it, or the folder with the "
            "files of EasyMocap, COLMAP or ROS; it contains "
            f"{listing([path.name for path in value])}"
        )
    about = f"<{value.tag}>" if hasattr(value, "tag") else describe(value)
    if isinstance(value, dict):
        about = f"with {' '.join(list(map(str, value))[:5]) or 'nothing'}"
    found = content.syntax if content.syntax == "text" else f"{content.syntax} ({about})"
    known = ", ".join(form.name for form in FORMATS)
    return (
        f"{content.path}: recognised as {found}, but this is not a known calibration format; "
        f"give one of {known} (docs/calibration_files.md)"
    )
