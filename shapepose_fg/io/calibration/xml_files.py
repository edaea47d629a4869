"""Calibrations in XML, millimetres and z up: Qualisys' .qca.txt, which QTM exports, and Vicon's
.xcp.
"""

import re
import xml.etree.ElementTree as ET
from collections.abc import Callable
from typing import Any

import numpy as np

from shapepose_fg.core.arrays import Array
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.validation import is_number
from shapepose_fg.io.calibration.content import Content
from shapepose_fg.io.calibration.written import (
    CalibrationFormat,
    Node,
    WrittenCamera,
    WrittenRig,
    intrinsics,
    pose,
    rotation_of,
)
from shapepose_fg.io.camera_names import listing

_RESOLUTION = "video_resolution"
_QTM, _NEXUS = (
    "export the calibration from QTM again",
    "export the calibration from Nexus or Shogun again",
)
QTM_CAMERAS, NEXUS_CAMERAS = ("cameras/camera", "model"), ("Camera", "TYPE")
"""XML paths of cameras, and the attribute that identifies video cameras."""
SUBPIXEL = 64.0
"""Units per pixel of QTM's focal lengths and principal points."""
_FULL = (1080, 1440, 2160)
"""Numbers of lines of full sensors in QTM's resolution names; no video camera has a smaller
sensor."""
_LINES = re.compile(r"(\d{3,4})[pi]", re.ASCII)
_VIDEO = ("video", "hybrid", "none")
"""Words in the models of video cameras: Miqus Video (Plus), Miqus Hybrid; "none" means unknown."""
TO_OPENCV = np.diag([1.0, -1.0, -1.0])
"""Conversion from QTM's camera axes (y up, looking along -z) to OpenCV's."""
DISTORTION = (
    "radialDistortion1 radialDistortion2 tangentalDistortion1 tangentalDistortion2 "
    "radialDistortion3"
)


def _cameras(
    content: Content,
    root: str,
    path: str,
    model: str,
    name: str,
    read: Callable[[ET.Element, str], WrittenCamera],
) -> WrittenRig | None:
    """Read the video cameras if `model` distinguishes them from marker cameras, otherwise all
    cameras.
    """
    if (
        content.syntax != "XML"
        or content.value.tag != root
        or content.value.find(path.split("/")[0]) is None
    ):
        return None
    cameras, used = [], chosen(content.value, path, model)
    notes, unnamed = list[str](), dict[str, list[str]]()
    for number, camera in enumerate(used):
        place = f"{content.path}: camera {number}"
        if not camera.get(name):
            raise InputError(f"{place}: {name} is missing; export the calibration again")
        cameras.append(read(camera, f'{place} "{camera.get(name)}"'))
        if (resolution := camera.get(_RESOLUTION, "")) and _LINES.fullmatch(resolution) is None:
            unnamed.setdefault(resolution[:20], []).append(camera.attrib[name])
    for resolution, names in unnamed.items():
        size = "the size of the pictures is assumed to be that of fov_video"
        notes.append(f"{_RESOLUTION} is {resolution!r} of camera {listing(names)}; {size}")
    for camera in content.value.findall(path):
        if camera not in used:
            why = (
                "it is not calibrated"
                if _takes_video(camera, model)
                else "it does not record video"
            )
            kind = f" ({camera.get(model, '')[:40]})" if camera.get(model) else ""
            notes.append(f"camera {camera.get(name, '?')[:40]}{kind} is left out: {why}")
    return WrittenRig(cameras, "mm", "z", notes=notes)


def _takes_video(camera: ET.Element, model: str) -> bool:
    return any(word in camera.get(model, "").lower() for word in _VIDEO)


def chosen(root: ET.Element, path: str, model: str) -> list[ET.Element]:
    """The elements of the cameras that are read."""
    every = root.findall(path)
    known = [
        each for each in every if each.get("calibrated", "true") != "false" and len(each) > 0
    ] or every
    return [each for each in known if _takes_video(each, model)] or known


def _node(element: ET.Element | None, place: str, cure: str) -> Node:
    """The attributes of an element, converted to numbers where possible."""

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
    # R = diag(1, -1, -1) M; the centre is x y z.
    R = TO_OPENCV @ turn
    wTc = pose(R, values("transform", "x y z"), "transform", place, centre=True)
    fx, fy, cx, cy = (
        values("intrinsic", "focalLengthU focalLengthV centerPointU centerPointV") / SUBPIXEL
    )
    scale = scale_of(camera)
    K = intrinsics(fx * scale, fy * scale, (cx - window[0]) * scale, (cy - window[1]) * scale)
    distortion = values("intrinsic", DISTORTION, dict.fromkeys(DISTORTION.split(), 0.0)).tolist()
    width, height = (window[2:] - window[:2] + 1) * scale
    return WrittenCamera(camera.attrib["serial"], K, wTc, (round(width), round(height)), distortion)


def scale_of(camera: ET.Element) -> float:
    """Scale of a camera's pictures: pixels of the picture per pixel of the sensor. All values in
    the file are in sensor pixels.

    Pictures with fewer lines than the sensor are resized (as in Pose2Sim's read_qca), unless the
    region of interest has this number of lines. 1 if the file has no resolution.
    """
    named = _LINES.fullmatch(camera.get(_RESOLUTION, ""))
    if named is None:
        return 1.0
    window, *whole = [
        _lines(camera, tag) for tag in ("fov_video", "fov_video_max", "fov_marker_max")
    ]
    sensor = max([lines for lines in (window, *whole) if lines is not None], default=0.0)
    full, lines = max(each for each in _FULL if each <= max(sensor, _FULL[0])), int(named[1])
    # Largest difference between the number of lines of a picture and that in its
    # resolution's name: 1080p has 1088 lines.
    cropped = full > _FULL[0] and window is not None and 0 <= window - lines <= 8
    return 1.0 if cropped else min(1.0, lines / full)


def _lines(camera: ET.Element, tag: str) -> float | None:
    """Shorter side of the sensor's region of interest, pixels; None if it is not in the file."""
    found = camera.find(tag)
    sides = (
        []
        if found is None
        else [found.get(side, "") for side in ("left", "right", "top", "bottom")]
    )
    if len(sides) == 0 or not all(map(is_number, sides)):
        return None
    left, right, top, bottom = map(float, sides)
    return min(right - left, bottom - top) + 1


def _vicon(camera: ET.Element, place: str) -> WrittenCamera:
    """Camera of the first key frame: ORIENTATION rotates world axes to camera axes, POSITION is the
    centre.
    """
    key_frame = camera.find("KeyFrames/KeyFrame")
    if key_frame is None:
        raise InputError(
            f"{place}: it has no <KeyFrame>, so it is not calibrated; calibrate or delete it"
        )
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
    # VICON_RADIAL2 has a name, a centre and three radial coefficients, those of OpenCV. The older
    # VICON_RADIAL is in pixels and maps in the other direction, so it is accepted only if it is
    # zero.
    name, _, radial = key_frame.get("VICON_RADIAL2", "").strip().partition(" ")
    if name:
        numbers = _node(ET.Element("", VICON_RADIAL2=radial), place, _NEXUS).needed(
            "VICON_RADIAL2", 5
        )
        distortion = [*numbers[2:4], 0.0, 0.0, numbers[4]]
    elif not all(
        is_number(word) and float(word) == 0
        for word in key_frame.get("VICON_RADIAL", "").split()[-2:]
    ):
        cure = "calibrate with Nexus 2 or newer, or undistort the pictures and write 0 0"
        raise InputError(f"{place}: VICON_RADIAL without VICON_RADIAL2 is not supported; {cure}")
    return WrittenCamera(
        camera.attrib["DEVICEID"], K, wTc, (round(width), round(height)), distortion
    )


QUALISYS = CalibrationFormat(
    "Qualisys' .qca.txt",
    lambda content: _cameras(content, "calibration", *QTM_CAMERAS, "serial", _qualisys),
)
VICON = CalibrationFormat(
    "Vicon's .xcp", lambda content: _cameras(content, "Cameras", *NEXUS_CAMERAS, "DEVICEID", _vicon)
)
