"""Calibrations in JSON (our own rig file, 4D Association, CMU Panoptic, VoxelPose) and TOML in
AniPose's style.
"""

import re
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, Field

from shapepose_fg.core.camera import Axis
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.lens import Lens
from shapepose_fg.core.rig_file import RIG_FORMAT
from shapepose_fg.core.storage.files import is_inside
from shapepose_fg.core.trajectory import DRIFT, Trajectory
from shapepose_fg.core.validation import describe, validated
from shapepose_fg.io.calibration.content import Content
from shapepose_fg.io.calibration.written import (
    CalibrationFormat,
    Node,
    Unit,
    WrittenCamera,
    WrittenRig,
    intrinsics,
)
from shapepose_fg.io.trajectories import read_trajectory

_MATRIX = "write the 3x3 intrinsic matrix row by row, in pixels"
_CAMERA_FROM_WORLD = "write the 3x4 camera-from-world matrix row by row"
_ROTATION = "write the 3x3 camera-from-world rotation row by row"
_EXTRINSICS = "calibrate the extrinsics of this camera, too, or delete its table"
_SIZE = "write width and height in pixels"
_CURES = {
    **{
        "K": _MATRIX,
        "matrix": _MATRIX,
        "RT": _CAMERA_FROM_WORLD,
        "cTw": _CAMERA_FROM_WORLD,
        "R": _ROTATION,
    },
    **{"bTc": "write the 4x4 carrier-from-camera matrix row by row"},
    **{"wTo": "write the 4x4 matrix from the trajectory's world to the cameras' world, metres"},
    **{"drift": "write the odometry's error as a share of the distance travelled, such as 0.01"},
    **{
        "T": "write the 3 numbers of the translation",
        "wTc": "write the 4x4 world-from-camera matrix row by row",
    },
    **dict.fromkeys(("rotation", "translation"), _EXTRINSICS),
    **dict.fromkeys(("imgSize", "resolution", "size", "image_size"), _SIZE),
    **dict.fromkeys(
        ("distCoeff", "dist", "distCoef"), "write at most k1 k2 p1 p2 k3, as OpenCV orders them"
    ),
    **dict.fromkeys(
        ("distortion", "distortions"),
        "write k1 k2 p1 p2 k3 as OpenCV does, or k1 to k4 of fisheyes",
    ),
    "lens": "write perspective or fisheye",
}
"""Advice for error messages, by the name of the value in any of the formats."""


class _Camera(BaseModel, strict=True, extra="forbid"):
    """A camera of a rig file; its values are checked later, as in all formats."""

    name: Annotated[str, Field(min_length=1)]
    image_size: Any
    K: Any
    lens: Lens = "perspective"
    distortion: Any = None
    wTc: Any = None
    cTw: Any = None
    bTc: Any = None
    trajectory: Annotated[str, Field(min_length=1)] | None = None
    readout_s: float = 0.0


class _Trajectory(BaseModel, strict=True, extra="forbid"):
    drift: Annotated[float, Field(gt=0, le=1)] = DRIFT
    refined: bool = False
    wTo: Any = None


class _Rig(BaseModel, strict=True, extra="forbid"):
    format: Literal["shapepose-fg rig 1"]
    unit: Unit | None = None
    up: Axis | None = None
    cameras: list[_Camera]
    trajectories: dict[str, _Trajectory] = {}


def _members(content: Content) -> dict[str, Any]:
    """The object in a JSON file; empty if the file has another value."""
    return content.value if content.syntax == "JSON" and isinstance(content.value, dict) else {}


def _read_rig_file(content: Content) -> WrittenRig | None:
    """Read this project's rig file, which has all fields of a `Rig`."""
    if "format" not in _members(content):
        return None
    if content.value["format"] != RIG_FORMAT:
        got = describe(content.value["format"])
        raise InputError(
            f'{content.path}: format must be "{RIG_FORMAT}", got {got}; this version cannot read '
            "others"
        )
    rig = validated(_Rig, content.value, content.path, _CURES)
    cures = {
        "up": 'write the axis that points up, such as "up": "z", or pass --up z',
        "unit": 'write the unit of lengths, such as "unit": "m", or pass --unit m',
    }
    cameras = []
    for camera in rig.cameras:
        node = Node(vars(camera), f'{content.path}: camera "{camera.name}"', _CURES)
        given = [key for key in ("wTc", "cTw", "trajectory") if getattr(camera, key) is not None]
        if len(given) != 1 or (camera.bTc is not None and camera.trajectory is None):
            moves = "or, of a moving camera, trajectory and bTc"
            raise InputError(
                f"{node.place}: give exactly one of wTc and cTw, {moves}; {_CURES['wTc']}"
            )
        if camera.trajectory is not None:
            wTc = np.eye(4) if camera.bTc is None else node.pose_of_matrix("bTc")
        else:
            wTc = node.pose_of_rows("cTw") if camera.wTc is None else node.pose_of_matrix("wTc")
        one = node.camera(camera.name, "K", wTc, ["image_size"], "distortion", camera.lens)
        cameras.append(replace(one, readout_s=camera.readout_s, trajectory=camera.trajectory or ""))
    named = dict.fromkeys(camera.trajectory for camera in cameras if camera.trajectory)
    trajectories = [_trajectory(content.path, name, rig.trajectories.get(name)) for name in named]
    return WrittenRig(cameras, rig.unit, rig.up, cures, trajectories)


def _trajectory(path: Path, name: str, about: _Trajectory | None) -> Trajectory:
    """Read the trajectory in the file `name` beside the rig file; poses in the world of the rig."""
    if Path(name).is_absolute() or not is_inside(path.parent, name):
        raise InputError(
            f"{path}: trajectory {name[:80]} must be in the folder of the rig file or below; "
            "move it there"
        )
    about = _Trajectory() if about is None else about
    found = read_trajectory(path.parent / name, name)
    node = Node({"wTo": about.wTo}, f'{path}: trajectory "{name}"', _CURES)
    wTo = np.eye(4) if about.wTo is None else node.pose_of_matrix("wTo")
    return replace(found, wTb=wTo @ found.wTb, drift=about.drift, refined=about.refined)


def entries(content: Content) -> dict[str, dict[str, Any]]:
    """The cameras in a JSON file by name, or by number if they are in a list: of the whole file,
    under `cameras`, or under the only key. Empty if the file has other values.
    """
    value = content.value if content.syntax == "JSON" else None
    if isinstance(value, dict):
        own = [value["cameras"]] if "cameras" in value else list(value.values())
        value = own[0] if len(own) == 1 and isinstance(own[0], list) else value
    if isinstance(value, list):
        value = {str(index): camera for index, camera in enumerate(value)}
    if isinstance(value, dict) and all(isinstance(each, dict) for each in value.values()):
        return value
    return {}


def _nodes(content: Content, cures: Mapping[str, str] = _CURES) -> list[tuple[str, Node]]:
    """The name and the values of each of the `entries`."""
    return [
        (name, Node(values, f'{content.path}: camera "{name}"', cures))
        for name, values in entries(content).items()
    ]


def _read_association(content: Content) -> WrittenRig | None:
    """4D Association (Zhang et al., CVPR 2020): an object of cameras, metres, z up; keys of other
    tools are ignored.
    """
    keys = {key for each in entries(content).values() for key in each}
    if not keys & {"K", "RT", "R", "T", "imgSize"}:
        return None
    cameras = []
    for name, node in _nodes(content):
        turned = node.named("RT") is None and node.named("R") is not None
        wTc = node.pose("R", "T") if turned else node.pose_of_rows("RT")
        bend = "distCoeff dist distortion"
        cameras.append(node.camera(name, "K", wTc, ["imgSize"], bend, most=5))
    return WrittenRig(cameras, "m", "z")


def _read_panoptic(content: Content) -> WrittenRig | None:
    """CMU's studio file: a list of cameras, centimetres, y down, camera from world."""
    listed = entries(content).values() if "cameras" in _members(content) else ()
    if not listed or not all({"K", "R", "t"} & each.keys() for each in listed):
        return None
    cameras = []
    for _, node in _nodes(content):
        if not isinstance(name := node.values.get("name"), str):
            raise node.refuse("name", f"must be text, got {describe(name)}")
        cameras.append(
            node.camera(name, "K", node.pose("R", "t"), ["resolution"], "distCoef", most=5)
        )
    if "calibDataSource" in content.value or any(
        {"type", "panel", "node"} & each.keys() for each in listed
    ):
        return WrittenRig(cameras, "cm", "-y")
    return WrittenRig(
        cameras, None, None, {"unit": "pass --unit (CMU Panoptic uses cm)", "up": _UP}
    )


def _read_voxelpose(content: Content) -> WrittenRig | None:
    """VoxelPose: an object or list of cameras, possibly under the name of a sequence; mm, z up, R
    (X - T), distortion in two parts.
    """
    if not any("fx" in each and "R" in each for each in entries(content).values()):
        return None
    cameras = []
    for name, node in _nodes(content, {"": "write it in VoxelPose's format"}):
        fx, fy, cx, cy = (float(node.needed(key, 1)[0]) for key in ("fx", "fy", "cx", "cy"))
        (k1, k2, k3), (p1, p2) = node.needed("k", 3).tolist(), node.needed("p", 2).tolist()
        wTc = node.pose("R", "T", centre=True)
        K, bend = intrinsics(fx, fy, cx, cy), [k1, k2, p1, p2, k3]
        cameras.append(WrittenCamera(name, K, wTc, None, bend))
    return WrittenRig(cameras, "mm", "z")


def _program(tables: Mapping[str, dict[str, Any]], metadata: Mapping[str, Any]) -> str:
    """Identify the program that wrote a TOML file by features that only this program writes;
    AniPose by default.

    Pose2Sim writes picture sizes as floats, and `fisheye = false` at the end. Caliscope writes
    `cam_id` or `port` into its own file; in its file for AniPose, cameras have the names of their
    tables, [cam_0], and the error is 0.
    """
    every = list(tables.values())
    if any("cam_id" in table or "port" in table for table in every):
        return "Caliscope"
    if any(key.startswith(_FREEMOCAP) for key in metadata) or any(
        "world_position" in table for table in every
    ):
        return "FreeMoCap"
    if all(table.get("fisheye") is False for table in every) and all(
        list(table)[-1] == "fisheye" or _floats(table.get("size")) for table in every
    ):
        return "Pose2Sim"
    called = all(
        _CALISCOPE_KEY.fullmatch(key) and table.get("name") == key for key, table in tables.items()
    )
    return "Caliscope" if called and metadata == {"adjusted": False, "error": 0.0} else "AniPose"


def _floats(value: Any) -> bool:
    return isinstance(value, list) and all(isinstance(each, float) for each in value)


_CALISCOPE_KEY = re.compile(r"cam_\d+")
_FREEMOCAP = ("charuco_", "freemocap", "groundplane_", "solver_method", "board")
"""Prefixes of names in [metadata] that only FreeMoCap writes; the last three since its version
2."""


def _unit_and_up_of_freemocap(metadata: Mapping[str, Any]) -> tuple[Unit | None, Axis | None]:
    """Unit and up axis of FreeMoCap's files, if its version wrote them: the board's size in mm; z
    is up if the board was on the floor.
    """
    board = metadata.get("board")
    sizes = [*metadata, *(board if isinstance(board, dict) else ())]
    grounded = any(
        metadata.get(key) is True for key in ("groundplane_applied", "groundplane_calibration")
    )
    return ("mm" if any(key.endswith("_length_mm") for key in sizes) else None), (
        "z" if grounded else None
    )


def _tables(value: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """The tables of cameras in a TOML file, by key."""
    inner = value.get("cameras")
    every = inner if isinstance(inner, dict) else value
    return {
        key: table for key, table in every.items() if isinstance(table, dict) and "matrix" in table
    }


def wanted_tables(value: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """The tables of cameras that are read: without ignored ones, and, if any camera has a pose,
    only those with a pose.
    """
    tables = {
        key: table for key, table in _tables(value).items() if table.get("ignore") is not True
    }
    return {key: table for key, table in tables.items() if _POSE & table.keys()} or tables


def _read_tables(content: Content, program: str) -> WrittenRig | None:
    """Read cameras from TOML tables: camera from world. Ignored cameras, and keys of single
    programs, are left out.
    """
    tables = _tables(content.value) if content.syntax == "TOML" else {}
    metadata = content.value.get("metadata") if len(tables) > 0 else None
    metadata = metadata if isinstance(metadata, dict) else {}
    if len(tables) == 0 or _program(tables, metadata) != program:
        return None
    cameras, notes, wanted = [], list[str](), wanted_tables(content.value)
    for key, table in tables.items():
        if key not in wanted:
            why = "it is marked as ignored" if table.get("ignore") is True else "it has no pose"
            notes.append(f"camera {table.get('name') or key} is left out: {why}")
            continue
        node = Node(table, f'{content.path}: camera "{key}"', _CURES)
        # Caliscope's videos are called cam_0.mp4; in older versions port_0.mp4.
        kinds = (("port", "port"), ("cam", "cam_id"))
        numbered = next((f"{kind}_{table[k]}" for kind, k in kinds if k in table), key)
        fisheye, wTc = table.get("fisheye", False), node.pose("rotation", "translation")
        if not isinstance(fisheye, bool):
            raise node.refuse("fisheye", f"must be true or false, got {describe(fisheye)}")
        name, lens = str(table.get("name") or numbered), "fisheye" if fisheye else "perspective"
        cameras.append(node.camera(name, "matrix", wTc, ["size"], "distortions", lens))
    unit, up, cures = _DIALECTS[program]
    if program == "FreeMoCap":
        unit, up = _unit_and_up_of_freemocap(metadata)
    return WrittenRig(cameras, unit, up, cures, notes=notes)


_POSE = {"rotation", "translation"}
_UP = "pass the world axis that points up with --up; it is often -y if the first camera was level"
_DIALECTS: dict[str, tuple[Unit | None, Axis | None, dict[str, str]]] = {
    "Caliscope": ("m", None, {"up": _UP}),
    "FreeMoCap": (None, None, {"unit": "pass --unit (FreeMoCap works in mm)", "up": _UP}),
    "Pose2Sim": ("m", "z", {}),
    "AniPose": (None, None, {"unit": "pass --unit, the unit of the board's squares", "up": _UP}),
}
"""Unit, up axis and advice for errors, by program. AniPose's world frame is not levelled and has
the unit of the board; FreeMoCap's world frame is the first camera."""
JSON_AND_TOML = (
    CalibrationFormat("rig file", _read_rig_file),
    CalibrationFormat("CMU Panoptic's JSON", _read_panoptic),
    CalibrationFormat("VoxelPose's JSON", _read_voxelpose),
    CalibrationFormat("4D Association's calibration.json", _read_association),
    *(
        CalibrationFormat(f"{program}'s TOML", partial(_read_tables, program=program))
        for program in _DIALECTS
    ),
)
