"""Vicon's .xcp: XML with a camera's state in key frames; millimetres, z up."""

import xml.etree.ElementTree as ET

import numpy as np

from shapepose_fg.core.errors import InputError
from shapepose_fg.io.calibration.content import Content
from shapepose_fg.io.calibration.written import Format, WrittenCamera, WrittenRig, intrinsics, pose, rotation_of

_CURE = "export the calibration from Nexus or Shogun again"


def recognise(content: Content) -> bool:
    """Whether this is a <Cameras> with <Camera> in it."""
    return content.syntax == "XML" and content.value.tag == "Cameras" and content.value.find("Camera") is not None


def read(content: Content) -> WrittenRig:
    """The video cameras where the file tells them from marker cameras, else all; by the first key frame."""
    every = content.value.findall("Camera")
    video = [camera for camera in every if "video" in camera.get("TYPE", "").lower()]
    cameras = [_camera(camera, f"{content.path}: camera {number}") for number, camera in enumerate(video or every)]
    return WrittenRig(cameras, "mm", "z")


def _camera(camera: ET.Element, place: str) -> WrittenCamera:
    name = camera.get("DEVICEID")
    if not name:
        raise InputError(f"{place}: DEVICEID is missing; {_CURE}")
    place = f'{place} "{name}"'
    frame = camera.find("KeyFrames/KeyFrame")
    if frame is None:
        raise InputError(f"{place}: it has no <KeyFrame>, so it is not calibrated; calibrate it, or delete it")
    width, height = _numbers(camera, "SENSOR_SIZE", 2, place)
    aspect = _numbers(camera, "PIXEL_ASPECT_RATIO", 1, place)[0] if camera.get("PIXEL_ASPECT_RATIO") else 1.0
    if aspect <= 0:
        raise InputError(f"{place}: PIXEL_ASPECT_RATIO must be above 0, got {aspect:g}; {_CURE}")
    focal = _numbers(frame, "FOCAL_LENGTH", 1, place)[0]
    K = intrinsics(focal, focal / aspect, *_numbers(frame, "PRINCIPAL_POINT", 2, place))
    # ORIENTATION x y z w turns the world's axes into the camera's; POSITION is the centre.
    R = rotation_of(_numbers(frame, "ORIENTATION", 4, place), "ORIENTATION", place)
    wTc = pose(R, -R @ _numbers(frame, "POSITION", 3, place), "ORIENTATION", place)
    return WrittenCamera(name, K, wTc, (round(width), round(height)), _distortion(frame, place))


def _distortion(frame: ET.Element, place: str) -> list[float]:
    """k1 k2 p1 p2 k3. VICON_RADIAL2 is a name, a centre and three radial coefficients, those of OpenCV; the older
    VICON_RADIAL counts in pixels and runs the other way, so that it is read only where it is zero.
    """
    if frame.get("VICON_RADIAL2"):
        k1, k2, k3 = _numbers(frame, "VICON_RADIAL2", 6, place, skip=1)[2:5]
        return [k1, k2, 0.0, 0.0, k3]
    if frame.get("VICON_RADIAL") and np.any(_numbers(frame, "VICON_RADIAL", 2, place, last=True)):
        raise InputError(
            f"{place}: VICON_RADIAL without VICON_RADIAL2 is not read; calibrate with Nexus 2 or newer, or"
            " undistort the pictures and write 0 0"
        )
    return []


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
        raise InputError(f"{place}: {name} must hold {count - skip} finite numbers, {got}; {_CURE}")
    return values[: count - skip]


VICON = Format("Vicon's .xcp", recognise, read)
