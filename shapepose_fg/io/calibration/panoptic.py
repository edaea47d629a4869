"""JSON of the CMU Panoptic studio, and the way in which VoxelPose and its followers write its cameras."""

from typing import Annotated, Any, TypeVar

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, ValidationError

from shapepose_fg.core.errors import InputError
from shapepose_fg.io.calibration.content import Content
from shapepose_fg.io.calibration.written import (
    Format,
    ImageSize,
    Matrix33,
    WrittenCamera,
    WrittenRig,
    intrinsics,
    pose,
    sentence,
)

_Column3 = Annotated[
    list[Annotated[list[FiniteFloat], Field(min_length=1, max_length=1)] | FiniteFloat],
    Field(min_length=3, max_length=3),
]
_Column2 = Annotated[
    list[Annotated[list[FiniteFloat], Field(min_length=1, max_length=1)] | FiniteFloat],
    Field(min_length=2, max_length=2),
]
_Model = TypeVar("_Model", bound=BaseModel)
_CURES = {
    "K": "write the 3x3 intrinsic matrix as three rows, in pixels",
    "R": "write the 3x3 camera-from-world rotation as three rows",
    "resolution": "write width and height in pixels",
    "distCoef": "write k1 k2 p1 p2 k3",
}


class _Camera(BaseModel):
    """A camera of the studio."""

    model_config = ConfigDict(strict=True)
    name: Annotated[str, Field(min_length=1)]
    resolution: ImageSize
    K: Matrix33
    distCoef: Annotated[list[FiniteFloat], Field(max_length=5)] = []
    R: Matrix33
    t: _Column3


class _CameraWithCentre(BaseModel):
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


def _recognise(content: Content) -> bool:
    """Whether this is an object with a list of cameras."""
    value = content.value
    if content.syntax != "JSON" or not isinstance(value, dict) or not isinstance(value.get("cameras"), list):
        return False
    return all(isinstance(each, dict) and {"K", "R", "t"} & each.keys() for each in value["cameras"])


def _read(content: Content) -> WrittenRig:
    """The studio's own file: centimetres, y down, camera from world."""
    cameras = []
    for index, value in enumerate(content.value["cameras"]):
        place = f"{content.path}: cameras[{index}]"
        camera = _validated(_Camera, value, place)
        width, height = camera.resolution
        wTc = pose(camera.R, camera.t, "R", place)
        cameras.append(WrittenCamera(camera.name, np.array(camera.K), wTc, (width, height), camera.distCoef))
    return WrittenRig(cameras, "cm", "-y")


def _named(content: Content) -> dict[str, Any]:
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


def _read_centres(content: Content) -> WrittenRig:
    """VoxelPose's form: millimetres, z up, T the camera's centre, K for pictures whose size is not written."""
    cameras = []
    for name, value in _named(content).items():
        place = f'{content.path}: camera "{name}"'
        camera = _validated(_CameraWithCentre, value, place)
        R = np.array(camera.R)
        wTc = pose(R, -R @ np.array(camera.T).ravel(), "R", place)
        k, p = np.array(camera.k).ravel(), np.array(camera.p).ravel()
        K = intrinsics(camera.fx, camera.fy, camera.cx, camera.cy)
        cameras.append(WrittenCamera(name, K, wTc, None, [k[0], k[1], p[0], p[1], k[2]]))
    return WrittenRig(cameras, "mm", "z")


def _validated(model: type[_Model], value: Any, place: str) -> _Model:
    try:
        return model.model_validate(value)
    except ValidationError as error:
        raise InputError(sentence(error, place, _CURES)) from None


PANOPTIC = Format("CMU Panoptic's JSON", _recognise, _read)
VOXELPOSE = Format("VoxelPose's JSON", lambda content: len(_named(content)) > 0, _read_centres)
