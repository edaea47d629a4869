"""Renders triangle meshes into a camera with a z-buffer, for visibility tests and for pictures.

Pixels follow OpenCV: the centre of the first pixel is (0, 0). A surface nearer than `NEAR_M` is not
drawn.
"""

import threading
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.arrays import Array, Index, Real, Whole
from shapepose_fg.core.camera import Camera
from shapepose_fg.core.decompositions import rigid

NEAR_M = 0.05
"""Minimum depth, m: faces with a nearer corner are dropped, because faces are not clipped."""
_FAR_M = 100.0
"""Maximum depth of faces that OpenCV draws, m."""
_NUMBER = np.float32(2.0**-20)
"""Colour step per vertex number: OpenCV takes colours from 0 to 1, and float32 represents these
steps exactly."""


def look_at(eye: Array, target: Array, up: Array) -> Array:
    """Pose `wTc` (4, 4) of a camera at `eye` (3,) that looks at `target` (3,), image up towards
    `up` (3,).
    """
    forward = np.asarray(target, dtype=np.float64) - eye
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, up)
    if np.linalg.norm(right) < 1e-9:
        raise ValueError(
            "look_at: the line of sight must not be parallel to up; move the eye or the target"
        )
    right /= np.linalg.norm(right)
    return rigid(np.column_stack([right, np.cross(forward, right), forward]), eye)


def scaled(camera: Camera, scale: float) -> Camera:
    """Return the camera with an image of `scale` times the size, and without lens distortion."""
    width, height = camera.image_size
    smaller, K = max(1, round(width * scale)), camera.K.copy()
    scale = smaller / width
    # The edges of pixels are scaled, not their centres, hence the half pixels.
    K[:2, 2] = (K[:2, 2] + 0.5) * scale - 0.5
    K[:2, :2] *= scale
    return Camera(camera.name, K, camera.wTc, (smaller, max(1, round(height * scale))))


def first_surface_at(
    points_world: Real, faces: Whole, camera: Camera, column: Index, row: Index
) -> tuple[NDArray[np.float32], Index]:
    """Depth (metres) and vertex index, each of the shape of `column` and `row`, of the first
    surface along the rays of these pixels.

    The vertex is the first corner of the visible face. Depth is inf and vertex -1 if the ray hits
    nothing. At most 2**20 points.
    """
    width, height = camera.image_size
    # In double precision: single-precision products round differently on different processors,
    # which moves edges.
    points = camera.cTw[:, :3] @ np.asarray(points_world, dtype=np.float64).T + camera.cTw[:, 3:]
    near = points[2] <= NEAR_M
    if near.any():  # OpenCV would draw a face that extends behind the camera across the whole image
        faces = faces[~near[faces].any(axis=1)]
    corners, number = _as_opengl(points, camera), _numbers(points.shape[1])
    colour, depth = _drawn(corners, faces, number, (width, height), cv2.RASTERIZE_SHADING_FLAT)
    met = colour[row, column, 0]
    vertex = np.where(met >= 0, np.rint(met / _NUMBER), -1).astype(np.intp)
    return np.where(met >= 0, depth[row, column], np.float32(np.inf)), vertex


def _as_opengl(points: Array, camera: Camera) -> NDArray[np.float32]:
    """(N, 3) points for OpenCV's renderer (a camera with 1 rad field of view, y up, z backwards)
    that project to the same pixels as `points` (3, N) in the frame of `camera`.
    """
    (width, height), K = camera.image_size, camera.K
    focal = height / 2 / np.tan(0.5)
    # In the renderer, pixel centres are at half-integers; a shear moves the principal point to the
    # image centre.
    right, down, ahead = points
    seen = np.empty((len(right), 3), dtype=np.float32)
    seen[:, 0] = (K[0, 0] * right + K[0, 1] * down + (K[0, 2] + 0.5 - width / 2) * ahead) / focal
    seen[:, 1] = (K[1, 1] * down + (K[1, 2] + 0.5 - height / 2) * ahead) / -focal
    seen[:, 2] = -ahead
    return seen


class _Canvas(threading.local):
    """Reused buffers of a thread, because allocating new memory would take a third of the drawing
    time.
    """

    def __init__(self) -> None:
        self._colour = self._depth = np.empty(0, dtype=np.float32)

    def blank(self, height: int, width: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Colour (H, W, 3), -1 everywhere, and depth (H, W), `_FAR_M` everywhere; valid until the
        next call.
        """
        if self._depth.shape != (height, width):
            self._colour = np.empty((height, width, 3), dtype=np.float32)
            self._depth = np.empty((height, width), dtype=np.float32)
        self._colour.fill(-1.0)
        self._depth.fill(_FAR_M)
        return self._colour, self._depth


_canvas = _Canvas()


@lru_cache(maxsize=4)
def _numbers(count: int) -> NDArray[np.float32]:
    """(N, 3) colours that encode vertex numbers."""
    number = np.zeros((count, 3), dtype=np.float32)
    number[:, 0] = np.arange(count, dtype=np.float32) * _NUMBER
    return number


def shaded(xy: Real, depth: Real, faces: Whole, colour: Real, size: tuple[int, int]) -> Real:
    """Picture (H, W, 3) of triangles, `size` (W, H); -1 where there is none.

    Their corners are at pixels `xy` (N, 2) and at `depth` (N,), metres, with `colour` (N, 3), 0 to
    1, which is interpolated between them. Faces with a corner that is NaN, or nearer than `NEAR_M`,
    are dropped.
    """
    drawable = np.isfinite(xy).all(axis=1) & (depth > NEAR_M)
    # As in `_as_opengl`, for pixels: OpenCV scales x / z and y / z by its own focal length.
    width, height = size
    middle = np.array([width / 2, height / 2]) - 0.5
    flat = (xy - middle) * depth[:, None] / (height / 2 / np.tan(0.5)) * (1.0, -1.0)
    corners = np.where(drawable[:, None], np.column_stack([flat, -depth]), 0.0)
    seen = faces[drawable[faces].all(axis=1)]
    return _drawn(corners.astype(np.float32), seen, colour, size, cv2.RASTERIZE_SHADING_SHADED)[
        0
    ].copy()


def _drawn(
    corners: NDArray[np.float32],
    faces: Whole,
    colour: Real,
    size: tuple[int, int],
    shading: int,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Colour (H, W, 3), -1 where there is no face, and depth (H, W), metres, by OpenCV; valid until
    the next call.

    1/depth is interpolated linearly in the image, so depth is exact inside a face. Back faces are
    culled, which is correct, and twice as fast, for closed meshes with faces that are
    counter-clockwise when seen from outside.
    """
    picture, depth = _canvas.blank(size[1], size[0])
    settings = cv2.TriangleRasterizeSettings().setShadingType(shading)
    settings.setCullingMode(cv2.RASTERIZE_CULLING_CW)
    if len(faces) > 0:
        cv2.triangleRasterize(
            corners,
            np.ascontiguousarray(faces, dtype=np.int32),
            np.ascontiguousarray(colour, dtype=np.float32),
            picture, depth, np.eye(4), 1.0, NEAR_M, _FAR_M, settings,
        )  # fmt: skip
    return picture, depth
