"""Calibrations in XML, millimetres and z up: Qualisys' .qca.txt, which QTM exports, and Vicon's .xcp."""

import xml.etree.ElementTree as ET
from collections.abc import Callable
from typing import Any

import numpy as np

from shapepose_fg.core.arrays import Array
from shapepose_fg.core.errors import InputError
from shapepose_fg.io.calibration.content import Content
from shapepose_fg.io.calibration.written import (
    Format,
    Node,
    WrittenCamera,
    WrittenRig,
    intrinsics,
    pose,
    rotation_of,
)
from shapepose_fg.io.validation import is_number

_QTM, _NEXUS = "export the calibration from QTM again", "export the calibration from Nexus or Shogun again"
QTM_CAMERAS, NEXUS_CAMERAS = ("cameras/camera", "model"), ("Camera", "TYPE")
"""Where cameras are, and the attribute that tells those for video."""
SUBPIXEL = 64.0
"""QTM counts focal lengths and centres in 64ths of a pixel."""
FULL = "1080p"
LINES = {"1080p": 1080, "720p": 720, "540p": 540, "480p": 480}
"""Lines of a picture of the whole sensor by `video_resolution`."""
TO_OPENCV = np.diag([1.0, -1.0, -1.0])
"""QTM's cameras have y up and look along -z."""
DISTORTION = "radialDistortion1 radialDistortion2 tangentalDistortion1 tangentalDistortion2 radialDistortion3"


def _cameras(
    content: Content, root: str, path: str, model: str, name: str, read: Callable[[ET.Element, str], WrittenCamera]
) -> WrittenRig | None:
    """The video cameras where the file tells them by `model` from marker cameras, else all of them."""
    if content.syntax != "XML" or content.value.tag != root or content.value.find(path.split("/")[0]) is None:
        return None
    cameras = []
    for number, camera in enumerate(chosen(content.value, path, model)):
        place = f"{content.path}: camera {number}"
        if not camera.get(name):
            raise InputError(f"{place}: {name} is missing; export the calibration again")
        cameras.append(read(camera, f'{place} "{camera.get(name)}"'))
    return WrittenRig(cameras, "mm", "z")


def chosen(root: ET.Element, path: str, model: str) -> list[ET.Element]:
    """The elements of the cameras that are read."""
    every = root.findall(path)
    return [camera for camera in every if "video" in camera.get(model, "").lower()] or every


def _node(element: ET.Element | None, place: str, cure: str) -> Node:
    """The attributes of an element, of which those that can be are numbers."""

    def parsed(text: str) -> Any:
        try:
            values = [float(word) for word in text.split()]
        except ValueError:
            return text
        return values[0] if len(values) == 1 else values

    if element is None:
        raise InputError(f"{place} is missing; {cure}")
    return Node({name: parsed(text) for name, text in element.attrib.items()}, place, {"": cure})


def _qualisys(camera: ET.Element, place: str) -> WrittenCamera:
    def values(tag: str, names: str, missing: dict[str, float] | None = None) -> Array:
        node = _node(camera.find(tag), f"{place}: <{tag}>", _QTM)
        node = Node({**(missing or {}), **node.values}, node.place, node.cures)
        return np.concatenate([node.needed(name, 1) for name in names.split()])

    window = values("fov_video", "left top right bottom")
    turn = values("transform", "r11 r12 r13 r21 r22 r23 r31 r32 r33").reshape(3, 3)
    # R = diag(1, -1, -1) M, and the centre is x y z.
    R = TO_OPENCV @ turn
    wTc = pose(R, values("transform", "x y z"), "transform", place, centre=True)
    fx, fy, cx, cy = values("intrinsic", "focalLengthU focalLengthV centerPointU centerPointV") / SUBPIXEL
    # The numbers are of the whole sensor; smaller pictures are resized, as Pose2Sim's read_qca has it.
    resolution = camera.get("video_resolution", FULL)
    if resolution not in LINES:
        raise InputError(
            f"{place}: video_resolution must be one of {' '.join(LINES)}, got {resolution[:20]!r}; film and"
            " calibrate at one of these, or delete it where pictures are as large as fov_video says"
        )
    scale = LINES[resolution] / LINES[FULL]
    K = intrinsics(fx * scale, fy * scale, (cx - window[0]) * scale, (cy - window[1]) * scale)
    distortion = values("intrinsic", DISTORTION, dict.fromkeys(DISTORTION.split(), 0.0)).tolist()
    width, height = (window[2:] - window[:2] + 1) * scale
    return WrittenCamera(camera.attrib["serial"], K, wTc, (round(width), round(height)), distortion)


def _vicon(camera: ET.Element, place: str) -> WrittenCamera:
    """By the first key frame: ORIENTATION turns the world's axes into the camera's, POSITION is the centre."""
    key_frame = camera.find("KeyFrames/KeyFrame")
    if key_frame is None:
        raise InputError(f"{place}: it has no <KeyFrame>, so it is not calibrated; calibrate it, or delete it")
    whole, frame = _node(camera, place, _NEXUS), _node(key_frame, place, _NEXUS)
    width, height = whole.needed("SENSOR_SIZE", 2)
    ratio = whole.numbers("PIXEL_ASPECT_RATIO", 1)
    aspect = 1.0 if ratio is None else float(ratio[0])
    if aspect <= 0:
        raise whole.refuse("PIXEL_ASPECT_RATIO", f"must be above 0, got {aspect:g}")
    focal = float(frame.needed("FOCAL_LENGTH", 1)[0])
    K = intrinsics(focal, focal / aspect, *frame.needed("PRINCIPAL_POINT", 2))
    R = rotation_of(frame.needed("ORIENTATION", 4), "ORIENTATION", place)
    wTc = pose(R, frame.needed("POSITION", 3), "ORIENTATION", place, centre=True)
    distortion = list[float]()
    # VICON_RADIAL2 is a name, a centre and three radial coefficients, those of OpenCV; the older VICON_RADIAL
    # counts in pixels and runs the other way, so that it is read only where it is zero.
    name, _, radial = key_frame.get("VICON_RADIAL2", "").strip().partition(" ")
    if name:
        numbers = _node(ET.Element("", VICON_RADIAL2=radial), place, _NEXUS).needed("VICON_RADIAL2", 5)
        distortion = [*numbers[2:4], 0.0, 0.0, numbers[4]]
    elif not all(is_number(word) and float(word) == 0 for word in key_frame.get("VICON_RADIAL", "").split()[-2:]):
        cure = "calibrate with Nexus 2 or newer, or undistort the pictures and write 0 0"
        raise InputError(f"{place}: VICON_RADIAL without VICON_RADIAL2 is not read; {cure}")
    return WrittenCamera(camera.attrib["DEVICEID"], K, wTc, (round(width), round(height)), distortion)


QUALISYS = Format(
    "Qualisys' .qca.txt",
    lambda content: _cameras(content, "calibration", *QTM_CAMERAS, "serial", _qualisys),
)
VICON = Format("Vicon's .xcp", lambda content: _cameras(content, "Cameras", *NEXUS_CAMERAS, "DEVICEID", _vicon))
