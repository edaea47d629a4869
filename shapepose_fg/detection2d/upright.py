"""Rotates pictures so that gravity points down, at the size of a network's input, and back.

Detectors are trained on upright people. They detect half as many people in rolled pictures.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.arrays import Array, Mask
from shapepose_fg.core.camera import Camera

LEVEL_DEG = 5.0
"""Roll below which pictures are not rotated, degrees: people lean by as much, and rotation cuts off
corners."""


def roll_of(camera: Camera, up: Array) -> float:
    """Clockwise rotation, degrees, of the picture of `camera` after which `up` (3,) points up at
    its centre.

    0 if the camera looks straight up or down.
    """
    x, y, z = camera.cTw[:, :3] @ up
    width, height = camera.image_size
    right, down, _ = np.linalg.solve(camera.K, [(width - 1) / 2, (height - 1) / 2, 1.0])
    # Motion of the projection of a point at the image centre when the point moves up.
    across, along = x - right * z, y - down * z
    # Length of the projected vertical (unit vector) below which the camera looks along the
    # vertical, and no direction of the picture is up: the sine of 10 degrees.
    if np.hypot(across, along) < 0.17:
        return 0.0
    return -float(np.degrees(np.arctan2(across, -along)))


@dataclass(frozen=True)
class UprightView:
    """Maps a region of a picture to the input of a network, rotated upright."""

    size: tuple[int, int]
    """Width and height of the network's input, pixels."""
    input_from_picture: Array
    """(2, 3) affine map of the picture's pixels to those of the input."""
    region: tuple[float, float, float, float]
    """Left, top, right, bottom edge of the region, pixels of the picture; the centre of the first
    pixel is 0."""
    turn_deg: float
    """Rotation of the picture, degrees clockwise."""

    @property
    def scale(self) -> float:
        """Pixels of the input per pixel of the picture."""
        return float(np.sqrt(abs(np.linalg.det(self.input_from_picture[:, :2]))))

    @classmethod
    def of(
        cls,
        region: tuple[float, float, float, float],
        roll_deg: float,
        long_side: int | None = None,
        multiple: int = 1,
        only_size: tuple[int, int] | None = None,
    ) -> "UprightView":
        """The view of a `region` rotated clockwise by `roll_deg`, about `long_side` pixels along
        its longer side.

        Without `long_side`, the scale is 1. Rolls under `LEVEL_DEG` from a multiple of 90 degrees
        are rotated by that multiple. Both sides are the nearest multiples of `multiple`, so that
        the axes' scales differ by a few per cent. A network with inputs of `only_size` (width,
        height) gets the region in the middle of such a picture.
        """
        quarter = 90.0 * round(roll_deg / 90.0)
        roll_deg = quarter if abs(roll_deg - quarter) < LEVEL_DEG else roll_deg
        left, top, right, bottom = region
        angle = np.radians(roll_deg)
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        corners = np.array([[left, top], [right, top], [right, bottom], [left, bottom]]) @ turn.T
        low, high = corners.min(axis=0), corners.max(axis=0)
        sides = high - low
        if only_size is None:
            scale = 1.0 if long_side is None else long_side / sides.max()
            size = np.maximum(np.round(sides * scale / multiple), 1) * multiple
            stretch = np.diag(size / sides)
        else:
            size = np.array(only_size)
            stretch = np.eye(2) * (size / sides).min()
        # The edges of pixels are scaled, not their centres, hence the half pixel.
        matrix = np.column_stack([stretch @ turn, (size - stretch @ (low + high)) / 2 - 0.5])
        return cls((int(size[0]), int(size[1])), matrix, region, roll_deg)

    def input_of(self, picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The network's input (height, width, 3) of a `picture`; outside the region it has the mean
        colour.
        """
        left, top, right, bottom = (round(edge + 0.5) for edge in self.region)
        part = picture[max(top, 0) : bottom, max(left, 0) : right]
        matrix = self.input_from_picture.copy()
        matrix[:, 2] += matrix[:, :2] @ (max(left, 0), max(top, 0))
        # First reduced by area averaging: direct sampling of a much larger picture would skip most
        # of its pixels.
        size = np.maximum(np.round(np.array(part.shape[1::-1]) * min(self.scale, 1.0)), 1).astype(
            int
        )
        small, ratio = (
            cv2.resize(part, size.tolist(), interpolation=cv2.INTER_AREA),
            part.shape[1::-1] / size,
        )
        matrix[:, 2] += matrix[:, :2] @ (0.5 * ratio - 0.5)
        matrix[:, :2] = matrix[:, :2] * ratio
        turned = cv2.warpAffine(
            small, matrix, self.size, flags=cv2.INTER_LINEAR, borderValue=cv2.mean(small)[:3]
        )
        return np.asarray(turned, dtype=np.uint8)

    def picture_from_input(self, xy: Array) -> Array:
        """Pixels (..., 2) of the picture for pixels of the input."""
        return (xy - self.input_from_picture[:, 2]) @ np.linalg.inv(
            self.input_from_picture[:, :2]
        ).T

    def inside(self, xy: Array) -> Mask:
        """(...,) which pixels (..., 2) of the picture lie in the region."""
        left, top, right, bottom = self.region
        x, y = xy[..., 0], xy[..., 1]
        return (x >= left) & (x <= right) & (y >= top) & (y <= bottom)
