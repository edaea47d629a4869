"""The cameras of a saved result."""

from pathlib import Path

from shapepose_fg.core.camera import Rig
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.rig_file import CAMERAS
from shapepose_fg.io.calibration import read_rig


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
