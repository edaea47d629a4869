"""Calibrations in JSON of others: 4D Association's, the CMU Panoptic studio's, and VoxelPose's way to write
these.
"""

from typing import Annotated, Any

import numpy as np
from pydantic import AliasChoices, BaseModel, ConfigDict, Field, FiniteFloat

from shapepose_fg.core.errors import InputError
from shapepose_fg.io.calibration.content import Content
from shapepose_fg.io.calibration.written import (
    Format,
    ImageSize,
    Matrix33,
    Row3,
    WrittenCamera,
    WrittenRig,
    intrinsics,
    pose,
)
from shapepose_fg.io.validation import validated

_One = Annotated[list[FiniteFloat], Field(min_length=1, max_length=1)] | FiniteFloat
_Column3 = Annotated[list[_One], Field(min_length=3, max_length=3)]
_Column2 = Annotated[list[_One], Field(min_length=2, max_length=2)]
_ORDER = "write at most k1 k2 p1 p2 k3, as OpenCV orders them"
_ASSOCIATION_CURES = {
    "K": "write the 3x3 intrinsic matrix row by row, in pixels",
    "RT": "write the 3x4 camera-from-world matrix row by row",
    "R": "write the 3x3 camera-from-world rotation row by row, or its 3 numbers axis times angle",
    "T": "write the 3 numbers of the camera-from-world translation",
    "imgSize": "write width and height in pixels",
    **dict.fromkeys(("distCoeff", "dist", "distortion"), _ORDER),
}
_PANOPTIC_CURES = {
    "K": "write the 3x3 intrinsic matrix as three rows, in pixels",
    "R": "write the 3x3 camera-from-world rotation as three rows",
    "resolution": "write width and height in pixels",
    "distCoef": "write k1 k2 p1 p2 k3",
}


class _Association(BaseModel):
    """A camera of Zhang et al., CVPR 2020; keys of other tools are passed over."""

    model_config = ConfigDict(strict=True)
    K: Annotated[list[FiniteFloat], Field(min_length=9, max_length=9)]
    RT: Annotated[list[FiniteFloat], Field(min_length=12, max_length=12)] | None = None
    R: Annotated[list[FiniteFloat], Field(min_length=3, max_length=9)] | None = None
    T: Row3 | None = None
    imgSize: ImageSize
    distortion: Annotated[list[FiniteFloat], Field(max_length=5)] = Field(
        default=[], validation_alias=AliasChoices("distCoeff", "dist", "distortion")
    )


class _Panoptic(BaseModel):
    """A camera of the studio."""

    model_config = ConfigDict(strict=True)
    name: Annotated[str, Field(min_length=1)]
    resolution: ImageSize
    K: Matrix33
    distCoef: Annotated[list[FiniteFloat], Field(max_length=5)] = []
    R: Matrix33
    t: _Column3


class _Voxelpose(BaseModel):
    """A camera of VoxelPose: R (X - T), and distortion in two parts."""

    model_config = ConfigDict(strict=True)
    R: Matrix33
    T: _Column3
    fx: FiniteFloat
    fy: FiniteFloat
    cx: FiniteFloat
    cy: FiniteFloat
    k: _Column3
    p: _Column2


def _is_association(content: Content) -> bool:
    """An object of objects, at least one of which has something of a camera."""
    value = content.value
    if content.syntax != "JSON" or not isinstance(value, dict):
        return False
    keys = {"K", "RT", "R", "T", "imgSize"}
    return all(isinstance(each, dict) for each in value.values()) and any(
        keys & each.keys() for each in value.values()
    )


def _read_association(content: Content) -> WrittenRig:
    """The cameras in the order of the file. The format's own convention is metres, z up."""
    cameras = []
    for name, value in content.value.items():
        place = f'{content.path}: camera "{name}"'
        camera = validated(_Association, value, place, _ASSOCIATION_CURES)
        if camera.RT is not None:
            cTw = np.array(camera.RT).reshape(3, 4)
            wTc = pose(cTw[:, :3], cTw[:, 3], "RT", place)
        elif camera.R is not None and len(camera.R) not in (3, 9):
            raise InputError(
                f"{place}: R must hold 9 values (or 3), got {len(camera.R)}; {_ASSOCIATION_CURES['R']}"
            )
        elif camera.R is not None and camera.T is not None:
            wTc = pose(camera.R, camera.T, "R", place)
        else:
            raise InputError(f"{place}: RT is missing; {_ASSOCIATION_CURES['RT']}")
        width, height = camera.imgSize
        K = np.array(camera.K).reshape(3, 3)
        cameras.append(WrittenCamera(name, K, wTc, (width, height), camera.distortion))
    return WrittenRig(cameras, "m", "z")


def _is_panoptic(content: Content) -> bool:
    """An object with a list of cameras."""
    value = content.value
    if content.syntax != "JSON" or not isinstance(value, dict) or not isinstance(value.get("cameras"), list):
        return False
    return all(isinstance(each, dict) and {"K", "R", "t"} & each.keys() for each in value["cameras"])


def _read_panoptic(content: Content) -> WrittenRig:
    """The studio's own file: centimetres, y down, camera from world."""
    cameras = []
    for index, value in enumerate(content.value["cameras"]):
        place = f"{content.path}: cameras[{index}]"
        camera = validated(_Panoptic, value, place, _PANOPTIC_CURES)
        width, height = camera.resolution
        wTc = pose(camera.R, camera.t, "R", place)
        cameras.append(WrittenCamera(camera.name, np.array(camera.K), wTc, (width, height), camera.distCoef))
    return WrittenRig(cameras, "cm", "-y")


def _voxelpose(content: Content) -> dict[str, Any]:
    """The cameras of a VoxelPose file by name: an object of them, a list, or a list under a sequence's name."""
    value = content.value
    if content.syntax != "JSON":
        return {}
    if isinstance(value, dict) and len(value) == 1 and isinstance(next(iter(value.values())), list):
        value = next(iter(value.values()))
    if isinstance(value, list):
        value = {str(index): camera for index, camera in enumerate(value)}
    if not isinstance(value, dict) or not all(isinstance(each, dict) for each in value.values()):
        return {}
    return value if any("fx" in each and "R" in each for each in value.values()) else {}


def _read_voxelpose(content: Content) -> WrittenRig:
    """Millimetres, z up, T the camera's centre, K for pictures whose size is not written."""
    cameras = []
    for name, value in _voxelpose(content).items():
        place = f'{content.path}: camera "{name}"'
        camera = validated(_Voxelpose, value, place, _PANOPTIC_CURES)
        R = np.array(camera.R)
        wTc = pose(R, -R @ np.array(camera.T).ravel(), "R", place)
        k, p = np.array(camera.k).ravel(), np.array(camera.p).ravel()
        K = intrinsics(camera.fx, camera.fy, camera.cx, camera.cy)
        cameras.append(WrittenCamera(name, K, wTc, None, [k[0], k[1], p[0], p[1], k[2]]))
    return WrittenRig(cameras, "mm", "z")


PANOPTIC = Format("CMU Panoptic's JSON", _is_panoptic, _read_panoptic)
VOXELPOSE = Format("VoxelPose's JSON", lambda content: len(_voxelpose(content)) > 0, _read_voxelpose)
ASSOCIATION = Format(
    "4D Association's calibration.json", _is_association, _read_association, _ASSOCIATION_CURES["K"]
)
