"""Mapping between calibrated pixels and pixels of the footage; and footage.json, which lists the
pictures of detections.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, Field, PositiveInt

from shapepose_fg.core.arrays import Array, Index
from shapepose_fg.core.camera import Rig
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.storage.files import read_json, write_content
from shapepose_fg.core.validation import validated
from shapepose_fg.io.footage.places import per_camera

FOOTAGE = "footage.json"
"""Name of the file beside the detections."""
UNFINISHED = "unfinished"
"""Name of the folder with finished blocks, beside detections that are not finished."""
UNFINISHED_SETTINGS = "settings.json"
"""Name of the file in it with the settings of the run."""


class PlacementKind(StrEnum):
    """How pictures of another size were made from pictures of the calibrated size."""

    SAME = "same"
    """The sizes are equal."""
    CROP = "crop"
    """Columns on the right and rows at the bottom were cropped, or padded."""
    CROP_CENTRE = "crop-centre"
    """Equal numbers of columns on both sides, and of rows above and below, were cropped, or
    padded."""
    SCALE = "scale"
    """The pictures were resized, with independent scales of the axes."""
    LETTERBOX = "letterbox"
    """The pictures were resized with the same scale along both axes, with bars on two sides."""


@dataclass(frozen=True)
class Placement:
    """Position of calibrated pixels in a picture: along each axis, an edge u is at scale * u +
    shift.
    """

    kind: PlacementKind
    """How the pictures were made."""
    picture_size: tuple[int, int]
    """Width and height of the pictures, pixels."""
    calibrated_size: tuple[int, int]
    """Width and height of the calibrated pictures, pixels."""

    @cached_property
    def scale(self) -> Array:
        """(2,) pixels of the picture per calibrated pixel, x and y."""
        scale = np.array(self.picture_size, dtype=float) / self.calibrated_size
        if self.kind is PlacementKind.LETTERBOX:
            return np.full(2, scale.min())
        return scale if self.kind is PlacementKind.SCALE else np.ones(2)

    @cached_property
    def shift(self) -> Array:
        """(2,) position of the left and upper edges of the calibrated picture, relative to the
        picture's edges, pixels.
        """
        centred = self.kind in (PlacementKind.LETTERBOX, PlacementKind.CROP_CENTRE)
        return (
            (self.picture_size - self.scale * self.calibrated_size) / 2 if centred else np.zeros(2)
        )

    @property
    def region(self) -> tuple[float, float, float, float]:
        """Left, top, right, bottom edge of the calibrated part of the picture; 0 is the centre of
        the first pixel.
        """
        low = np.maximum(self.shift, 0.0)
        high = np.minimum(self.shift + self.scale * self.calibrated_size, self.picture_size)
        left, top, right, bottom = np.concatenate([low, high]) - 0.5
        return float(left), float(top), float(right), float(bottom)

    def to_picture(self, xy: Array) -> Array:
        """Pixels (..., 2) of the picture for calibrated pixels (with distortion)."""
        return (xy + 0.5) * self.scale + self.shift - 0.5

    def to_calibrated(self, xy: Array) -> Array:
        """Calibrated pixels (..., 2) for pixels of the picture."""
        return (xy + 0.5 - self.shift) / self.scale - 0.5


def placements_of(
    given: Sequence[str], sizes: Mapping[str, tuple[int, int]], rig: Rig
) -> tuple[dict[str, Placement], list[str]]:
    """The placements of cameras with pictures of `sizes` (width, height), and notes on inferred
    ones.

    `given` are kinds of placement, for all cameras or CAMERA=KIND.
    """
    words = per_camera("--image-placement", given, rig.names, one_for_all=True)
    placements, notes = {}, []
    for camera, word in zip(rig.cameras, words, strict=True):
        if word is not None and word not in set(PlacementKind):
            raise InputError(f"--image-placement {word}: must be one of {' '.join(PlacementKind)}")
        if camera.name in sizes:
            wanted = None if word is None else PlacementKind(word)
            placements[camera.name], concluded = place(
                camera.name, sizes[camera.name], camera.image_size, wanted
            )
            notes += [] if concluded is None else [concluded]
    return placements, notes


def place(
    name: str,
    picture_size: tuple[int, int],
    calibrated_size: tuple[int, int],
    wanted: PlacementKind | None,
) -> tuple[Placement, str | None]:
    """The placement of camera `name`, and a sentence if it was inferred from the sizes.

    Inferred kinds are: `same` for equal sizes; `crop` for a difference of up to 16 pixels;
    otherwise `scale` for the same aspect ratio. InputError for any other size, unless `wanted`
    gives the kind, and if the wanted kind is impossible.
    """
    (width, height), (full_width, full_height) = picture_size, calibrated_size
    full = f"{full_width} x {full_height}"
    sizes = (
        f"camera {name}: the pictures have {width} x {height} pixels, but the calibration is for "
        f"{full}"
    )
    kind, note = wanted, None
    if wanted is PlacementKind.SAME and picture_size != calibrated_size:
        raise InputError(f"{sizes}; give another --image-placement")
    if wanted is not None or picture_size == calibrated_size:
        kind = wanted or PlacementKind.SAME
    # Block size of video coders, pixels: coders pad or crop a few columns or rows to a
    # multiple of it.
    elif max(abs(width - full_width), abs(height - full_height)) <= 16:
        kind = PlacementKind.CROP
        note = (
            f"{sizes}: they are assumed to be cropped on the right or at the bottom "
            f"(--image-placement {name}=crop); if they were cropped on both sides, give "
            f"{name}=crop-centre; if resized, {name}=scale"
        )
    # The same aspect ratio, up to rounding of both sides to whole pixels.
    elif abs(width / full_width - height / full_height) <= 1 / full_width + 1 / full_height:
        kind = PlacementKind.SCALE
        note = (
            f"{sizes} of the same aspect ratio: they are assumed to be resized "
            f"(--image-placement {name}=scale)"
        )
    elif (height, width) == calibrated_size:
        raise InputError(
            f"{sizes}: the pictures are rotated by 90 degrees; rotate the video, or calibrate it "
            "as it is"
        )
    else:
        raise InputError(
            f"{sizes}; give --image-placement: letterbox (resized, with bars), scale"
            " (resized), crop or crop-centre (cropped)"
        )
    return Placement(kind, picture_size, calibrated_size), note


@dataclass(frozen=True)
class CameraFootage:
    """The pictures of one camera from which detections were made."""

    name: str
    """Name of the camera."""
    path: Path
    """The video, picture, or folder of pictures."""
    placement: Placement
    """Position of calibrated pixels in the pictures."""
    places: Index
    """(T,) index of the picture of each frame, counted from 0 in the file; -1 if there is none."""


_Size = tuple[PositiveInt, PositiveInt]


class _Camera(BaseModel, extra="forbid"):
    name: str
    path: str
    placement: PlacementKind
    picture_size: _Size
    calibrated_size: _Size
    pictures: list[int] = Field(max_length=10_000_000)


class _File(BaseModel):
    format: Literal["shapepose-fg footage 1"]
    cameras: list[_Camera]


def write_used_footage(file: Path, cameras: Sequence[CameraFootage], about: dict[str, Any]) -> None:
    """Write footage.json as `file`, with further entries `about`."""
    entries = [
        {
            "name": each.name,
            "path": str(each.path),
            "placement": str(each.placement.kind),
            "picture_size": list(each.placement.picture_size),
            "calibrated_size": list(each.placement.calibrated_size),
            "pictures": each.places.tolist(),
        }
        for each in cameras
    ]
    content = {"format": "shapepose-fg footage 1", **about, "cameras": entries}
    write_content(file, json.dumps(content, indent=1, allow_nan=False))


def read_used_footage(file: Path) -> list[CameraFootage]:
    """Read a file written by `write_used_footage`; InputError, one sentence, for any other
    content.
    """
    found = []
    for camera in validated(_File, read_json(file), file, "run shapepose-fg detect again").cameras:
        placement = Placement(camera.placement, camera.picture_size, camera.calibrated_size)
        places = np.array(camera.pictures, dtype=np.intp)
        found.append(CameraFootage(camera.name, Path(camera.path), placement, places))
    return found
