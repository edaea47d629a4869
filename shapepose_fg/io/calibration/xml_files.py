"""Calibrations in XML, millimetres and z up: Qualisys' .qca.txt, which QTM exports, and Vicon's .xcp."""

import xml.etree.ElementTree as ET
from collections.abc import Callable

import numpy as np

from shapepose_fg.core.errors import InputError
from shapepose_fg.io.calibration.content import Content
from shapepose_fg.io.calibration.written import Format, WrittenCamera, WrittenRig, intrinsics, pose, rotation_of

_QTM, _NEXUS = "export the calibration from QTM again", "export the calibration from Nexus or Shogun again"
_SUBPIXEL = 64.0
"""QTM counts focal lengths and centres in 64ths of a pixel."""
_FULL = "1080p"
_LINES = {"1080p": 1080, "720p": 720, "540p": 540, "480p": 480}
"""Lines of a picture of the whole sensor by `video_resolution`."""
_TO_OPENCV = np.diag([1.0, -1.0, -1.0])
"""QTM's cameras have y up and look along -z."""
_DISTORTION = "radialDistortion1 radialDistortion2 tangentalDistortion1 tangentalDistortion2 radialDistortion3"


def _cameras(
    content: Content, path: str, model: str, name: str, cure: str, read: Callable[[ET.Element, str], WrittenCamera]
) -> WrittenRig:
    """The video cameras where the file tells them by `model` from marker cameras, else all of them."""
    every = content.value.findall(path)
    chosen = [camera for camera in every if "video" in camera.get(model, "").lower()] or every
    cameras = []
    for number, camera in enumerate(chosen):
        place = f"{content.path}: camera {number}"
        if not camera.get(name):
            raise InputError(f"{place}: {name} is missing; {cure}")
        cameras.append(read(camera, f'{place} "{camera.get(name)}"'))
    return WrittenRig(cameras, "mm", "z")


def _qualisys(camera: ET.Element, place: str) -> WrittenCamera:
    window = _attributes(camera, "fov_video", "left top right bottom", place)
    values = _attributes(camera, "transform", "r11 r12 r13 r21 r22 r23 r31 r32 r33 x y z", place)
    # R = diag(1, -1, -1) M, and the centre is x y z.
    R = _TO_OPENCV @ values[:9].reshape(3, 3)
    wTc = pose(R, -R @ values[9:], "transform", place)
    names = "focalLengthU focalLengthV centerPointU centerPointV"
    fx, fy, cx, cy = _attributes(camera, "intrinsic", names, place) / _SUBPIXEL
    # The numbers are of the whole sensor; smaller pictures are resized, as Pose2Sim's read_qca has it.
    resolution = camera.get("video_resolution", _FULL)
    if resolution not in _LINES:
        raise InputError(
            f"{place}: video_resolution must be one of {' '.join(_LINES)}, got {resolution[:20]!r}; film and"
            " calibrate at one of these, or delete it where pictures are as large as fov_video says"
        )
    scale = _LINES[resolution] / _LINES[_FULL]
    K = intrinsics(fx * scale, fy * scale, (cx - window[0]) * scale, (cy - window[1]) * scale)
    distortion = _attributes(camera, "intrinsic", _DISTORTION, place, missing=0.0)
    width, height = (window[2:] - window[:2] + 1) * scale
    return WrittenCamera(camera.attrib["serial"], K, wTc, (round(width), round(height)), distortion.tolist())


def _attributes(camera: ET.Element, tag: str, names: str, place: str, missing: float | None = None) -> np.ndarray:
    """Attributes of the element `tag` of a camera, finite."""
    element = camera.find(tag)
    if element is None:
        raise InputError(f"{place}: <{tag}> is missing; {_QTM}")
    values = []
    for name in names.split():
        text = element.get(name)
        try:
            value = float(text) if text is not None else missing
        except ValueError:
            value = None
        if value is None or not np.isfinite(value):
            got = "is missing" if text is None else f"must be a finite number, got {text[:20]!r}"
            raise InputError(f"{place}: {name} of <{tag}> {got}; {_QTM}")
        values.append(value)
    return np.array(values)


def _vicon(camera: ET.Element, place: str) -> WrittenCamera:
    """By the first key frame. ORIENTATION x y z w turns the world's axes into the camera's; POSITION is the
    centre.
    """
    frame = camera.find("KeyFrames/KeyFrame")
    if frame is None:
        raise InputError(f"{place}: it has no <KeyFrame>, so it is not calibrated; calibrate it, or delete it")
    width, height = _numbers(camera, "SENSOR_SIZE", 2, place)
    aspect = _numbers(camera, "PIXEL_ASPECT_RATIO", 1, place)[0] if camera.get("PIXEL_ASPECT_RATIO") else 1.0
    if aspect <= 0:
        raise InputError(f"{place}: PIXEL_ASPECT_RATIO must be above 0, got {aspect:g}; {_NEXUS}")
    focal = _numbers(frame, "FOCAL_LENGTH", 1, place)[0]
    K = intrinsics(focal, focal / aspect, *_numbers(frame, "PRINCIPAL_POINT", 2, place))
    R = rotation_of(_numbers(frame, "ORIENTATION", 4, place), "ORIENTATION", place)
    wTc = pose(R, -R @ _numbers(frame, "POSITION", 3, place), "ORIENTATION", place)
    distortion = list[float]()
    # VICON_RADIAL2 is a name, a centre and three radial coefficients, those of OpenCV; the older VICON_RADIAL
    # counts in pixels and runs the other way, so that it is read only where it is zero.
    if frame.get("VICON_RADIAL2"):
        k1, k2, k3 = _numbers(frame, "VICON_RADIAL2", 6, place, skip=1)[2:5]
        distortion = [k1, k2, 0.0, 0.0, k3]
    elif frame.get("VICON_RADIAL") and np.any(_numbers(frame, "VICON_RADIAL", 2, place, last=True)):
        raise InputError(
            f"{place}: VICON_RADIAL without VICON_RADIAL2 is not read; calibrate with Nexus 2 or newer, or"
            " undistort the pictures and write 0 0"
        )
    return WrittenCamera(camera.attrib["DEVICEID"], K, wTc, (round(width), round(height)), distortion)


def _numbers(
    element: ET.Element, name: str, count: int, place: str, *, skip: int = 0, last: bool = False
) -> list[float]:
    """The numbers of an attribute: `count` words without the first `skip`, or the last `count`."""
    words = element.get(name, "").split()
    words = words[-count:] if last else words
    try:
        values = [float(word) for word in words[skip:]]
    except ValueError:
        values = []
    if len(words) < count or len(values) == 0 or not np.isfinite(values).all():
        got = f"got {element.get(name)!r}" if element.get(name) is not None else "it is missing"
        raise InputError(f"{place}: {name} must hold {count - skip} finite numbers, {got}; {_NEXUS}")
    return values[: count - skip]


def _has(content: Content, tag: str, child: str) -> bool:
    return content.syntax == "XML" and content.value.tag == tag and content.value.find(child) is not None


QUALISYS = Format(
    "Qualisys' .qca.txt",
    lambda content: _has(content, "calibration", "cameras"),
    lambda content: _cameras(content, "cameras/camera", "model", "serial", _QTM, _qualisys),
)
VICON = Format(
    "Vicon's .xcp",
    lambda content: _has(content, "Cameras", "Camera"),
    lambda content: _cameras(content, "Camera", "TYPE", "DEVICEID", _NEXUS, _vicon),
)
