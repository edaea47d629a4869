"""The floor as a picture: a plane with a grid and the soft shadows of who stands on it."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.arrays import Array
from shapepose_fg.core.camera import Camera
from shapepose_fg.viz.rendering import rasterise

_CELL_M = 0.5
_SHADOW_PX_PER_M = 100
_PAPER = np.array([0.985, 0.983, 0.978])
_GROUND = np.array([0.918, 0.913, 0.900])
_LINE = np.array([0.79, 0.78, 0.76])
_SHADOW = np.array([0.30, 0.31, 0.36])


@dataclass(frozen=True)
class Floor:
    """A horizontal plane with two axes of its own."""

    origin: Array
    """(3,) the point in the world around which the floor is drawn, metres."""
    axes: Array
    """(2, 3) unit vectors along the floor."""
    up: Array
    """(3,) unit vector."""
    radius_m: float
    """Where the floor has faded into the paper."""

    @classmethod
    def under(cls, points: Array, up: Array, height_m: float, radius_m: float) -> "Floor":
        """A floor `height_m` up, around the middle of `points` (N, 3)."""
        axis = np.eye(3)[np.abs(up).argmin()]
        level = axis - up * (axis @ up)
        first: Array = level / float(np.linalg.norm(level))
        axes = np.stack([first, np.cross(up, first)])
        # The middle falls on a crossing of grid lines, which stay where they are in the world.
        middle = (points @ axes.T).mean(axis=0) if len(points) else np.zeros(2)
        crossing: Array = np.round(middle / _CELL_M) * _CELL_M
        return cls(crossing @ axes + height_m * up, axes, up, radius_m)

    def coordinates(self, points: Array) -> Array:
        """(..., 2) metres along the floor's axes of points (..., 3)."""
        return (points - self.origin) @ self.axes.T

    def at(self, xy: Array) -> Array:
        """(..., 3) the points of the floor with coordinates (..., 2)."""
        return self.origin + xy @ self.axes

    def height(self, points: Array) -> Array:
        """(...,) metres above the floor."""
        return (points - self.origin) @ self.up


def floor_picture(
    floor: Floor, camera: Camera, vertices: Array, faces: NDArray[np.integer], light: Array
) -> Array:
    """Picture (H, W, 3), 0..1, of the floor that `camera` sees, shaded by the bodies `vertices` (N, 3).

    `light` (3,) points from the scene to the light.
    """
    width, height = camera.image_size
    column, row = np.meshgrid(np.arange(width), np.arange(height))
    pixels = np.stack([column, row, np.ones_like(row)], axis=-1)
    ray = pixels @ np.linalg.inv(camera.K).T @ camera.wTc[:3, :3].T
    slope = ray @ floor.up
    eye_height = floor.height(camera.centre)
    met = slope * eye_height < 0
    # Rays above the horizon are sent far away, where the floor has faded.
    reach = np.where(met, -eye_height / np.where(met, slope, 1.0), 1e3)
    ground = floor.coordinates(camera.centre + reach[..., None] * ray)
    footprint = np.maximum(*(np.linalg.norm(np.gradient(ground, axis=axis), axis=-1) for axis in (0, 1)))
    presence = np.where(met, _smooth(1.0 - np.linalg.norm(ground, axis=-1) / floor.radius_m, 0.0, 0.55), 0.0)
    line = _grid(ground, footprint)
    colour = _GROUND + (_LINE - _GROUND) * line[..., None]
    colour = _PAPER + (colour - _PAPER) * presence[..., None]
    shadow = _shadow_map(floor, vertices, faces, light)
    at = ((ground + floor.radius_m) * _SHADOW_PX_PER_M).astype(np.float32)
    dark = cv2.remap(shadow, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
    dark = (np.asarray(dark, dtype=np.float64) * met)[..., None]
    return colour * (1.0 - dark) + _SHADOW * dark


def _grid(ground: Array, footprint: Array) -> Array:
    """How much of a pixel is grid line (H, W): lines 9 mm wide and at least a pixel, fading where they crowd."""
    half = np.maximum(0.0045, 0.5 * footprint)
    distance = np.abs(ground - np.round(ground / _CELL_M) * _CELL_M)
    cover = np.clip(0.5 + (half[..., None] - distance) / footprint[..., None], 0.0, 1.0).max(axis=-1)
    return cover * np.clip(1.3 - footprint / (0.12 * _CELL_M), 0.0, 1.0)


def _shadow_map(floor: Floor, vertices: Array, faces: NDArray[np.integer], light: Array) -> NDArray[np.float32]:
    """Darkness (S, S), 0..1, over the floor's square: a soft cast shadow, and a dense one under the feet."""
    size = int(2 * floor.radius_m * _SHADOW_PX_PER_M)
    if len(vertices) == 0:
        return np.zeros((size, size), dtype=np.float32)
    height = floor.height(vertices)
    cast = vertices - np.maximum(height, 0.0)[:, None] * light / (light @ floor.up)
    result = np.zeros((size, size), dtype=np.float32)
    for points, low, sigma_m, strength in ((cast, np.inf, 0.06, 0.20), (vertices, 0.22, 0.045, 0.42)):
        pixels = (floor.coordinates(points) + floor.radius_m) * _SHADOW_PX_PER_M
        near = faces[(height[faces] < low).all(axis=1)]
        mask = (rasterise(pixels, np.ones(len(pixels)), near, (size, size)).face >= 0).astype(np.float32)
        blurred = np.asarray(cv2.GaussianBlur(mask, (0, 0), sigma_m * _SHADOW_PX_PER_M), dtype=np.float32)
        result = 1.0 - (1.0 - result) * (1.0 - strength * blurred)
    return result.astype(np.float32)


def _smooth(value: Array, low: float, high: float) -> Array:
    """From 0 at `low` to 1 at `high`, without corners."""
    t = np.clip((value - low) / (high - low), 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)
