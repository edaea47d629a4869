"""Where the calibrated picture lies in the pictures of the footage, if these have another size."""

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.errors import InputError

_BLOCK = 16
"""Video coders work in blocks of this many pixels: a few columns or rows come and go with them."""


class PlacementKind(StrEnum):
    """How pictures of another size come from calibrated ones."""

    SAME = "same"
    """They have the same size."""
    CROP = "crop"
    """Columns on the right and rows at the bottom were cut off, or added."""
    CROP_CENTRE = "crop-centre"
    """The same, equally on both sides."""
    SCALE = "scale"
    """They were resized, each axis on its own."""
    LETTERBOX = "letterbox"
    """They were resized alike along both axes, with bars on two sides."""


@dataclass(frozen=True)
class Placement:
    """How calibrated pixels lie in a picture: along each axis, edges at scale * u + shift."""

    kind: PlacementKind
    """Where it comes from."""
    scale: tuple[float, float]
    """Pixels of the picture per calibrated pixel, x and y."""
    shift: tuple[float, float]
    """Where the left and upper edges of the calibrated picture are in the picture, pixels from its own edges."""
    picture_size: tuple[int, int]
    """(width, height) of the pictures."""
    calibrated_size: tuple[int, int]
    """(width, height) that the calibration is for."""

    @classmethod
    def of(
        cls, kind: PlacementKind, picture_size: tuple[int, int], calibrated_size: tuple[int, int]
    ) -> "Placement":
        """The placement of a given kind."""
        picture, calibrated = np.array(picture_size, dtype=float), np.array(calibrated_size, dtype=float)
        scale = np.ones(2)
        if kind is PlacementKind.SCALE:
            scale = picture / calibrated
        elif kind is PlacementKind.LETTERBOX:
            scale = np.full(2, (picture / calibrated).min())
        centred = kind in (PlacementKind.LETTERBOX, PlacementKind.CROP_CENTRE)
        shift = (picture - scale * calibrated) / 2 if centred else np.zeros(2)
        (scale_x, scale_y), (shift_x, shift_y) = scale.tolist(), shift.tolist()
        return cls(kind, (scale_x, scale_y), (shift_x, shift_y), picture_size, calibrated_size)

    @property
    def region(self) -> tuple[float, float, float, float]:
        """Left, top, right, bottom edge of what is calibrated and in the picture; 0 is a pixel's centre."""
        low = np.maximum(self.shift, 0.0)
        high = np.minimum(np.array(self.shift) + np.array(self.scale) * self.calibrated_size, self.picture_size)
        left, top, right, bottom = np.concatenate([low, high]) - 0.5
        return float(left), float(top), float(right), float(bottom)

    def to_picture(self, xy: NDArray[np.float64]) -> NDArray[np.float64]:
        """Pixels (..., 2) of the picture from calibrated pixels (as the lens gives them)."""
        return (xy + 0.5) * self.scale + self.shift - 0.5

    def to_calibrated(self, xy: NDArray[np.float64]) -> NDArray[np.float64]:
        """Calibrated pixels (..., 2) from pixels of the picture."""
        return (xy + 0.5 - self.shift) / self.scale - 0.5


def place(
    name: str, picture_size: tuple[int, int], calibrated_size: tuple[int, int], wanted: PlacementKind | None
) -> tuple[Placement, str | None]:
    """How the pictures of camera `name` are placed, and a sentence where that was concluded from their sizes.

    Concluded are: equal sizes; a difference of up to 16 pixels, which was cut off or added on the right or at the
    bottom; and otherwise the same shape at another size, which was resized. InputError for any other size, unless
    `wanted` says what was done, and where what is wanted is impossible.
    """
    (width, height), (full_width, full_height) = picture_size, calibrated_size
    sizes = (
        f"camera {name}: the pictures are {width} x {height}, the calibration is for {full_width} x {full_height}"
    )
    if wanted is not None:
        if wanted is PlacementKind.SAME and picture_size != calibrated_size:
            raise InputError(f"{sizes}: not the same size; give another --image-placement")
        return Placement.of(wanted, picture_size, calibrated_size), None
    if picture_size == calibrated_size:
        return Placement.of(PlacementKind.SAME, picture_size, calibrated_size), None
    if max(abs(width - full_width), abs(height - full_height)) <= _BLOCK:
        cropped = Placement.of(PlacementKind.CROP, picture_size, calibrated_size)
        return cropped, (
            f"{sizes}: the first column and row are taken to be the calibrated ones (--image-placement"
            f" {name}=crop); if it was cut on both sides, give {name}=crop-centre; if it was resized, {name}=scale"
        )
    # Of one shape, to within the rounding of both sides to whole pixels.
    if abs(width / full_width - height / full_height) <= 1 / full_width + 1 / full_height:
        scaled = Placement.of(PlacementKind.SCALE, picture_size, calibrated_size)
        return scaled, f"{sizes}, of the same shape: taken as resized (--image-placement {name}=scale)"
    if (height, width) == calibrated_size:
        raise InputError(
            f"{sizes}: the pictures lie on their side; turn the video by 90 degrees, or calibrate it as it is"
        )
    raise InputError(
        f"{sizes}; say what was done to them with --image-placement: letterbox (resized, with bars), scale"
        " (resized), crop or crop-centre (cut)"
    )
