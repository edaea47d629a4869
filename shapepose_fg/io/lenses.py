"""Cameras of which only the field of view is known: names from files of detections, sizes from the footage."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from shapepose_fg.core.camera import Camera, Rig
from shapepose_fg.core.errors import InputError, naming
from shapepose_fg.io.camera_names import listing
from shapepose_fg.io.footage.placement import read_used_footage

_NARROWEST, _WIDEST = 5.0, 150.0
"""Degrees from left to right that a lens without distortion can see."""
_USUAL = 65.0
"""What phones see, about."""


def lenses_of(detections: Path, fields: Sequence[str], size: tuple[int, int] | None) -> Rig:
    """Cameras without poses, one for each file or folder of `detections`, in the order of their names.

    `fields` are degrees from left to right, `CAMERA=DEG` for one camera. `size` (width, height) are the pictures'
    pixels; without it footage.json, which `detect` writes, says them. InputError names what is missing.
    """
    names = camera_names(detections)
    degrees = _degrees(fields, names)
    footage = detections / "footage.json"
    sizes = (
        {}
        if size is not None or not footage.is_file()
        else {each.name: each.placement.calibrated_size for each in read_used_footage(footage)}
    )
    cameras = []
    for name in names:
        picture = size or sizes.get(name)
        if picture is None:
            raise InputError(
                f"camera {name}: nothing says how large its pictures are; pass --image-size WIDTHxHEIGHT"
            )
        with naming(detections):
            cameras.append(_camera(name, picture, degrees[name]))
    with naming(detections):
        return Rig(tuple(cameras), "z")


def pictures_only(names: Sequence[str], sizes: Sequence[tuple[int, int]]) -> Rig:
    """Cameras of which nothing is known but their pictures' sizes (width, height), without poses, upright."""
    return Rig(tuple(_camera(name, size, _USUAL) for name, size in zip(names, sizes, strict=True)), "z")


def _camera(name: str, size: tuple[int, int], degrees: float) -> Camera:
    """A camera without a pose that sees so many degrees from left to right."""
    width, height = size
    f = width / 2 / np.tan(np.radians(degrees) / 2)
    K = np.array([[f, 0.0, (width - 1) / 2], [0.0, f, (height - 1) / 2], [0.0, 0.0, 1.0]])
    return Camera(name, K, np.eye(4), size)


def camera_names(detections: Path) -> list[str]:
    """What cameras are called whose detections are in a folder: by its folders, text files or JSON files."""
    if not detections.is_dir():
        raise InputError(f"{detections}: there is no such folder; check the path of the detections")
    folder = detections / "detection" if (detections / "detection").is_dir() else detections
    entries = sorted(each for each in folder.iterdir() if not each.name.startswith("."))
    kinds = (
        [each.name.removesuffix("_json") for each in entries if each.is_dir()],
        [each.stem for each in entries if each.suffix == ".txt"],
        [each.stem for each in entries if each.suffix == ".json" and each.name != "footage.json"],
    )
    names = next((each for each in kinds if len(each) > 0), [])
    if len(names) == 0:
        raise InputError(
            f"{folder}: no detections here, only {listing([each.name for each in entries])}; give the folder with"
            " a file or folder for each camera"
        )
    return names


def _degrees(fields: Sequence[str], names: Sequence[str]) -> dict[str, float]:
    """Of each camera."""
    found = dict[str, float]()
    for text in fields:
        name, given, number = text.rpartition("=")
        if given and name not in names:
            raise InputError(f"--field-of-view {text}: no such camera; give one of {listing(names)}")
        try:
            degrees = float(number)
        except ValueError:
            degrees = np.nan
        if not _NARROWEST <= degrees <= _WIDEST:
            raise InputError(f"--field-of-view {text}: must be {_NARROWEST:g} to {_WIDEST:g} degrees")
        found |= {name: degrees} if given else {each: degrees for each in names if each not in found}
    if missing := [name for name in names if name not in found]:
        raise InputError(f"--field-of-view: camera {missing[0]} has none; give {missing[0]}=DEGREES")
    return found
