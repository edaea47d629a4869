"""ROS: a folder of camera_info YAML files, with the pose of every camera beside them. Metres, z up (REP 103).

`<camera>.yaml` is what camera_calibration writes, or an echoed CameraInfo message. `<camera>_pose.yaml` is a Pose,
PoseStamped, Transform or TransformStamped: the camera's optical frame in the world, so world from camera.
"""

from pathlib import Path
from typing import Any

import numpy as np

from shapepose_fg.core.camera import Lens
from shapepose_fg.core.errors import InputError
from shapepose_fg.io.calibration.content import Content, load
from shapepose_fg.io.calibration.written import (
    ONE_CAMERA,
    Format,
    WrittenCamera,
    WrittenRig,
    picture_size,
    pose,
    rotation_of,
)

_LENSES: dict[str, Lens] = {
    **dict.fromkeys(("", "plumb_bob", "rational_polynomial"), "perspective"),
    **dict.fromkeys(("equidistant", "fisheye"), "fisheye"),
}
"""ROS' distortion models that are lenses of OpenCV."""
_POSE_CURE = (
    "write <camera>_pose.yaml with translation x y z and rotation x y z w of the optical frame in the world"
)


def recognise(content: Content) -> bool:
    """Whether this is a camera_info file, or a folder in which there is one."""
    if content.syntax == "folder":
        return any(map(_is_info, _values(content).values()))
    return content.syntax == "YAML" and (_is_info(content.value) or _pose_of(content.value) is not None)


def read(content: Content) -> WrittenRig:
    """The cameras in the order of their files' names."""
    if content.syntax != "folder":
        what = "the intrinsics" if _is_info(content.value) else "the pose"
        raise InputError(
            f"{content.path}: this is {what} of one camera of ROS; give the folder with <camera>.yaml and"
            " <camera>_pose.yaml of every camera"
        )
    values = _values(content)
    poses = {path.stem.removesuffix("_pose"): path for path, value in values.items() if not _is_info(value)}
    cameras = []
    for path, value in values.items():
        if not _is_info(value):
            continue
        name = path.stem.removesuffix("_camera_info").removesuffix("_info")
        if name not in poses:
            raise InputError(
                f'{path.with_name(f"{name}_pose.yaml")}: the pose of camera "{name}" is missing; {_POSE_CURE}'
            )
        cameras.append(_camera(name, path, value, _pose(poses[name], values[poses[name]])))
    return WrittenRig(cameras, "m", "z")


def _values(content: Content) -> dict[Path, Any]:
    """What the YAML files of a folder hold; nothing where one is of another syntax."""
    files = [path for path in content.value if path.suffix in (".yaml", ".yml") and path.is_file()]
    found = {path: load(path) for path in files}
    return {path: each.value if each.syntax == "YAML" else None for path, each in found.items()}


def _is_info(value: Any) -> bool:
    """Whether this is what camera_calibration writes, or a CameraInfo message."""
    known = isinstance(value, dict)
    return known and ("camera_matrix" in value or {"distortion_model", "height", "width"} <= value.keys())


def _camera(name: str, path: Path, value: dict[str, Any], wTc: np.ndarray) -> WrittenCamera:
    model = str(value.get("distortion_model", ""))
    if model not in _LENSES:
        raise InputError(
            f"{path}: distortion_model {model} is not read; use plumb_bob, rational_polynomial or equidistant"
        )
    K = _array(value, ("camera_matrix", "k", "K"), path)
    distortion = _array(value, ("distortion_coefficients", "d", "D"), path)
    width, height = (value.get(f"image_{side}", value.get(side)) for side in ("width", "height"))
    if len(K) != 9:
        raise InputError(f"{path}: camera_matrix must hold 9 numbers, got {len(K)}; {ONE_CAMERA}")
    image_size = picture_size(width, height, str(path))
    return WrittenCamera(name, K.reshape(3, 3), wTc, image_size, distortion.tolist(), _LENSES[model])


def _array(value: dict[str, Any], keys: tuple[str, ...], path: Path) -> np.ndarray:
    """Numbers of the first key that is there: a list, or a map with `data`."""
    found = next((value[key] for key in keys if key in value), None)
    found = found.get("data") if isinstance(found, dict) else found
    try:
        numbers = np.array([float(each) for each in found or ()])
    except (TypeError, ValueError):
        numbers = np.array([np.nan])
    if not np.isfinite(numbers).all():
        raise InputError(f"{path}: {keys[0]} must hold finite numbers; run the calibration again")
    return numbers


def _pose(path: Path, value: Any) -> np.ndarray:
    """World from camera, of a message with translation and rotation."""
    message = _pose_of(value)
    if message is None:
        raise InputError(f"{path}: neither a camera_info nor a pose of ROS; {_POSE_CURE}")
    child = str(value.get("child_frame_id", ""))
    if child and "optical" not in child:
        raise InputError(
            f"{path}: child_frame_id {child} is no optical frame (z forward, x right, y down); give the pose of"
            f" {child}_optical_frame, or whatever the camera's optical frame is called"
        )
    translation, rotation = message
    try:
        t, q = [float(translation[axis]) for axis in "xyz"], [float(rotation[axis]) for axis in "xyzw"]
    except (KeyError, TypeError, ValueError):
        raise InputError(
            f"{path}: translation must have x y z and rotation x y z w, numbers; {_POSE_CURE}"
        ) from None
    R = rotation_of(q, "rotation", str(path))
    return pose(R, t, "rotation", str(path), world_from_camera=True)


def _pose_of(value: Any) -> tuple[Any, Any] | None:
    """Translation and rotation of a pose, however deep its message is stamped."""
    if isinstance(value, dict) and "transforms" in value and isinstance(value["transforms"], list):
        value = value["transforms"][0] if len(value["transforms"]) == 1 else None
    while isinstance(value, dict):
        for translation, rotation in (("position", "orientation"), ("translation", "rotation")):
            if translation in value and rotation in value:
                return value[translation], value[rotation]
        value = value.get("pose", value.get("transform"))
    return None


ROS = Format("ROS' camera_info and pose YAML", recognise, read)
