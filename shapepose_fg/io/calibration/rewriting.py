"""Replaces the values of cameras in existing calibration files: XML, YAML of OpenCV and ROS,
COLMAP's text.

Each function returns the new texts of the files by path. Values that cannot be written are left
unchanged; the caller reads the files back to check them.
"""

import re
import xml.etree.ElementTree as ET
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
from numpy.typing import ArrayLike

from shapepose_fg.core.camera import HALF_PIXEL, Camera, Rig
from shapepose_fg.core.storage.files import read_text
from shapepose_fg.io.calibration.colmap import COLMAP, FILES, MODELS
from shapepose_fg.io.calibration.content import Content, load
from shapepose_fg.io.calibration.opencv_and_ros import (
    BEND,
    INTRINSIC,
    OPENCV,
    POSE,
    ROS,
    SHIFT,
    TURN,
    is_info,
    message_of,
)
from shapepose_fg.io.calibration.xml_files import (
    DISTORTION,
    NEXUS_CAMERAS,
    QTM_CAMERAS,
    QUALISYS,
    SUBPIXEL,
    TO_OPENCV,
    VICON,
    chosen,
    scale_of,
)

Files = dict[Path, str]


def _numbers(values: ArrayLike) -> str:
    return " ".join(repr(float(value)) for value in np.ravel(values))


def _set(element: ET.Element | None, names: str, values: ArrayLike) -> None:
    """Set numeric attributes `names` of an XML element to `values`."""
    if element is not None:
        for name, value in zip(names.split(), np.ravel(values).tolist(), strict=True):
            element.set(name, repr(value))


def _qualisys(content: Content, rig: Rig, metres: float) -> Files:
    for element, camera in zip(chosen(content.value, *QTM_CAMERAS), rig.cameras, strict=True):
        scale = scale_of(element)
        window = element.find("fov_video")
        first = [
            float("nan") if window is None else float(window.get(side, "nan"))
            for side in ("left", "top")
        ]
        _set(
            element.find("transform"),
            "r11 r12 r13 r21 r22 r23 r31 r32 r33",
            TO_OPENCV @ camera.cTw[:, :3],
        )
        _set(element.find("transform"), "x y z", camera.centre / metres)
        inner, K = element.find("intrinsic"), camera.K / scale
        _set(inner, "focalLengthU focalLengthV", SUBPIXEL * K[[0, 1], [0, 1]])
        _set(inner, "centerPointU centerPointV", SUBPIXEL * (K[:2, 2] + first))
        _set(inner, DISTORTION, camera.distortion[:5])
    return {content.path: ET.tostring(content.value, encoding="unicode")}


def _vicon(content: Content, rig: Rig, metres: float) -> Files:
    from scipy.spatial.transform import Rotation

    for element, camera in zip(chosen(content.value, *NEXUS_CAMERAS), rig.cameras, strict=True):
        frame = element.find("KeyFrames/KeyFrame")
        if frame is None:
            continue
        frame.set("FOCAL_LENGTH", repr(float(camera.K[0, 0])))
        frame.set("PRINCIPAL_POINT", _numbers(camera.K[:2, 2]))
        frame.set("ORIENTATION", _numbers(Rotation.from_matrix(camera.cTw[:, :3]).as_quat()))
        frame.set("POSITION", _numbers(camera.centre / metres))
        words = frame.get("VICON_RADIAL2", "").split()
        if len(words) >= 3:  # a name, a centre, and radial coefficients
            frame.set(
                "VICON_RADIAL2", " ".join([*words[:3], _numbers(camera.distortion[[0, 1, 4]])])
            )
    return {content.path: ET.tostring(content.value, encoding="unicode")}


def _storage(path: Path, value: Callable[[tuple[str, ...], int], ArrayLike | None]) -> str:
    """The text of a FileStorage with new matrices: `value(keys, count)` returns a new matrix or
    None; keys are the outermost first, after the name of the file.
    """
    ending = ".xml" if path.suffix.lower() == ".xml" else ".yml"
    storage = cv2.FileStorage(ending, cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)

    def write(keys: tuple[str, ...], node: Any) -> None:
        if isinstance(node, dict):
            storage.startWriteStruct(keys[-1], cv2.FILE_NODE_MAP)
            for key, each in node.items():
                write((*keys, key), each)
            storage.endWriteStruct()
        elif isinstance(node, list):
            storage.startWriteStruct(keys[-1], cv2.FILE_NODE_SEQ)
            for each in node:
                write((*keys, ""), each)
            storage.endWriteStruct()
        else:
            new = value(keys, node.size) if isinstance(node, np.ndarray) else None
            if new is not None and np.size(new) == node.size:
                node = np.reshape(new, node.shape)
            storage.write(keys[-1], node)

    for key, node in load(path).value.items():
        write((path.stem, key), node)
    return storage.releaseAndGetString()


def numbers_of(name: str, camera: Camera, metres: float, count: int) -> ArrayLike | None:
    """The `count` values of a camera that programs store under `name`; None for unknown names."""
    R, cTw, wTc = camera.cTw[:, :3], camera.cTw.copy(), camera.wTc.copy()
    cTw[:, 3] /= metres
    wTc[:3, 3] /= metres
    kinds = {
        f"{INTRINSIC} matrix": camera.K,
        TURN: R if count == 9 else cv2.Rodrigues(R)[0],
        SHIFT: cTw[:, 3],
    }
    kinds |= {"RT cTw": cTw, f"{POSE} wTc": wTc}
    kinds |= {
        f"{BEND} distortion distortions distCoeff distCoef": np.r_[camera.distortion, np.zeros(14)][
            :count
        ]
    }
    return next((each for names, each in kinds.items() if name in names.split()), None)


def _opencv(content: Content, rig: Rig, metres: float) -> Files:
    """Rewrite a FileStorage: matrices of all cameras; of the camera whose name or number is the
    suffix of the matrix's name (EasyMocap); or of the camera after which the node or file is named.
    """
    V, tags = len(rig), {str(n): camera for n, camera in enumerate(rig.cameras, 1)}
    tags |= (cameras := dict(zip(rig.names, rig.cameras, strict=True)))
    tagged = {"K": INTRINSIC, "dist": BEND, "R": TURN, "Rot": TURN, "T": SHIFT}
    of_all = {"Ks": INTRINSIC, "Rs": TURN, "Ts": SHIFT, "distortions": BEND}

    def value(keys: tuple[str, ...], count: int) -> ArrayLike | None:
        (parent, key), (name, _, tag) = keys[-2:], keys[-1].partition("_")
        if name in tagged and tag in tags:
            return numbers_of(tagged[name].split()[0], tags[tag], metres, count)
        if parent in cameras or key not in of_all:
            return numbers_of(key, cameras[parent], metres, count) if parent in cameras else None
        # Four coefficients per fisheye camera, and an equal number for each other camera.
        kind, four = (
            of_all[key],
            [key == "distortions" and camera.lens == "fisheye" for camera in rig.cameras],
        )
        each, rest = divmod(count - 4 * sum(four), max(V - sum(four), 1))
        counts = zip(rig.cameras, [4 if short else each for short in four], strict=True)
        numbers = [numbers_of(kind.split()[0], camera, metres, own) for camera, own in counts]
        return np.concatenate([np.ravel(np.asarray(own)) for own in numbers]) if rest == 0 else None

    whole = content.syntax == "folder"
    beside = content.value if whole else list(content.path.parent.iterdir())
    files = {path for path in beside if re.fullmatch(r"(intri|extri)\.ya?ml", path.name)}
    files = files if whole or content.path in files else {content.path}
    files |= {path for path in beside if path.stem in cameras} if whole else set()
    try:
        return {path: _storage(path, value) for path in sorted(files)}
    except cv2.error:  # a value that OpenCV itself would not write
        return {}


def _ros(content: Content, rig: Rig, metres: float) -> Files:
    from scipy.spatial.transform import Rotation

    files, cameras = dict[Path, str](), dict(zip(rig.names, rig.cameras, strict=True))
    for path in content.value:
        if path.suffix not in (".yaml", ".yml"):
            continue
        value: Any = load(path).value
        name = path.stem.removesuffix("_pose").removesuffix("_camera_info").removesuffix("_info")
        camera = cameras.get(name)
        if camera is not None and is_info(value):
            P = np.column_stack([camera.K, np.zeros(3)])
            kinds = {"camera_matrix k K": camera.K, "projection_matrix p P": P}
            kinds |= {"distortion_coefficients d D": camera.distortion}
            for key in [key for names in kinds for key in names.split() if key in value]:
                new = next(each for names, each in kinds.items() if key in names.split())
                old = value[key]["data"] if isinstance(value[key], dict) else value[key]
                numbers = np.r_[np.ravel(new), np.zeros(14)][: np.size(old)].tolist()
                value[key] = (
                    value[key] | {"data": numbers} if isinstance(value[key], dict) else numbers
                )
        elif camera is not None and (parts := message_of(value)) is not None:
            turn = Rotation.from_matrix(camera.wTc[:3, :3]).as_quat()
            for part, axes, numbers in zip(
                parts, ("xyz", "xyzw"), (camera.centre / metres, turn), strict=True
            ):
                part |= dict(zip(axes, numbers.tolist(), strict=True))
        else:
            continue
        files[path] = yaml.safe_dump(value, sort_keys=False, default_flow_style=None, width=1000)
    return files


def _colmap(content: Content, rig: Rig, metres: float) -> Files:
    from scipy.spatial.transform import Rotation

    folder = content.path if content.syntax == "folder" else content.path.parent
    inner, outer = (read_text(folder / name).splitlines() for name in FILES)
    cameras, place, of = list(rig.cameras), 0, dict[str, Camera]()
    for number, line in enumerate(outer):
        words = line.split(maxsplit=9)
        # Each line of an image is followed by a line of points, which may be empty.
        if line.startswith("#") or place % 2 == 1 or len(words) != 10:
            place += not line.startswith("#") and place % 2 == 1
            continue
        camera, place = cameras[place // 2], place + 1
        x, y, z, w = Rotation.from_matrix(camera.cTw[:, :3]).as_quat()
        words[1:8] = _numbers([w, x, y, z, *(camera.cTw[:, 3] / metres)]).split()
        outer[number], of[words[8]] = " ".join(words), camera
    for number, line in enumerate(inner):
        words = line.split()
        if line.startswith("#") or not words or words[0] not in of:
            continue
        camera, names = of[words[0]], MODELS[words[1]][0].split()
        (fx, _, cx), (_, fy, cy) = camera.K[:2].tolist()
        known = {"f": fx, "fx": fx, "fy": fy, "cx": cx + HALF_PIXEL, "cy": cy + HALF_PIXEL}
        bend = np.r_[camera.distortion, np.zeros(14)][: sum(name not in known for name in names)]
        inner[number] = " ".join(
            [*words[:4], _numbers([known[name] for name in names if name in known]), _numbers(bend)]
        )
    return {folder / FILES[0]: "\n".join(inner) + "\n", folder / FILES[1]: "\n".join(outer) + "\n"}


REWRITTEN: dict[str, Callable[[Content, Rig, float], Files]] = {
    QUALISYS.name: _qualisys,
    VICON.name: _vicon,
    **dict.fromkeys((OPENCV[0].name, OPENCV[1].name, OPENCV[3].name), _opencv),
    COLMAP.name: _colmap,
    ROS.name: _ros,
}
"""Rewriting functions, by name of the format."""
