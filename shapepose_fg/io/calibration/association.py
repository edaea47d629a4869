"""The calibration.json of 4D Association (Zhang et al., CVPR 2020): an object with a member per camera."""

from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import AliasChoices, BaseModel, ConfigDict, Field, FiniteFloat, ValidationError

from shapepose_fg.core.errors import InputError
from shapepose_fg.io.calibration.content import Content
from shapepose_fg.io.calibration.written import Format, ImageSize, Row3, WrittenCamera, WrittenRig, pose, sentence

_CURES = {
    "K": "write the 3x3 intrinsic matrix row by row, in pixels",
    "RT": "write the 3x4 camera-from-world matrix row by row",
    "R": "write the 3x3 camera-from-world rotation row by row, or its 3 numbers axis times angle",
    "T": "write the 3 numbers of the camera-from-world translation",
    "imgSize": "write width and height in pixels",
    "distCoeff": "write at most k1 k2 p1 p2 k3, as OpenCV orders them",
    "dist": "write at most k1 k2 p1 p2 k3, as OpenCV orders them",
    "distortion": "write at most k1 k2 p1 p2 k3, as OpenCV orders them",
}


class _Camera(BaseModel):
    """One camera; keys of other tools are passed over."""

    model_config = ConfigDict(strict=True)
    K: Annotated[list[FiniteFloat], Field(min_length=9, max_length=9)]
    RT: Annotated[list[FiniteFloat], Field(min_length=12, max_length=12)] | None = None
    R: Annotated[list[FiniteFloat], Field(min_length=3, max_length=9)] | None = None
    T: Row3 | None = None
    imgSize: ImageSize
    distortion: Annotated[list[FiniteFloat], Field(max_length=5)] = Field(
        default=[], validation_alias=AliasChoices("distCoeff", "dist", "distortion")
    )


def recognise(content: Content) -> bool:
    """Whether this is an object of objects, at least one of which has something of a camera."""
    value = content.value
    if content.syntax != "JSON" or not isinstance(value, dict):
        return False
    if not all(isinstance(each, dict) for each in value.values()):
        return False
    return any({"K", "RT", "R", "T", "imgSize"} & camera.keys() for camera in value.values())


def read(content: Content) -> WrittenRig:
    """The cameras in the order of the file. The format's own convention is metres, z up."""
    cameras = [_camera(name, value, content.path) for name, value in content.value.items()]
    return WrittenRig(cameras, "m", "z")


def _camera(name: str, value: dict[str, Any], path: Path) -> WrittenCamera:
    place = f'{path}: camera "{name}"'
    try:
        camera = _Camera.model_validate(value)
    except ValidationError as error:
        raise InputError(sentence(error, place, _CURES)) from None
    if camera.RT is not None:
        cTw = np.array(camera.RT).reshape(3, 4)
        wTc = pose(cTw[:, :3], cTw[:, 3], "RT", place)
    elif camera.R is not None and camera.T is not None and len(camera.R) in (3, 9):
        wTc = pose(camera.R, camera.T, "R", place)
    elif camera.R is not None and len(camera.R) not in (3, 9):
        raise InputError(f"{place}: R must hold 9 values (or 3), got {len(camera.R)}; {_CURES['R']}")
    else:
        raise InputError(f"{place}: RT is missing; {_CURES['RT']}")
    width, height = camera.imgSize
    return WrittenCamera(name, np.array(camera.K).reshape(3, 3), wTc, (width, height), camera.distortion)


ASSOCIATION = Format("4D Association's calibration.json", recognise, read, _CURES["K"])
