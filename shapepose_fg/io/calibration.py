"""Where the cameras stand: calibration files of several formats to one `Rig`, and our own format written."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import AliasChoices, BaseModel, ConfigDict, Field, FiniteFloat, ValidationError

from shapepose_fg.camera import Axis, Camera, Rig
from shapepose_fg.errors import InputError
from shapepose_fg.files import read_json, write_atomically
from shapepose_fg.io.validation import describe, first_problem, key_text

Unit = Literal["m", "cm", "mm"]
"""The unit of lengths in a calibration file."""

RIG_FORMAT = "shapepose-fg rig 1"
"""The tag by which a rig file of our own is known."""

_METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001}
_ROTATION_TOLERANCE = 1e-3
"""How far R Rᵀ may be from the identity: calibrations are printed with four to six digits."""
_EXACT = 1e-12
"""Below this a rotation is left as written, so that a rig that is written and read stays the same."""

Pixels = Annotated[int, Field(gt=0, strict=False)]
Numbers9 = Annotated[list[FiniteFloat], Field(min_length=9, max_length=9)]
Numbers12 = Annotated[list[FiniteFloat], Field(min_length=12, max_length=12)]
Row3 = Annotated[list[FiniteFloat], Field(min_length=3, max_length=3)]
Row4 = Annotated[list[FiniteFloat], Field(min_length=4, max_length=4)]
Distortion = Annotated[list[FiniteFloat], Field(max_length=5)]
ImageSize = Annotated[list[Pixels], Field(min_length=2, max_length=2)]


def read_rig(path: str | Path, *, up: Axis | None = None, unit: Unit | None = None) -> Rig:
    """Read the cameras of a calibration file; its format is told by its content.

    Two formats are known (docs/conventions.md): the calibration.json of 4D Association, which is in metres
    with z up, and our own rig file, which says both. `up` and `unit` overrule the file. Raises InputError,
    one sentence that names the file, the key and the cure.
    """
    path = Path(path)
    if up is not None and up not in get_args(Axis):
        raise InputError(f"up must be one of {' '.join(get_args(Axis))}, got {up!r}")
    if unit is not None and unit not in _METRES:
        raise InputError(f"unit must be one of {' '.join(_METRES)}, got {unit!r}")
    content = read_json(path)
    if isinstance(content, dict) and "format" in content:
        cameras, up, unit = _read_own(content, path, up, unit)
    elif _looks_like_association(content):
        # The format's own convention: metres, z up.
        cameras, up, unit = _read_association(content, path), up or "z", unit or "m"
    else:
        raise InputError(
            f"{path}: this is not a calibration that is known here; give the calibration.json of"
            f' 4D Association, or a rig file with "format": "{RIG_FORMAT}" (docs/conventions.md)'
        )
    try:
        return Rig(tuple(_scaled(camera, _METRES[unit]) for camera in cameras), up)
    except ValueError as error:
        raise InputError(f"{path}: {error}") from None


def write_rig(rig: Rig, path: str | Path) -> None:
    """Write `rig` as a rig file of our own, which `read_rig` reads back to the last digit."""
    cameras = [
        {
            "name": camera.name,
            "image_size": list(camera.image_size),
            "K": camera.K.tolist(),
            "distortion": camera.distortion.tolist(),
            "wTc": camera.wTc.tolist(),
        }
        for camera in rig.cameras
    ]
    content = {"format": RIG_FORMAT, "unit": "m", "up": rig.up, "cameras": cameras}
    text = json.dumps(content, indent=1, allow_nan=False)
    write_atomically(Path(path), lambda stream: stream.write(text.encode()))


class _AssociationCamera(BaseModel):
    """One camera of a 4D Association calibration; keys of other tools are passed over."""

    model_config = ConfigDict(strict=True)
    K: Numbers9
    RT: Numbers12 | None = None
    R: Annotated[list[FiniteFloat], Field(min_length=3, max_length=9)] | None = None
    T: Row3 | None = None
    imgSize: ImageSize
    distortion: Distortion = Field(default=[], validation_alias=AliasChoices("distCoeff", "dist", "distortion"))


class _OwnCamera(BaseModel):
    """One camera of our own rig file."""

    model_config = ConfigDict(strict=True, extra="forbid")
    name: Annotated[str, Field(min_length=1)]
    image_size: ImageSize
    K: Annotated[list[Row3], Field(min_length=3, max_length=3)]
    distortion: Distortion = []
    wTc: Annotated[list[Row4], Field(min_length=4, max_length=4)] | None = None
    cTw: Annotated[list[Row4], Field(min_length=3, max_length=3)] | None = None


class _OwnRig(BaseModel):
    """Our own rig file."""

    model_config = ConfigDict(strict=True, extra="forbid")
    format: Literal["shapepose-fg rig 1"]
    unit: Unit | None = None
    up: Axis | None = None
    cameras: list[_OwnCamera]


_CURES = {
    "K": "write the 3x3 intrinsic matrix row by row, in pixels",
    "RT": "write the 3x4 camera-from-world matrix row by row",
    "R": "write the 3x3 camera-from-world rotation row by row, or its 3 numbers axis times angle",
    "T": "write the 3 numbers of the camera-from-world translation",
    "imgSize": "write width and height in pixels",
    "image_size": "write width and height in pixels",
    "distCoeff": "write at most k1 k2 p1 p2 k3, as OpenCV orders them",
    "dist": "write at most k1 k2 p1 p2 k3, as OpenCV orders them",
    "distortion": "write at most k1 k2 p1 p2 k3, as OpenCV orders them",
    "wTc": "write the 4x4 world-from-camera matrix as four rows",
    "cTw": "write the 3x4 camera-from-world matrix as three rows",
}


def _looks_like_association(content: Any) -> bool:
    """Whether this is an object of objects, at least one of which has something of a camera."""
    if not isinstance(content, dict) or not all(isinstance(value, dict) for value in content.values()):
        return False
    return any({"K", "RT", "R", "T", "imgSize"} & camera.keys() for camera in content.values())


def _read_association(content: dict[str, Any], path: Path) -> list[Camera]:
    """Cameras of a 4D Association calibration, in the order of the file, translations as written."""
    return [_association_camera(name, value, path) for name, value in content.items()]


def _association_camera(name: str, value: dict[str, Any], path: Path) -> Camera:
    place = f'{path}: camera "{name}"'
    try:
        camera = _AssociationCamera.model_validate(value)
    except ValidationError as error:
        raise InputError(_sentence(error, place)) from None
    if camera.RT is not None:
        cTw = np.array(camera.RT).reshape(3, 4)
    elif camera.R is not None and camera.T is not None and len(camera.R) in (3, 9):
        R = cv2.Rodrigues(np.array(camera.R))[0] if len(camera.R) == 3 else np.reshape(camera.R, (3, 3))
        cTw = np.column_stack([R, camera.T])
    elif camera.R is not None and len(camera.R) not in (3, 9):
        raise InputError(f"{place}: R must hold 9 values (or 3), got {len(camera.R)}; {_CURES['R']}")
    else:
        raise InputError(f"{place}: RT is missing; {_CURES['RT']}")
    _check_rotation(cTw[:, :3], "RT" if camera.RT is not None else "R", place)
    width, height = camera.imgSize
    try:
        K = np.array(camera.K).reshape(3, 3)
        return Camera.from_camera_from_world(name, K, cTw, (width, height), camera.distortion)
    except ValueError as error:
        raise InputError(f"{path}: {error}; {_CURES['K']}") from None


def _read_own(
    content: dict[str, Any], path: Path, up: Axis | None, unit: Unit | None
) -> tuple[list[Camera], Axis, Unit]:
    """Cameras of our own rig file, in order, and what it or the user says about the world."""
    if content["format"] != RIG_FORMAT:
        got = describe(content["format"])
        raise InputError(f'{path}: format must be "{RIG_FORMAT}", got {got}; this version reads no other')
    try:
        rig = _OwnRig.model_validate(content)
    except ValidationError as error:
        raise InputError(_sentence(error, str(path))) from None
    up, unit = up or rig.up, unit or rig.unit
    if up is None:
        raise InputError(f'{path}: up is missing; say which axis points up, "up": "z", or pass --up z')
    if unit is None:
        raise InputError(f'{path}: unit is missing; say what lengths are in, "unit": "m", or pass --unit m')
    return [_own_camera(camera, f'{path}: camera "{camera.name}"', path) for camera in rig.cameras], up, unit


def _own_camera(camera: _OwnCamera, place: str, path: Path) -> Camera:
    if (camera.wTc is None) == (camera.cTw is None):
        raise InputError(f"{place}: give exactly one of wTc and cTw; {_CURES['wTc']}")
    if camera.wTc is not None:
        wTc = np.array(camera.wTc)
        if np.any(wTc[3] != (0, 0, 0, 1)):
            raise InputError(f"{place}: the last row of wTc must be 0 0 0 1; {_CURES['wTc']}")
        _check_rotation(wTc[:3, :3], "wTc", place)
    else:
        cTw = np.array(camera.cTw)
        _check_rotation(cTw[:, :3], "cTw", place)
        wTc = np.eye(4)
        wTc[:3, :3] = _nearest_rotation(cTw[:, :3]).T
        wTc[:3, 3] = -wTc[:3, :3] @ cTw[:, 3]
    wTc[:3, :3] = _nearest_rotation(wTc[:3, :3])
    distortion = np.zeros(5)
    distortion[: len(camera.distortion)] = camera.distortion
    width, height = camera.image_size
    try:
        return Camera(camera.name, np.array(camera.K), wTc, (width, height), distortion)
    except ValueError as error:
        raise InputError(f"{path}: {error}; {_CURES['K']}") from None


def _check_rotation(R: NDArray[np.float64], key: str, place: str) -> None:
    """Refuse a rotation that is scaled, sheared or mirrored."""
    with np.errstate(over="ignore", invalid="ignore"):  # of numbers like 1e300, which are refused here
        off = np.abs(R @ R.T - np.eye(3)).max()
    if not off <= _ROTATION_TOLERANCE:
        raise InputError(
            f"{place}: the rotation of {key} is not orthonormal (R Rᵀ is off by {off:.2g});"
            " give a pure rotation without scale, row by row"
        )
    if np.linalg.det(R) < 0:
        raise InputError(
            f"{place}: the rotation of {key} mirrors (determinant -1); use a right-handed world and"
            " OpenCV's camera axes: x right, y down, z forward"
        )


def _nearest_rotation(R: NDArray[np.float64]) -> NDArray[np.float64]:
    """The orthonormal matrix nearest to `R`, or `R` itself where that is as good as exact."""
    if np.abs(R @ R.T - np.eye(3)).max() < _EXACT:
        return R
    U, _, Vt = np.linalg.svd(R)
    return U @ Vt


def _scaled(camera: Camera, metres: float) -> Camera:
    """The same camera with its translation times `metres` (length of the file's unit)."""
    wTc = camera.wTc.copy()
    wTc[:3, 3] *= metres
    return Camera(camera.name, camera.K, wTc, camera.image_size, camera.distortion)


def _sentence(error: ValidationError, place: str) -> str:
    """The first problem of `error` at `place`, with the cure for its key."""
    keys, problem = first_problem(error)
    return f"{place}: {key_text(keys)} {problem}; {_cure(keys)}"


def _cure(keys: Sequence[int | str]) -> str:
    """What to do about the innermost key that has a cure."""
    known = [_CURES[key] for key in reversed(keys) if key in _CURES]
    return known[0] if known else "see docs/conventions.md for the format"
