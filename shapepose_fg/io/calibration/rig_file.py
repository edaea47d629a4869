"""Our own rig file: all that a `Rig` is, in JSON, written and read back to the last digit."""

import json
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat

from shapepose_fg.core.camera import Axis, Lens, Rig
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.storage.files import write_content
from shapepose_fg.io.calibration.content import Content
from shapepose_fg.io.calibration.written import (
    Format,
    ImageSize,
    Matrix33,
    Unit,
    WrittenCamera,
    WrittenRig,
    pose,
)
from shapepose_fg.io.validation import describe, validated

RIG_FORMAT = "shapepose-fg rig 1"
"""The tag by which a rig file of our own is known."""

_Row4 = Annotated[list[FiniteFloat], Field(min_length=4, max_length=4)]
_CURES = {
    "K": "write the 3x3 intrinsic matrix row by row, in pixels",
    "image_size": "write width and height in pixels",
    "distortion": "write k1 k2 p1 p2 k3 and what follows as OpenCV orders them, or k1 to k4 of a fisheye",
    "lens": "write perspective or fisheye",
    "wTc": "write the 4x4 world-from-camera matrix as four rows",
    "cTw": "write the 3x4 camera-from-world matrix as three rows",
}


def write_rig(rig: Rig, path: str | Path) -> None:
    """Write `rig` as a rig file of our own, which `read_rig` reads back to the last digit."""
    cameras = [
        {
            "name": camera.name,
            "image_size": list(camera.image_size),
            "K": camera.K.tolist(),
            "lens": camera.lens,
            "distortion": camera.distortion.tolist(),
            "wTc": camera.wTc.tolist(),
        }
        for camera in rig.cameras
    ]
    content = {"format": RIG_FORMAT, "unit": "m", "up": rig.up, "cameras": cameras}
    write_content(Path(path), json.dumps(content, indent=1, allow_nan=False))


class _Camera(BaseModel):
    model_config = ConfigDict(strict=True, extra="forbid")
    name: Annotated[str, Field(min_length=1)]
    image_size: ImageSize
    K: Matrix33
    lens: Lens = "perspective"
    distortion: Annotated[list[FiniteFloat], Field(max_length=14)] = []
    wTc: Annotated[list[_Row4], Field(min_length=4, max_length=4)] | None = None
    cTw: Annotated[list[_Row4], Field(min_length=3, max_length=3)] | None = None


class _Rig(BaseModel):
    model_config = ConfigDict(strict=True, extra="forbid")
    format: Literal["shapepose-fg rig 1"]
    unit: Unit | None = None
    up: Axis | None = None
    cameras: list[_Camera]


def recognise(content: Content) -> bool:
    """Whether this is an object with a format."""
    return content.syntax == "JSON" and isinstance(content.value, dict) and "format" in content.value


def read(content: Content) -> WrittenRig:
    """The cameras, in order, and what the file says about the world."""
    path = content.path
    if content.value["format"] != RIG_FORMAT:
        got = describe(content.value["format"])
        raise InputError(f'{path}: format must be "{RIG_FORMAT}", got {got}; this version reads no other')
    rig = validated(_Rig, content.value, path, _CURES)
    cures = {
        "up": 'say which axis points up, "up": "z", or pass --up z',
        "unit": 'say what lengths are in, "unit": "m", or pass --unit m',
    }
    return WrittenRig(
        [_camera(camera, f'{path}: camera "{camera.name}"') for camera in rig.cameras], rig.unit, rig.up, cures
    )


def _camera(camera: _Camera, place: str) -> WrittenCamera:
    if (camera.wTc is None) == (camera.cTw is None):
        raise InputError(f"{place}: give exactly one of wTc and cTw; {_CURES['wTc']}")
    if camera.wTc is not None:
        wTc = np.array(camera.wTc)
        if np.any(wTc[3] != (0, 0, 0, 1)):
            raise InputError(f"{place}: the last row of wTc must be 0 0 0 1; {_CURES['wTc']}")
        wTc = pose(wTc[:3, :3], wTc[:3, 3], "wTc", place, world_from_camera=True)
    else:
        cTw = np.array(camera.cTw)
        wTc = pose(cTw[:, :3], cTw[:, 3], "cTw", place)
    width, height = camera.image_size
    return WrittenCamera(camera.name, np.array(camera.K), wTc, (width, height), camera.distortion, camera.lens)


RIG_FILE = Format("our own rig file", recognise, read, _CURES["K"])
