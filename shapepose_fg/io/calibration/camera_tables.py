"""TOML with a table per camera, as AniPose began it and Pose2Sim, FreeMoCap and Caliscope write it.

`rotation` and `translation` are camera-from-world in all of them. They differ in what is known of the world.
"""

from collections.abc import Mapping
from functools import partial
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat

from shapepose_fg.core.camera import Axis
from shapepose_fg.io.calibration.content import Content
from shapepose_fg.io.calibration.written import Format, Matrix33, Row3, Unit, WrittenCamera, WrittenRig, pose
from shapepose_fg.io.validation import validated

_UP = (
    "pass the axis of the world that points up with --up; the world is often the first camera, whose -y is up"
    " where it stood level"
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
    return any("cam_id" in table or "port" in table for table in _tables(content).values())


def _is_freemocap(content: Content) -> bool:
    metadata = content.value.get("metadata", {}) if len(_tables(content)) > 0 else {}
    return isinstance(metadata, dict) and any(key.startswith(("charuco_", "freemocap")) for key in metadata)


def _is_pose2sim(content: Content) -> bool:
    """Pose2Sim says of every camera that it is no fisheye; AniPose says it of fisheyes only."""
    tables = _tables(content)
    return len(tables) > 0 and all(table.get("fisheye") is False for table in tables.values())


def _read(content: Content, unit: Unit | None, up: Axis | None, cures: Mapping[str, str]) -> WrittenRig:
    """The cameras that are not to be ignored, in the order of the file."""
    cameras = []
    for key, table in _tables(content).items():
        if table.get("ignore") is True:
            continue
        place = f'{content.path}: camera "{key}"'
        camera = validated(_Camera, table, place, _CURES)
        # Caliscope's videos are called cam_0.mp4, those of its older versions port_0.mp4.
        numbered = None if camera.cam_id is None else f"cam_{camera.cam_id}"
        numbered = f"port_{camera.port}" if camera.port is not None else numbered
        width, height = camera.size
        cameras.append(
            WrittenCamera(
                camera.name or numbered or key,
                np.array(camera.matrix),
                pose(camera.rotation, camera.translation, "rotation", place),
                (round(width), round(height)),
                camera.distortions,
                "fisheye" if camera.fisheye else "perspective",
            )
        )
    return WrittenRig(cameras, unit, up, cures)


_FREEMOCAP = {"unit": "pass --unit (FreeMoCap works in mm)", "up": _UP}
_ANIPOSE = {"unit": "pass --unit, that of the board's squares", "up": _UP}
CAMERA_TABLES = (
    Format("Caliscope's TOML", _is_caliscope, partial(_read, unit="m", up=None, cures={"up": _UP})),
    Format("FreeMoCap's TOML", _is_freemocap, partial(_read, unit=None, up=None, cures=_FREEMOCAP)),
    Format("Pose2Sim's TOML", _is_pose2sim, partial(_read, unit="m", up="z", cures={})),
    Format(
        "AniPose's TOML",
        lambda content: len(_tables(content)) > 0,
        partial(_read, unit=None, up=None, cures=_ANIPOSE),
    ),
)
"""The dialects; the first that recognises a file reads it. AniPose's world is one that nothing levels, in the unit
of the board; FreeMoCap's is the first camera."""
