"""Where points of the world lie in a picture as the camera took it: through the lens, at any size."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.camera import Camera
from shapepose_fg.io.footage.placement import Placement
from shapepose_fg.viz.rendering import NEAR_M

_REACH = 0.5
"""Points farther outside the picture than this share of its size are not placed: no lens was calibrated there, and
its polynomial may fold them back into the picture."""


@dataclass(frozen=True)
class PictureView:
    """A camera's pictures, drawn at a size of their own."""

    camera: Camera
    """The camera, with its lens."""
    placement: Placement
    """Where calibrated pixels lie in its pictures."""
    size: tuple[int, int]
    """(width, height) of what is drawn on: the picture, enlarged or made smaller."""

    @property
    def scale(self) -> NDArray[np.float64]:
        """(2,) drawn pixels per pixel of the picture, x and y."""
        return np.array(self.size) / self.placement.picture_size

    def project(self, points: NDArray[np.floating]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Drawn pixels (..., 2) and depths (...,) in metres of `points` (..., 3) in the world.

        Pixels are NaN behind the camera, and far outside the picture.
        """
        xy, depth = self.camera.project(np.asarray(points, dtype=np.float64))
        xy[~(depth > NEAR_M)] = np.nan
        return self.through_lens(xy), depth

    def through_lens(self, xy: NDArray[np.floating]) -> NDArray[np.float64]:
        """Drawn pixels (..., 2) from undistorted ones, as observations have them."""
        flat = np.asarray(xy, dtype=np.float64).reshape(-1, 2)
        size = np.array(self.camera.image_size)
        with np.errstate(invalid="ignore"):
            near = np.all((flat > -_REACH * size) & (flat < (1 + _REACH) * size), axis=1)
        drawn = np.full(flat.shape, np.nan)
        on_picture = self.placement.to_picture(self.camera.distort(flat[near]))
        drawn[near] = (on_picture + 0.5) * self.scale - 0.5
        return drawn.reshape(np.shape(xy))
