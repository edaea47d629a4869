"""TOML with a table per camera, as AniPose began it and Pose2Sim, FreeMoCap and Caliscope write it.

`rotation` and `translation` are camera-from-world in all of them. They differ in what is known of the world.
"""

from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, ValidationError

from shapepose_fg.core.errors import InputError
from shapepose_fg.io.calibration.content import Content
from shapepose_fg.io.calibration.written import Format, Matrix33, Row3, WrittenCamera, WrittenRig, pose, sentence

_OWN_AXES = (
    "the axis of the world that points up with --up; the world is often the first camera, whose -y is up where it"
    " stood level"
)
_CURES = {
    "matrix": "write the 3x3 intrinsic matrix as three rows, in pixels",
    "size": "write width and height in pixels",
    "distortions": "write k1 k2 p1 p2 k3, or k1 to k4 of a fisheye",
    "rotation": "calibrate the extrinsics of this camera too, or delete its table",
    "translation": "calibrate the extrinsics of this camera too, or delete its table",
}


class _Camera(BaseModel):
    """One table; keys of single programs are passed over."""

    model_config = ConfigDict(strict=True)
    name: str | None = None
    cam_id: int | None = None
    port: int | None = None
    ignore: bool = False
    size: Annotated[list[Annotated[FiniteFloat, Field(gt=0)]], Field(min_length=2, max_length=2)]
    matrix: Matrix33
    distortions: Annotated[list[FiniteFloat], Field(max_length=14)] = []
    rotation: Row3 | Matrix33
    translation: Row3
    fisheye: bool = False


def _tables(content: Content) -> dict[str, dict[str, Any]]:
    """The tables of cameras, by their keys; none where this is another TOML."""
    if content.syntax != "TOML":
        return {}
    inner = content.value.get("cameras")
    tables = inner if isinstance(inner, dict) else content.value
    return {key: table for key, table in tables.items() if isinstance(table, dict) and "matrix" in table}


def _is_caliscope(content: Content) -> bool:
    tables = _tables(content)
    return len(tables) > 0 and any("cam_id" in table or "port" in table for table in tables.values())


def _is_freemocap(content: Content) -> bool:
    metadata = content.value.get("metadata", {}) if len(_tables(content)) > 0 else {}
    return isinstance(metadata, dict) and any(key.startswith(("charuco_", "freemocap")) for key in metadata)


def _is_pose2sim(content: Content) -> bool:
    """Pose2Sim says of every camera that it is no fisheye; AniPose says it of fisheyes only."""
    tables = _tables(content)
    return len(tables) > 0 and all(table.get("fisheye") is False for table in tables.values())


def _is_anipose(content: Content) -> bool:
    return len(_tables(content)) > 0


def _cameras(content: Content) -> list[WrittenCamera]:
    """The cameras that are not to be ignored, in the order of the file."""
    cameras = [_camera(key, table, content.path) for key, table in _tables(content).items()]
    return [camera for camera in cameras if camera is not None]


def _camera(key: str, table: dict[str, Any], path: Path) -> WrittenCamera | None:
    if table.get("ignore") is True:
        return None
    place = f'{path}: camera "{key}"'
    try:
        camera = _Camera.model_validate(table)
    except ValidationError as error:
        raise InputError(sentence(error, place, _CURES)) from None
    # Caliscope's videos are called cam_0.mp4, those of its older versions port_0.mp4.
    numbered = None if camera.cam_id is None else f"cam_{camera.cam_id}"
    numbered = f"port_{camera.port}" if camera.port is not None else numbered
    width, height = camera.size
    return WrittenCamera(
        camera.name or numbered or key,
        np.array(camera.matrix),
        pose(camera.rotation, camera.translation, "rotation", place),
        (round(width), round(height)),
        camera.distortions,
        "fisheye" if camera.fisheye else "perspective",
    )


def _read_caliscope(content: Content) -> WrittenRig:
    """Caliscope: metres."""
    return WrittenRig(_cameras(content), "m", None, {"up": f"pass {_OWN_AXES}"})


def _read_freemocap(content: Content) -> WrittenRig:
    """FreeMoCap: the file names no unit, and its world is the first camera."""
    cures = {"unit": "pass --unit (FreeMoCap works in mm)", "up": f"pass {_OWN_AXES}"}
    return WrittenRig(_cameras(content), None, None, cures)


def _read_pose2sim(content: Content) -> WrittenRig:
    """Pose2Sim: metres, z up."""
    return WrittenRig(_cameras(content), "m", "z")


def _read_anipose(content: Content) -> WrittenRig:
    """AniPose: in the unit in which the board was given, in a world that nothing levels."""
    cures = {"unit": "pass --unit, that of the board's squares", "up": f"pass {_OWN_AXES}"}
    return WrittenRig(_cameras(content), None, None, cures)


CAMERA_TABLES = (
    Format("Caliscope's TOML", _is_caliscope, _read_caliscope),
    Format("FreeMoCap's TOML", _is_freemocap, _read_freemocap),
    Format("Pose2Sim's TOML", _is_pose2sim, _read_pose2sim),
    Format("AniPose's TOML", _is_anipose, _read_anipose),
)
"""The dialects; the first that recognises a file reads it."""
