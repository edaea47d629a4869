"""Renders triangle meshes into a camera: one z-buffer for visibility and for pictures.

Pixels follow OpenCV: the centre of the first pixel is (0, 0). A surface nearer than `NEAR_M` is not drawn.
"""

import threading
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.arrays import Array, Index, Real, Whole
from shapepose_fg.core.camera import Camera
from shapepose_fg.core.decompositions import rigid

NEAR_M = 0.05
"""Depth below which faces with a corner are dropped, m: nothing is clipped."""
_FAR_M = 100.0
"""Depth beyond which OpenCV draws no faces, m."""
_NUMBER = np.float32(2.0**-20)
"""Colour step per vertex number: OpenCV takes colours of 0 to 1, and float32 holds these exactly."""
_FLAT = (
    cv2.TriangleRasterizeSettings()
    .setShadingType(cv2.RASTERIZE_SHADING_FLAT)
    .setCullingMode(cv2.RASTERIZE_CULLING_CW)
)


@dataclass(frozen=True)
class Surface:
    """The first surface on the ray of every pixel."""

    depth: NDArray[np.float32]
    """(H, W) depth along the optical axis, metres; inf where the ray meets nothing."""
    face: NDArray[np.int32]
    """(H, W) index of the visible face; -1 where there is none."""


def look_at(eye: Array, target: Array, up: Array) -> Array:
    """Pose `wTc` (4, 4) of a camera at `eye` (3,) that looks at `target` (3,), image up towards `up` (3,)."""
    forward = np.asarray(target, dtype=np.float64) - eye
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, up)
    if np.linalg.norm(right) < 1e-9:
        raise ValueError("look_at: the line of sight must not be parallel to up; move the eye or the target")
    right /= np.linalg.norm(right)
    return rigid(np.column_stack([right, np.cross(forward, right), forward]), eye)


def zoom(camera: Camera, box: tuple[float, float, float, float], width: int) -> Camera:
    """The camera of an enlarged window of the image: `box` (left, top, right, bottom) px, `width` px wide."""
    left, top, right, bottom = box
    scale = width / (right - left)
    K = camera.K.copy()
    # Edges, not centres, of pixels are scaled: hence the half pixels.
    K[:2, 2] = (K[:2, 2] + 0.5 - (left, top)) * scale - 0.5
    K[:2, :2] *= scale
    return Camera(camera.name, K, camera.wTc, (width, max(1, round((bottom - top) * scale))))


def scaled(camera: Camera, scale: float) -> Camera:
    """Return the camera with an image of `scale` times the size, without its distortion."""
    width, height = camera.image_size
    return zoom(camera, (0.0, 0.0, width, height), max(1, round(width * scale)))


def first_surface_at(
    points_world: Real, faces: Whole, camera: Camera, column: Index, row: Index
) -> tuple[NDArray[np.float32], Index]:
    """Depth and vertex, each of the shape of `column` and `row`, of the first surface on the rays of some pixels.

    The vertex is the first corner of the visible face. inf and -1 where nothing is. Equal to the picture of
    `rasterise`, in half the time. At most 2**20 points.
    """
    width, height = camera.image_size
    # In double precision: what a product in single precision rounds depends on the processor, and moves edges.
    points = camera.cTw[:, :3] @ np.asarray(points_world, dtype=np.float64).T + camera.cTw[:, 3:]
    near = points[2] <= NEAR_M
    if near.any():  # OpenCV draws a face that reaches behind the camera all over the image
        faces = faces[~near[faces].any(axis=1)]
    if len(faces) == 0:
        return np.full(row.shape, np.inf, dtype=np.float32), np.full(row.shape, -1, dtype=np.intp)
    colour, depth = _canvas.blank(height, width)
    corners, number = _as_opengl(points, camera), _numbers(points.shape[1])
    cv2.triangleRasterize(corners, faces, number, colour, depth, np.eye(4), 1.0, NEAR_M, _FAR_M, _FLAT)
    met = colour[row, column, 0]
    vertex = np.where(met >= 0, np.rint(met / _NUMBER), -1).astype(np.intp)
    return np.where(met >= 0, depth[row, column], np.float32(np.inf)), vertex


def _as_opengl(points: Array, camera: Camera) -> NDArray[np.float32]:
    """(N, 3) where a camera of 1 radian, y up, z back, sees points as `camera` sees `points` (3, N) of its own
    frame.
    """
    (width, height), K = camera.image_size, camera.K
    focal = height / 2 / np.tan(0.5)
    # OpenCV's pixels have their centres at halves there; a shear moves the principal point to the middle.
    right, down, ahead = points
    seen = np.empty((len(right), 3), dtype=np.float32)
    seen[:, 0] = (K[0, 0] * right + K[0, 1] * down + (K[0, 2] + 0.5 - width / 2) * ahead) / focal
    seen[:, 1] = (K[1, 1] * down + (K[1, 2] + 0.5 - height / 2) * ahead) / -focal
    seen[:, 2] = -ahead
    return seen


class _Canvas(threading.local):
    """Reused buffers of a thread: new memory takes a third of the time of drawing."""

    def __init__(self) -> None:
        self._colour = self._depth = np.empty(0, dtype=np.float32)

    def blank(self, height: int, width: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Colour (H, W, 3), -1 everywhere, and depth (H, W), `_FAR_M` everywhere; until the next call."""
        if self._depth.shape != (height, width):
            self._colour = np.empty((height, width, 3), dtype=np.float32)
            self._depth = np.empty((height, width), dtype=np.float32)
        self._colour.fill(-1.0)
        self._depth.fill(_FAR_M)
        return self._colour, self._depth


_canvas = _Canvas()


@lru_cache(maxsize=4)
def _numbers(count: int) -> NDArray[np.float32]:
    """(N, 3) colours that encode the numbers of vertices."""
    number = np.zeros((count, 3), dtype=np.float32)
    number[:, 0] = np.arange(count, dtype=np.float32) * _NUMBER
    return number


def rasterise(xy: Real, depth: Real, faces: Whole, size: tuple[int, int]) -> Surface:
    """Draw triangles with corners at pixels `xy` (N, 2) and `depth` (N,) into an image of `size` (W, H), by
    OpenCV.

    1/depth is linear in the image, so that depth is exact inside a face. Corners that are NaN, or nearer than
    `NEAR_M`, drop their faces. Faces seen from behind are left out: right, and twice as fast, for closed meshes
    whose faces turn counter-clockwise when seen from outside. At most 2**20 faces are drawn.
    """
    width, height = size
    drawable = np.isfinite(xy).all(axis=1) & (depth > NEAR_M)
    index = np.flatnonzero(drawable[faces].all(axis=1))
    if len(index) == 0:
        nothing = np.full((height, width), np.inf, dtype=np.float32)
        return Surface(nothing, np.full((height, width), -1, dtype=np.int32))
    # As in `_as_opengl`, for pixels: x / z and y / z are what OpenCV scales by its own focal length.
    focal = height / 2 / np.tan(0.5)
    middle = np.array([width / 2, height / 2]) - 0.5
    flat = (xy - middle) * depth[:, None] / focal * (1.0, -1.0)
    corners = np.column_stack([flat, -depth])[faces[index]].reshape(-1, 3).astype(np.float32)
    number = np.repeat(_numbers(len(index)), 3, axis=0)
    colour = np.full((height, width, 3), -1.0, dtype=np.float32)
    met = np.full((height, width), _FAR_M, dtype=np.float32)
    each = np.arange(len(corners), dtype=np.int32).reshape(-1, 3)
    cv2.triangleRasterize(corners, each, number, colour, met, np.eye(4), 1.0, NEAR_M, _FAR_M, _FLAT)
    hit = colour[..., 0] >= 0
    face = np.where(hit, index[np.where(hit, np.rint(colour[..., 0] / _NUMBER), 0).astype(np.intp)], -1)
    return Surface(np.where(hit, met, np.float32(np.inf)), face.astype(np.int32))
