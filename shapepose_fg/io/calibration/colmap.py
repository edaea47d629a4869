"""COLMAP's text model: cameras.txt and images.txt. Poses are camera from world; unit and up axis
are not defined.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath

import numpy as np

from shapepose_fg.core.camera import HALF_PIXEL
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.lens import Lens
from shapepose_fg.core.storage.files import LARGE, read_text
from shapepose_fg.core.validation import is_number
from shapepose_fg.io.calibration.content import Content
from shapepose_fg.io.calibration.written import (
    CalibrationFormat,
    WrittenCamera,
    WrittenRig,
    intrinsics,
    pose,
    rotation_of,
)

FILES = ("cameras.txt", "images.txt")
_BINARY = ("cameras.bin", "images.bin")
MODELS: dict[str, tuple[str, Lens]] = {
    "SIMPLE_PINHOLE": ("f cx cy", "perspective"),
    "PINHOLE": ("fx fy cx cy", "perspective"),
    "SIMPLE_RADIAL": ("f cx cy k1", "perspective"),
    "RADIAL": ("f cx cy k1 k2", "perspective"),
    "OPENCV": ("fx fy cx cy k1 k2 p1 p2", "perspective"),
    "FULL_OPENCV": ("fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6", "perspective"),
    "SIMPLE_RADIAL_FISHEYE": ("f cx cy k1", "fisheye"),
    "RADIAL_FISHEYE": ("f cx cy k1 k2", "fisheye"),
    "OPENCV_FISHEYE": ("fx fy cx cy k1 k2 k3 k4", "fisheye"),
}
"""COLMAP's camera models that OpenCV supports, with their parameters (distortion coefficients in
OpenCV's order) and lens model."""
_CURES = {
    "unit": (
        "pass --unit (a model has no scale until colmap model_aligner or known distances between "
        "cameras determine one)"
    ),
    "up": "pass --up with the axis of the model that points up",
}


def _read(content: Content) -> WrittenRig | None:
    """A camera per image, in the order of images.txt; named after the image or its folder."""
    folder = content.path if content.syntax == "folder" else content.path.parent
    names = (
        [path.name for path in content.value] if content.syntax == "folder" else [content.path.name]
    )
    if content.syntax not in ("folder", "text") or not set(names) & {*FILES, *_BINARY}:
        return None
    for name, binary in zip(FILES, _BINARY, strict=True):
        if not (folder / name).is_file():
            cure = "copy it into the same folder"
            if (folder / binary).is_file():
                cure = (
                    f"{binary} is COLMAP's binary format: convert it with colmap model_converter "
                    "--output_type TXT"
                )
            raise InputError(f"{folder / name}: this file of COLMAP's model is missing; {cure}")
    return WrittenRig(_images(folder / FILES[1], _lenses(folder / FILES[0])), None, None, _CURES)


def _lenses(path: Path) -> dict[str, WrittenCamera]:
    """The cameras of cameras.txt by id, without poses; a line is CAMERA_ID, MODEL, WIDTH, HEIGHT,
    PARAMS[].
    """
    lenses = {}
    for number, line in enumerate(read_text(path, most=LARGE).splitlines(), 1):
        words = line.split()
        if len(words) == 0 or line.startswith("#"):
            continue
        place = f"{path}: line {number}"
        model = words[1] if len(words) > 1 else ""
        if model not in MODELS:
            known = " ".join(MODELS)
            raise InputError(
                f"{place}: camera model {model or 'missing'} is not supported; use one of {known}"
            )
        parameters, lens = MODELS[model]
        names = parameters.split()
        width, height, *values = _numbers(words[2:], 2 + len(names), place)
        given = dict(zip(names, values, strict=True))
        fx, fy = (given.get(focal, given.get("f", 0.0)) for focal in ("fx", "fy"))
        K = intrinsics(fx, fy, given["cx"] - HALF_PIXEL, given["cy"] - HALF_PIXEL)
        distortion = values[names.index("cy") + 1 :]
        lenses[words[0]] = WrittenCamera(
            "", K, np.eye(4), (round(width), round(height)), distortion, lens
        )
    return lenses


def _images(path: Path, lenses: dict[str, WrittenCamera]) -> list[WrittenCamera]:
    """images.txt: IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME; each line is followed by a
    line of points.
    """
    every = enumerate(read_text(path, most=LARGE).splitlines(), 1)
    lines = iter([(number, line) for number, line in every if line[:1] != "#"])
    rows = []
    for number, line in lines:
        if line.strip():
            rows.append((number, line.split(maxsplit=9)))
            points, text = next(lines, (0, ""))
            if len(text.split()) % 3 != 0 or not all(is_number(word) for word in text.split()):
                problem = (
                    f"line {points}: must hold the points of the image in the line before, three "
                    "numbers each"
                )
                raise InputError(f"{path}: {problem}; leave an empty line if it has none")
    names = _names([words[9] if len(words) == 10 else "" for _, words in rows])
    cameras = []
    for (number, words), name in zip(rows, names, strict=True):
        place = f"{path}: line {number}"
        if len(words) != 10 or words[8] not in lenses:
            raise InputError(
                f"{place}: must hold id, quaternion, translation, camera id and name; export again"
            )
        qw, qx, qy, qz, *t = _numbers(words[1:8], 7, place)
        wTc = pose(rotation_of([qx, qy, qz, qw], "QW QX QY QZ", place), t, "QW QX QY QZ", place)
        cameras.append(replace(lenses[words[8]], name=name, wTc=wTc))
    return cameras


def _names(files: Sequence[str]) -> list[str]:
    """Names of cameras from file names of images: the folders if these are unique, otherwise the
    files.
    """
    folders = [str(PurePosixPath(file).parent) for file in files]
    if "." not in folders and len(set(folders)) == len(folders):
        return folders
    return [str(PurePosixPath(file).with_suffix("")) if file else "" for file in files]


def _numbers(words: Sequence[str], count: int, place: str) -> list[float]:
    if len(words) != count or not all(map(is_number, words)):
        raise InputError(
            f"{place}: must hold {count} finite numbers, got {len(words)} values; export it again"
        )
    return [float(word) for word in words]


COLMAP = CalibrationFormat("COLMAP's cameras.txt and images.txt", _read)
