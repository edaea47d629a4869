"""YAML and XML of OpenCV's FileStorage: OpenCV's own multi-view calibration, files with a node per camera,
EasyMocap's.
"""

from pathlib import Path
from typing import Any

import numpy as np

from shapepose_fg.core.camera import Lens
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.storage.files import MIDDLE, read_text
from shapepose_fg.io.calibration.content import Content
from shapepose_fg.io.calibration.filestorage import load_storage
from shapepose_fg.io.calibration.written import ONE_CAMERA, Format, WrittenCamera, WrittenRig, picture_size, pose

_FISHEYE = 1
"""OpenCV's CALIB_MODEL_FISHEYE."""
_ASK = {
    "unit": "pass --unit, that of the board's squares",
    "up": "pass --up (a board's z points up or down where it lay; -y of a level first camera)",
}
_KEYS = {
    "K": ("camera_matrix", "K", "intrinsic_matrix"),
    "distortion": ("distortion_coefficients", "dist_coeffs", "distortion_vector", "dist", "D"),
    "width": ("image_width", "img_width", "width"),
    "height": ("image_height", "img_height", "height"),
    "R": ("R", "rvec", "rotation_matrix", "rotation"),
    "t": ("T", "t", "tvec", "translation"),
    "pose": ("camera_pose_matrix",),
}
"""Names that programs give to the parts of a camera; `camera_pose_matrix` is MC-Calib's world from camera."""


def recognise_multiview(content: Content) -> bool:
    """Whether this is what OpenCV's multiview_calibration.py saves."""
    return content.syntax == "OpenCV" and {"Rs", "Ts", "Ks"} <= content.value.keys()


def read_multiview(content: Content) -> WrittenRig:
    """OpenCV's multi-view calibration: camera from the first camera, in the unit of the board."""
    path, nodes = content.path, content.value
    Ks, Rs = _stack(nodes, "Ks", path), _stack(nodes, "Rs", path)
    count = len(Ks)
    Ts = _stack(nodes, "Ts", path).reshape(count, -1)
    sizes = _stack(nodes, "image_sizes", path).reshape(count, -1)
    models = np.zeros(count) if nodes.get("models") is None else _stack(nodes, "models", path).ravel()
    if Ks.size != 9 * count or len(Rs) != count or Ts.shape[1] != 3 or sizes.shape[1] != 2 or len(models) != count:
        raise InputError(
            f"{path}: Ks must be 3x3, and Rs, Ts, image_sizes and models hold one entry for each of the {count};"
            " save it with OpenCV's calibration again"
        )
    numbers = _stack(nodes, "distortions", path).ravel()
    fisheye = models == _FISHEYE
    # The coefficients stand one after the other: four of a fisheye, equally many of every other camera.
    plain = (len(numbers) - 4 * fisheye.sum()) / max(1, (~fisheye).sum())
    if plain != int(plain) or plain < 0:
        raise InputError(
            f"{path}: distortions must hold equally many numbers for every camera, got {len(numbers)}"
        )
    ends = np.cumsum(np.where(fisheye, 4, int(plain)))
    ids = nodes.get("cam_ids")
    names = (
        ids.split(",") if isinstance(ids, str) and len(ids.split(",")) == count else list(map(str, range(count)))
    )
    cameras = []
    for index, (name, end) in enumerate(zip(names, ends.tolist(), strict=True)):
        lens: Lens = "fisheye" if fisheye[index] else "perspective"
        coefficients = numbers[end - (4 if fisheye[index] else int(plain)) : end].tolist()
        wTc = pose(Rs[index], Ts[index], "Rs", f'{path}: camera "{name}"')
        width, height = sizes[index].tolist()
        image_size = picture_size(width, height, f"{path}: image_sizes[{index}]")
        cameras.append(WrittenCamera(name, Ks[index].reshape(3, 3), wTc, image_size, coefficients, lens))
    return WrittenRig(cameras, None, None, _ASK)


def recognise_nodes(content: Content) -> bool:
    """Whether every camera has a node, or a file, of its own; also the intrinsics of one camera alone."""
    if content.syntax == "folder":
        files = [path for path in content.value if path.suffix in (".yml", ".yaml", ".xml") and path.is_file()]
        return len(files) > 0 and all(_names_a_camera(read_text(path, most=MIDDLE)) for path in files)
    return content.syntax == "OpenCV"


def read_nodes(content: Content) -> WrittenRig:
    """Cameras by name, of MC-Calib or of hand-written files: K, distortion, picture size and pose."""
    if content.syntax == "folder":
        nodes = {
            path.stem: load_storage(path, read_text(path, most=MIDDLE))
            for path in content.value
            if path.suffix in (".yml", ".yaml", ".xml")
        }
    else:
        nodes = {
            key: value
            for key, value in content.value.items()
            if isinstance(value, dict) and _find(value, "K") is not None
        }
    if len(nodes) == 0:
        named = " ".join(list(content.value)[:5]) if isinstance(content.value, dict) else "nothing"
        raise InputError(f"{content.path}: no camera with a pose here, only {named}; {ONE_CAMERA}")
    cameras = [_camera(name, node, f'{content.path}: camera "{name}"') for name, node in nodes.items()]
    return WrittenRig(cameras, None, None, _ASK)


def _names_a_camera(text: str) -> bool:
    opencv = text.startswith("%YAML:") or "!!opencv-matrix" in text or "<opencv_storage>" in text
    return opencv and any(key in text for key in _KEYS["K"])


def _camera(name: str, node: dict[str, Any], place: str) -> WrittenCamera:
    K = _find(node, "K")
    if not isinstance(K, np.ndarray) or K.size != 9:
        raise InputError(f"{place}: camera_matrix must be a 3x3 matrix; write it with OpenCV's FileStorage")
    width, height = _find(node, "width"), _find(node, "height")
    fisheye = node.get("distortion_type") == 1 or node.get("fisheye") in (1, "true")
    return WrittenCamera(
        name,
        K.reshape(3, 3),
        _pose(node, place),
        picture_size(width, height, place),
        _distortion(node, place),
        "fisheye" if fisheye else "perspective",
    )


def _distortion(node: dict[str, Any], place: str) -> list[float]:
    """Coefficients of the lens: a matrix or a list; none where no key of them is there."""
    key = next((key for key in _KEYS["distortion"] if key in node), None)
    if key is None:
        return []
    try:
        if not isinstance(node[key], np.ndarray | list):
            raise ValueError
        return np.asarray(node[key], dtype=np.float64).ravel().tolist()
    except (TypeError, ValueError):
        raise InputError(
            f"{place}: {key} must be a matrix or a list of numbers; write it with OpenCV's FileStorage, or delete"
            " it where the lens has no distortion"
        ) from None


def _pose(node: dict[str, Any], place: str) -> np.ndarray:
    """World from camera: of a 4x4 pose, or of a camera-from-world rotation and translation."""
    matrix = _find(node, "pose")
    if isinstance(matrix, np.ndarray) and matrix.shape == (4, 4):
        return pose(matrix[:3, :3], matrix[:3, 3], "camera_pose_matrix", place, world_from_camera=True)
    R, t = _find(node, "R"), _find(node, "t")
    if not isinstance(R, np.ndarray) or not isinstance(t, np.ndarray):
        raise InputError(f"{place}: R and T are missing, the camera's pose; {ONE_CAMERA}")
    return pose(R, t, "R", place)


def _find(node: dict[str, Any], part: str) -> Any:
    return next((node[key] for key in _KEYS[part] if key in node), None)


def _stack(nodes: dict[str, Any], key: str, path: object) -> np.ndarray:
    """A matrix, or a list of equal matrices, as one finite array."""
    try:
        values = np.asarray(nodes[key], dtype=np.float64)
        if nodes[key] is None or values.size == 0:
            raise ValueError
    except (KeyError, TypeError, ValueError):
        raise InputError(
            f"{path}: {key} is missing or no array; save it with OpenCV's calibration again"
        ) from None
    if not np.isfinite(values).all():
        raise InputError(f"{path}: {key} holds a number that is not finite; calibrate again")
    return values


def recognise_easymocap(content: Content) -> bool:
    """Whether this is one of the two files, or the folder of both."""
    if content.syntax == "folder":
        return any(_is_part(path.name) for path in content.value)
    there = content.syntax == "OpenCV" and _is_part(content.path.name)
    return there and isinstance(content.value.get("names"), list)


def read_easymocap(content: Content) -> WrittenRig:
    """EasyMocap's intri.yml and extri.yml, metres, z up: the cameras in the order of the names in the
    intrinsics.
    """
    folder = content.syntax == "folder"
    one = next(path for path in content.value if _is_part(path.name)) if folder else content.path
    intri = one.with_name(one.name.replace("extri", "intri"))
    extri = one.with_name(one.name.replace("intri", "extri"))
    for path in (intri, extri):
        if not path.is_file():
            raise InputError(
                f"{path}: this half of EasyMocap's calibration is missing; put both files into one folder"
            )
    inner, outer = (load_storage(path, read_text(path, most=MIDDLE)) for path in (intri, extri))
    names = inner.get("names")
    if not isinstance(names, list) or not all(isinstance(name, str | int) for name in names):
        raise InputError(f"{intri}: names must be a list of the cameras' names; write it with EasyMocap again")
    cameras = [
        _easymocap_camera(str(name), number, inner, outer, intri, extri) for number, name in enumerate(names, 1)
    ]
    return WrittenRig(cameras, "m", "z")


def _is_part(name: str) -> bool:
    return name.endswith((".yml", ".yaml")) and ("intri" in name or "extri" in name)


def _easymocap_camera(
    name: str, number: int, inner: dict[str, Any], outer: dict[str, Any], intri: Path, extri: Path
) -> WrittenCamera:
    # EasyMocap writes K_<name>; Pose2Sim's writer numbers them from 1.
    tags = (name, str(number))
    K = _matrix(inner, "K", tags, 9, intri).reshape(3, 3)
    distortion = _matrix(inner, "dist", tags, None, intri)
    rotation = "Rot" if any(f"Rot_{tag}" in outer for tag in tags) else "R"
    R = _matrix(outer, rotation, tags, 9 if rotation == "Rot" else 3, extri)
    wTc = pose(R, _matrix(outer, "T", tags, 3, extri), f"{rotation}_{name}", str(extri))
    width, height = (inner.get(f"{letter}_{name}") for letter in "WH")
    size = picture_size(width, height, f'{intri}: camera "{name}"')
    return WrittenCamera(name, K, wTc, size, distortion.tolist())


def _matrix(nodes: dict[str, Any], key: str, tags: tuple[str, ...], count: int | None, path: Path) -> np.ndarray:
    """The numbers of the matrix `key`_<tag>, flat."""
    value = next((nodes[f"{key}_{tag}"] for tag in tags if f"{key}_{tag}" in nodes), None)
    if not isinstance(value, np.ndarray) or (count is not None and value.size != count):
        got = f"got {value.size}" if isinstance(value, np.ndarray) else "it is missing"
        wanted = "a matrix" if count is None else f"a matrix of {count} numbers"
        raise InputError(f"{path}: {key}_{tags[0]} must be {wanted}, {got}; write it with EasyMocap again")
    if not np.isfinite(value).all():
        raise InputError(
            f"{path}: {key}_{tags[0]} holds a number that is not finite; write it with EasyMocap again"
        )
    return value.ravel()


EASYMOCAP = Format("EasyMocap's intri.yml and extri.yml", recognise_easymocap, read_easymocap)
MULTIVIEW = Format("OpenCV's multi-view calibration", recognise_multiview, read_multiview)
ONE_NODE_EACH = Format("OpenCV's FileStorage with a node or file per camera", recognise_nodes, read_nodes)
