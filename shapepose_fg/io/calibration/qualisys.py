"""Qualisys' .qca.txt, the XML that QTM exports: millimetres, z up, intrinsics in 64ths of a pixel."""

import xml.etree.ElementTree as ET

import numpy as np

from shapepose_fg.core.errors import InputError
from shapepose_fg.io.calibration.content import Content
from shapepose_fg.io.calibration.written import Format, WrittenCamera, WrittenRig, intrinsics, pose

_SUBPIXEL = 64.0
"""QTM counts focal lengths and centres in 64ths of a pixel."""
_FULL = "1080p"
_LINES = {"1080p": 1080, "720p": 720, "540p": 540, "480p": 480}
"""Lines of a picture of the whole sensor by `video_resolution`."""
_TO_OPENCV = np.diag([1.0, -1.0, -1.0])
"""QTM's cameras have y up and look along -z."""
_DISTORTION = (
    "radialDistortion1 radialDistortion2 tangentalDistortion1 tangentalDistortion2 radialDistortion3".split()
)


def recognise(content: Content) -> bool:
    """Whether this is a <calibration> with cameras and their transforms."""
    return (
        content.syntax == "XML"
        and content.value.tag == "calibration"
        and content.value.find("cameras") is not None
    )


def read(content: Content) -> WrittenRig:
    """The video cameras where the file tells them from marker cameras, else all of them."""
    every = content.value.findall("cameras/camera")
    video = [camera for camera in every if "video" in camera.get("model", "").lower()]
    cameras = [_camera(camera, f"{content.path}: camera {number}") for number, camera in enumerate(video or every)]
    return WrittenRig(cameras, "mm", "z")


def _camera(camera: ET.Element, place: str) -> WrittenCamera:
    name = camera.get("serial")
    if not name:
        raise InputError(f"{place}: serial is missing; export the calibration from QTM again")
    place = f'{place} "{name}"'
    window = _numbers(camera, "fov_video", "left top right bottom", place)
    transform = "r11 r12 r13 r21 r22 r23 r31 r32 r33 x y z"
    values = _numbers(camera, "transform", transform, place)
    # R = diag(1, -1, -1) M, and the centre is x y z.
    R = _TO_OPENCV @ values[:9].reshape(3, 3)
    wTc = pose(R, -R @ values[9:], "transform", place)
    fx, fy, cx, cy = _numbers(camera, "intrinsic", "focalLengthU focalLengthV centerPointU centerPointV", place)
    # The numbers are of the whole sensor; pictures of a lower resolution are resized.
    scale = _scale(camera, place)
    centre = (cx / _SUBPIXEL - window[0]) * scale, (cy / _SUBPIXEL - window[1]) * scale
    K = intrinsics(fx / _SUBPIXEL * scale, fy / _SUBPIXEL * scale, *centre)
    distortion = _numbers(camera, "intrinsic", " ".join(_DISTORTION), place, missing=0.0)
    width, height = (window[2:] - window[:2] + 1) * scale
    return WrittenCamera(name, K, wTc, (round(width), round(height)), distortion.tolist())


def _scale(camera: ET.Element, place: str) -> float:
    """Pixels of the pictures per pixel of the sensor, as Pose2Sim's read_qca has it."""
    resolution = camera.get("video_resolution", _FULL)
    if resolution not in _LINES:
        raise InputError(
            f"{place}: video_resolution must be one of {' '.join(_LINES)}, got {resolution[:20]!r}; film and"
            " calibrate at one of these, or delete it where pictures are as large as fov_video says"
        )
    return _LINES[resolution] / _LINES[_FULL]


def _numbers(camera: ET.Element, tag: str, names: str, place: str, missing: float | None = None) -> np.ndarray:
    """Attributes of the element `tag` of a camera, finite."""
    element = camera.find(tag)
    if element is None:
        raise InputError(f"{place}: <{tag}> is missing; export the calibration from QTM again")
    values = []
    for name in names.split():
        text = element.get(name)
        try:
            value = float(text) if text is not None else missing
        except ValueError:
            value = None
        if value is None or not np.isfinite(value):
            got = "is missing" if text is None else f"must be a finite number, got {text[:20]!r}"
            raise InputError(f"{place}: {name} of <{tag}> {got}; export the calibration from QTM again")
        values.append(value)
    return np.array(values)


QUALISYS = Format("Qualisys' .qca.txt", recognise, read)
