"""OpenCV's FileStorage (multi-view calibration, a node per camera, EasyMocap), and ROS camera_info
files.
"""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from shapepose_fg.core.arrays import Array
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.lens import Lens
from shapepose_fg.core.storage.files import SMALL
from shapepose_fg.io.calibration.content import Content, load
from shapepose_fg.io.calibration.written import (
    CalibrationFormat,
    Node,
    WrittenCamera,
    WrittenRig,
    pose,
    rotation_of,
)

_ASK = {
    "unit": "pass --unit, the unit of the board's squares",
    "up": "pass --up (z or -z if the board lay on the floor; -y if the first camera was level)",
}
_ONE_CAMERA = "give the calibration of the whole rig, intrinsics and poses"
_AGAIN = {"": "save it with OpenCV's calibration tool again"}
_STORAGE = {"": "write it with OpenCV's FileStorage"}
_EASYMOCAP = {"": "write it with EasyMocap again"}

_STEREO = {"": "save it as OpenCV's stereo_calib sample does"}
_HALF = "this is only one file of OpenCV's stereo calibration"
_STEREO_UP = (
    "pass the axis of the first camera that points up with --up; it is -y if that camera was level"
)
_SIDES = (("1", "2"), ("left", "right"), ("l", "r"), ("0", "1"))
_MATRICES = ("m", "k", "cameramatrix", "camera_matrix", "mtx", "intrinsic", "intrinsic_matrix")
_BENDS = (
    "d",
    "distcoeffs",
    "dist_coeffs",
    "distortion_coefficients",
    "distortion",
    "dist",
    "distcoeff",
)
"""Lower-case names of the distortion coefficients of a stereo pair."""
_GAP = ("none", "null", "")
"""Names that EasyMocap uses for empty places in its list of cameras."""

INTRINSIC, TURN, SHIFT = (
    "camera_matrix K intrinsic_matrix",
    "R rvec rotation_matrix rotation",
    "T t tvec translation",
)
BEND = "distortion_coefficients dist_coeffs distortion_vector dist D"
_SIZE = "image_width img_width width", "image_height img_height height"
POSE = "camera_pose_matrix"
"""MC-Calib's name of the world-from-camera matrix."""


def _loaded(content: Content, suffixes: str) -> dict[Path, Content]:
    """The files of a folder with these suffixes."""
    return {
        path: load(path)
        for path in content.value
        if path.suffix in suffixes.split() and path.is_file()
    }


def _read_multiview(content: Content) -> WrittenRig | None:
    """File saved by OpenCV's multiview_calibration.py: poses from the first camera, in the unit of
    the board.
    """
    if content.syntax != "OpenCV" or not {"Rs", "Ts", "Ks"} <= content.value.keys():
        return None
    nodes = Node(content.value, str(content.path), _AGAIN)
    flat = nodes.needed("Ks", most=SMALL)
    count = len(flat) // 9
    if count == 0 or len(flat) != 9 * count:
        raise nodes.refuse("Ks", "must hold 9 numbers per camera")
    Ks = flat.reshape(count, 3, 3)
    Rs, Ts = (
        nodes.needed("Rs", 9 * count, 3 * count).reshape(count, -1),
        nodes.needed("Ts", 3 * count),
    )
    sizes = nodes.needed("image_sizes", 2 * count).reshape(count, 2)
    models, ids = nodes.numbers("models", count), content.value.get("cam_ids")
    fisheye = np.zeros(count, dtype=bool) if models is None else models == cv2.CALIB_MODEL_FISHEYE
    numbers = nodes.needed("distortions", most=SMALL)
    # All coefficients are in one list: four per fisheye camera, and an equal number for each other
    # camera.
    plain = (len(numbers) - 4 * fisheye.sum()) / max(1, (~fisheye).sum())
    if plain != int(plain) or plain < 0:
        raise nodes.refuse(
            "distortions",
            f"must hold the same number of values for every camera, got {len(numbers)}",
        )
    ends = np.cumsum(np.where(fisheye, 4, int(plain)))
    names = ids.split(",") if isinstance(ids, str) else []
    names = names if len(names) == count else [str(index) for index in range(count)]
    cameras = []
    for index, coefficients in enumerate(np.split(numbers, ends[:-1])):
        lens: Lens = "fisheye" if fisheye[index] else "perspective"
        wTc = pose(
            Rs[index], Ts.reshape(count, 3)[index], "Rs", f'{content.path}: camera "{names[index]}"'
        )
        width, height = sizes[index].tolist()
        size = round(width), round(height)
        cameras.append(
            WrittenCamera(names[index], Ks[index], wTc, size, coefficients.tolist(), lens)
        )
    return WrittenRig(cameras, None, None, _ASK)


def _read_stereo(content: Content) -> WrittenRig | None:
    """Two cameras as saved by OpenCV's stereo sample: M1 D1 M2 D2, and R T from the first to the
    second.

    They are in one file, or in intrinsics.yml and extrinsics.yml. M may be called K or
    cameraMatrix; 1 and 2 may be left and right. The world frame is the first camera, in the unit of
    the board.
    """
    values, places = dict[str, Any](), [content.path]
    if content.syntax in ("OpenCV", "YAML", "JSON") and isinstance(content.value, dict):
        values = {str(key).lower(): each for key, each in content.value.items()}
        halves = [
            path
            for path in content.path.parent.glob("*.y*ml")
            if re.match("(in|ex)trinsics?$", path.stem)
        ]
        places += [path for path in halves if path.name != content.path.name and len(halves) == 2]
        places = places if content.path in halves else places[:1]
    elif content.syntax == "folder":
        places = [
            path for path in content.value if re.match(r"(in|ex)trinsics?\.(ya?ml|xml)$", path.name)
        ]
    for path in places if content.syntax == "folder" else places[1:]:
        half = load(path).value
        values |= (
            {str(key).lower(): each for key, each in half.items()} if isinstance(half, dict) else {}
        )
    sides = next((each for each in _SIDES if _of_side(values, _MATRICES, each[0])), None)
    where = str(content.path)
    if sides is None or not _of_side(values, _MATRICES, sides[1]):
        if {"r", "t"} <= values.keys() and {"q", "p1"} & values.keys():
            raise InputError(f"{where}: {_HALF}; put intrinsics.yml with M1 D1 M2 D2 beside it")
        return None
    node = Node(values, where, _STEREO)
    if node.named("r") is None or node.named("t") is None:
        raise InputError(f"{where}: {_HALF}; put extrinsics.yml with R and T beside it")
    size = (
        [["image_size", "imagesize", "img_size"]]
        if node.named("image_size imagesize img_size")
        else _SIZE
    )
    cameras = []
    for side, wTc in zip(sides, (np.eye(4), node.pose("r", "t")), strict=True):
        K, bend = (
            _of_side(values, names, side) or names[0] + side for names in (_MATRICES, _BENDS)
        )
        cameras.append(node.camera(side, [K], wTc, size, [bend]))
    note = f"OpenCV's stereo calibration: the cameras are named {sides[0]} and {sides[1]}"
    return WrittenRig(cameras, None, None, _ASK | {"up": _STEREO_UP}, notes=[note])


def _of_side(values: Mapping[str, Any], names: Sequence[str], side: str) -> str | None:
    """The key of one of `names` for one side of a stereo pair: m1, m_1, or 1_m."""
    keys = (key for name in names for key in (f"{name}{side}", f"{name}_{side}", f"{side}_{name}"))
    return next((key for key in keys if values.get(key) is not None), None)


def _read_nodes(content: Content) -> WrittenRig | None:
    """One node or file per camera (MC-Calib or hand-written): K, distortion, size and pose."""
    nodes = content.value if content.syntax == "OpenCV" else {}
    if content.syntax == "folder":
        files = _loaded(content, ".yml .yaml .xml").values()
        nodes = {each.path.stem: each.value if each.syntax == "OpenCV" else None for each in files}
    known = {
        name: node
        for name, node in nodes.items()
        if isinstance(node, dict) and Node(node, "").named(INTRINSIC)
    }
    if content.syntax != "OpenCV" and (len(known) == 0 or len(known) < len(nodes)):
        return None
    cameras = []
    for name, values in known.items():
        node = Node(values, f'{content.path}: camera "{name}"', _STORAGE)
        if node.named(POSE) is not None:
            wTc = node.pose_of_matrix(POSE)
        elif node.named(TURN) is None or node.named(SHIFT) is None:
            raise InputError(
                f"{node.place}: R and T, the camera's pose, are missing; {_ONE_CAMERA}"
            )
        else:
            wTc = node.pose(TURN, SHIFT)
        fisheye = values.get("distortion_type") == 1 or values.get("fisheye") in (1, "true")
        lens: Lens = "fisheye" if fisheye else "perspective"
        cameras.append(node.camera(name, INTRINSIC, wTc, _SIZE, BEND, lens))
    if len(cameras) == 0:
        named = " ".join(list(content.value)[:5]) or "nothing"
        if Node(content.value, "").named(INTRINSIC) is not None:
            what = "this file has the intrinsics of one camera only"
            raise InputError(
                f"{content.path}: {what}; {_ONE_CAMERA}, for example a file per camera with R and T"
            )
        raise InputError(
            f"{content.path}: there is no camera with a pose, only {named}; {_ONE_CAMERA}"
        )
    return WrittenRig(cameras, None, None, _ASK)


def _named(inner: Node, name: str) -> bool:
    """Whether a camera of EasyMocap has intrinsics under its name."""
    return inner.named([f"K_{name}"]) is not None


def _read_easymocap(content: Content) -> WrittenRig | None:
    """EasyMocap's intri.yml and extri.yml, metres, z up; the cameras in the order of `names` in
    intri.yml.
    """
    paths = content.value if content.syntax == "folder" else [content.path]
    halves_of = [path for path in paths if re.search(r"(intri|extri).*\.ya?ml$", path.name)]
    values = [content.value] if content.syntax == "OpenCV" else []
    values += [load(path).value for path in halves_of] if content.syntax == "folder" else []
    named = any(isinstance(value, dict) and "names" in value for value in values)
    if len(halves_of) == 0 or not (
        named or any(path.stem in ("intri", "extri") for path in halves_of)
    ):
        return None
    one = halves_of[0]
    halves = []
    for path in (
        one.with_name(one.name.replace("extri", "intri")),
        one.with_name(one.name.replace("intri", "extri")),
    ):
        if not path.is_file():
            raise InputError(
                f"{path}: this file of EasyMocap's calibration is missing; put both into one folder"
            )
        value = load(path).value
        halves.append(Node(value if isinstance(value, dict) else {}, str(path), _EASYMOCAP))
    inner, outer = halves
    names = inner.values.get("names")
    if not isinstance(names, list) or not all(isinstance(name, str | int | None) for name in names):
        raise inner.refuse("names", "must be a list of the cameras' names")
    # EasyMocap marks gaps in its list of cameras with this name, and ignores them.
    wanted = [
        str(name) for name in names if str(name).lower() not in _GAP or _named(inner, str(name))
    ]
    cameras = []
    for number, name in enumerate(wanted, 1):
        # EasyMocap writes K_<name>; Pose2Sim's writer numbers the cameras from 1.
        def tagged(kind: str, name: str = name, number: int = number) -> list[str]:
            return [f"{kind}_{name}", f"{kind}_{number}"]

        R = outer.numbers(tagged("Rot"), 9)
        R = outer.needed(tagged("R"), 3) if R is None else R
        wTc = pose(R, outer.needed(tagged("T"), 3), f"R_{name}", outer.place)
        inner.needed(tagged("dist"), most=14)
        size = [[f"W_{name}"], [f"H_{name}"]]
        cameras.append(inner.camera(name, tagged("K"), wTc, size, tagged("dist")))
    return WrittenRig(cameras, "m", "z")


_LENSES: dict[str, Lens] = {
    **dict.fromkeys(("", "plumb_bob", "rational_polynomial"), "perspective"),
    **dict.fromkeys(("equidistant", "fisheye"), "fisheye"),
}
"""ROS distortion models that OpenCV supports."""
_POSE_CURE = (
    "write <camera>_pose.yaml with translation and rotation (x y z w) of the optical frame in "
    "the world"
)


def is_info(value: Any) -> bool:
    """Whether the content is a file of ROS camera_calibration, or an echoed CameraInfo message."""
    known = isinstance(value, dict)
    return known and (
        "camera_matrix" in value or {"distortion_model", "height", "width"} <= value.keys()
    )


def _read_ros(content: Content) -> WrittenRig | None:
    """ROS camera files, sorted by name; metres, z up (REP 103).

    `<camera>.yaml` is camera_info. `<camera>_pose.yaml` is a Pose, PoseStamped, Transform or
    TransformStamped: the pose of the camera's optical frame in the world (world from camera).
    """
    if content.syntax == "YAML" and (
        is_info(content.value) or message_of(content.value) is not None
    ):
        what = "the intrinsics" if is_info(content.value) else "the pose"
        cure = "give the folder with <camera>.yaml and <camera>_pose.yaml of every camera"
        raise InputError(f"{content.path}: this file has {what} of one camera of ROS only; {cure}")
    files = _loaded(content, ".yaml .yml") if content.syntax == "folder" else {}
    values: dict[Path, Any] = {
        path: each.value if each.syntax == "YAML" else None for path, each in files.items()
    }
    if not any(map(is_info, values.values())):
        return None
    poses = {
        path.stem.removesuffix("_pose"): path
        for path, value in values.items()
        if not is_info(value)
    }
    cameras = []
    for path, value in values.items():
        if not is_info(value):
            continue
        name = path.stem.removesuffix("_camera_info").removesuffix("_info")
        if name not in poses:
            missing = path.with_name(f"{name}_pose.yaml")
            raise InputError(f'{missing}: the pose of camera "{name}" is missing; {_POSE_CURE}')
        wTc = _ros_pose(poses[name], values[poses[name]])
        model = str(value.get("distortion_model", ""))
        if model not in _LENSES:
            raise InputError(
                f"{path}: distortion_model {model} is not supported; use plumb_bob, "
                "rational_polynomial or equidistant"
            )
        # A matrix is a list of values, or an object with the list under `data`.
        plain = {
            key: each.get("data") if isinstance(each, dict) else each for key, each in value.items()
        }
        node = Node(plain, str(path), {"": "run the calibration again"})
        size = "image_width width", "image_height height"
        found = node.camera(
            name, "camera_matrix k K", wTc, size, "distortion_coefficients d D", _LENSES[model]
        )
        cameras.append(found)
    return WrittenRig(cameras, "m", "z")


def _ros_pose(path: Path, value: Any) -> Array:
    """World from camera, from a message with translation and rotation."""
    message = message_of(value)
    if message is None:
        raise InputError(f"{path}: this is neither a camera_info nor a pose of ROS; {_POSE_CURE}")
    child = str(value.get("child_frame_id", ""))
    if child and "optical" not in child:
        raise InputError(
            f"{path}: child_frame_id {child} is not an optical frame (x right, y down, z "
            f"forward); give the pose of the optical frame, such as {child}_optical_frame"
        )

    def of(part: Any, word: str, axes: str) -> list[float]:
        node = Node(part if isinstance(part, Mapping) else {}, f"{path}: {word}", {"": _POSE_CURE})
        return [float(node.needed(axis, 1)[0]) for axis in axes]

    t, q = of(message[0], "translation", "xyz"), of(message[1], "rotation", "xyzw")
    return pose(
        rotation_of(q, "rotation", str(path)), t, "rotation", str(path), world_from_camera=True
    )


def message_of(value: Any) -> tuple[Any, Any] | None:
    """Translation and rotation of a pose message, nested in stamped messages of any depth."""
    if isinstance(value, dict) and isinstance(value.get("transforms"), list):
        value = value["transforms"][0] if len(value["transforms"]) == 1 else None
    while isinstance(value, dict):
        for translation, rotation in (("position", "orientation"), ("translation", "rotation")):
            if translation in value and rotation in value:
                return value[translation], value[rotation]
        value = value.get("pose", value.get("transform"))
    return None


OPENCV = (
    CalibrationFormat("EasyMocap's intri.yml and extri.yml", _read_easymocap),
    CalibrationFormat("OpenCV's multi-view calibration", _read_multiview),
    CalibrationFormat("OpenCV's stereo calibration", _read_stereo),
    CalibrationFormat("OpenCV's FileStorage with a node or file per camera", _read_nodes),
)
ROS = CalibrationFormat("ROS' camera_info and pose YAML", _read_ros)
