"""Cameras with a known field of view but without poses: names from the detection files, picture
sizes from the footage.
"""

import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from shapepose_fg.core.camera import Camera, Rig
from shapepose_fg.core.errors import InputError, naming, optional
from shapepose_fg.core.storage.files import BIG, open_regular
from shapepose_fg.io.detections.reading import camera_names
from shapepose_fg.io.footage.placement import read_used_footage
from shapepose_fg.io.footage.places import per_camera
from shapepose_fg.io.trajectories import read_log_lens

_NARROWEST, _WIDEST = 5.0, 150.0
"""Smallest and largest field of view along the longer side that is accepted for a lens without
distortion, degrees."""
_PHOTOS = (".jpg", ".jpeg", ".png", ".tif", ".tiff")
_FORMATS = ("JPEG", "PNG", "TIFF")
"""Pillow's names of the supported formats: other readers of Pillow are disabled, because some start
external programs."""


def lenses_of(detections: Path, fields: Sequence[str], size: tuple[int, int] | None) -> Rig:
    """Cameras without poses, one for each file or folder of `detections`, in the order of their
    names.

    `fields` are fields of view in degrees, along the longer side of a picture (the vertical one if
    it is upright), photos of the same lens with the focal length in EXIF, or logs of the phone with
    its intrinsics (.csv); `CAMERA=` before a value restricts it to one camera. `size` is (width,
    height) of the pictures, pixels; by default it is read from footage.json, which `detect` writes.
    InputError names what is missing.
    """
    names = camera_names(detections)
    given = dict(
        zip(names, per_camera("--field-of-view", fields, names, one_for_all=True), strict=True)
    )
    footage = detections / "footage.json"
    sizes = (
        {}
        if size is not None or not footage.is_file()
        else {each.name: each.placement.calibrated_size for each in read_used_footage(footage)}
    )
    cameras = []
    for name, field in given.items():
        picture = size or sizes.get(name)
        if field is None:
            raise InputError(f"--field-of-view: missing for camera {name}; give {name}=DEGREES")
        if picture is None:
            raise InputError(
                f"camera {name}: the size of its pictures is unknown; pass --image-size "
                "WIDTHxHEIGHT"
            )
        with naming(detections):
            camera = _camera(name, picture, 65.0 if is_log(field) else _degrees(field))
        cameras.append(of_log(camera, Path(field)) if is_log(field) else camera)
    with naming(detections):
        return Rig(tuple(cameras), "z")


def is_log(field: str | None) -> bool:
    """Whether a value of --field-of-view is a log with intrinsics."""
    return field is not None and field.lower().endswith(".csv")


def of_log(camera: Camera, log: Path) -> Camera:
    """The camera with the intrinsics of its phone's log; InputError if it has none, or for pictures
    of another size.
    """
    K = read_log_lens(log)
    if K is None:
        raise InputError(f"{log}: has no intrinsics, columns fx fy cx cy; give degrees instead")
    size, (u, v) = np.array(camera.image_size), 2 * K[:2, 2]
    # A principal point is within 10 % of half the picture from its middle; modes differ by more.
    if not ((np.abs([u, v] / size - 1) < 0.1).all() and min(K[0, 0], K[1, 1]) > 0):
        raise InputError(
            f"{log}: its lens belongs to pictures of about {u:.0f} x {v:.0f} pixels, but those of "
            f"camera {camera.name} have {size[0]} x {size[1]}; detect people in the pictures as "
            "they were recorded, or give degrees"
        )
    return replace(camera, K=K)


def pictures_only(names: Sequence[str], sizes: Sequence[tuple[int, int]]) -> Rig:
    """Upright cameras for which only the picture sizes (width, height) are known, without poses."""
    # Typical field of view of a phone along the longer side of a video, degrees.
    return Rig(
        tuple(_camera(name, size, 65.0) for name, size in zip(names, sizes, strict=True)), "z"
    )


def _camera(name: str, size: tuple[int, int], degrees: float) -> Camera:
    """A camera without a pose, with a field of view of `degrees` along the longer side."""
    width, height = size
    f = max(size) / 2 / np.tan(np.radians(degrees) / 2)
    K = np.array([[f, 0.0, (width - 1) / 2], [0.0, f, (height - 1) / 2], [0.0, 0.0, 1.0]])
    return Camera(name, K, np.eye(4), size)


def _degrees(given: str) -> float:
    """Field of view along the longer side of a picture, degrees."""
    if Path(given).suffix.lower() in _PHOTOS:
        return float(np.degrees(2 * np.arctan(0.5 / _focal_of_photo(Path(given)))))
    try:
        degrees = float(given)
    except ValueError:
        degrees = np.nan
    if not _NARROWEST <= degrees <= _WIDEST:
        raise InputError(
            f"--field-of-view {given[:80]}: must be {_NARROWEST:g} to {_WIDEST:g} degrees, or a "
            ".jpg with EXIF"
        )
    return degrees


def _focal_of_photo(file: Path) -> float:
    """A photo's focal length relative to its longer side, from EXIF's FocalLengthIn35mmFilm, which
    refers to 35 mm film with the same image diagonal (EXIF 2.3, 4.6.5).
    """
    image, tags = optional("PIL.Image", "photos"), optional("PIL.ExifTags", "photos")
    cure = "give an unedited photo of the camera, or degrees"
    with open_regular(file, cure, BIG) as stream, warnings.catch_warnings():
        warnings.simplefilter(
            "ignore"
        )  # Pillow's warning about large pictures; none is decoded here
        try:
            with image.open(stream, formats=_FORMATS) as photo:
                # Without EXIF in its header, a PNG would be decoded to look behind the image data.
                known = photo.format != "PNG" or "exif" in photo.info
                exif = photo.getexif().get_ifd(tags.IFD.Exif) if known else {}
                sides, found = photo.size, exif.get(tags.Base.FocalLengthIn35mmFilm)
        except (
            Exception
        ) as error:  # for damaged files Pillow raises many kinds of errors, such as SyntaxError
            raise InputError(
                f"{file}: cannot be read as a photo ({type(error).__name__}); {cure}"
            ) from None
    if not isinstance(found, int | float) or not 0 < found < 2000 or min(sides) < 1:
        raise InputError(f"{file}: its EXIF data have no FocalLengthIn35mmFilm; {cure}")
    return float(found / np.hypot(36.0, 24.0) * np.hypot(*sides) / max(sides))
