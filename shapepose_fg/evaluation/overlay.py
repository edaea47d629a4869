"""Joints and bodies drawn over a picture of the camera that saw them.

Pictures are undistorted (`undistorted`): what is drawn then needs no lens.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from shapepose_fg.camera import Camera
from shapepose_fg.rendering import render_depth
from shapepose_fg.skeleton import BODY_25

Picture = NDArray[np.uint8]
"""(H, W, 3) blue, green, red."""

_RIGHT, _LEFT, _MIDDLE = (60, 60, 255), (255, 160, 40), (60, 220, 60)
"""Red is right, blue left, green the middle."""
_BONES = tuple((parent, joint) for joint, parent in enumerate(BODY_25.parents) if parent >= 0)


def undistorted(picture: Picture, camera: Camera) -> Picture:
    """The `picture` as `camera` would have taken it without its distortion, cropped or filled to its size."""
    width, height = camera.image_size
    full = np.zeros((height, width, 3), dtype=np.uint8)
    rows, columns = min(height, picture.shape[0]), min(width, picture.shape[1])
    full[:rows, :columns] = picture[:rows, :columns]
    return np.asarray(cv2.undistort(full, camera.K, camera.distortion), dtype=np.uint8)


def draw_bodies(
    picture: Picture, camera: Camera, vertices: NDArray[np.floating], faces: NDArray[np.integer]
) -> Picture:
    """The surfaces `vertices` (P, Nv, 3) metres, half transparent, lit from the camera."""
    if len(vertices) == 0:
        return picture
    count = vertices.shape[1]
    points = vertices.reshape(-1, 3).astype(np.float64)
    corners = (faces[None] + count * np.arange(len(vertices))[:, None, None]).reshape(-1, 3)
    surface = render_depth(points, corners, camera, cull_back=True)
    first, second, third = points[corners.T]
    normal = np.cross(second - first, third - first)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    light = np.clip(-(normal @ camera.wTc[:3, 2]), 0.15, 1.0)
    row, column = np.nonzero(surface.face >= 0)
    shade = 230.0 * light[surface.face[row, column]][:, None] * np.array([0.85, 1.0, 0.95])
    drawn = picture.copy()
    drawn[row, column] = (0.4 * picture[row, column] + 0.6 * shade).astype(np.uint8)
    return drawn


def draw_skeletons(picture: Picture, camera: Camera, joints: NDArray[np.float64], width: int = 5) -> Picture:
    """Bones and `joints` (P, 25, 3) of BODY_25, metres; NaN joints are left out."""
    drawn = picture.copy()
    for person in joints:
        xy, _ = camera.project(person)
        known = np.isfinite(xy.sum(axis=1))
        for first, second in _BONES:
            if known[first] and known[second]:
                cv2.line(drawn, _pixel(xy[first]), _pixel(xy[second]), _colour(second), width, cv2.LINE_AA)
        for joint in np.flatnonzero(known).tolist():
            cv2.circle(drawn, _pixel(xy[joint]), width + 1, (255, 255, 255), -1, cv2.LINE_AA)
    return drawn


def cropped(
    picture: Picture, camera: Camera, points: NDArray[np.floating], size: tuple[int, int], margin: float = 0.15
) -> Picture:
    """The part of the `picture` around `points` (K, 3), metres, with a margin, as a picture of `size` (W, H)."""
    xy, _ = camera.project(np.asarray(points, dtype=np.float64))
    xy = xy[np.isfinite(xy.sum(axis=1))]
    if len(xy) == 0:
        return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    middle = (xy.min(axis=0) + xy.max(axis=0)) / 2
    half = (0.5 + margin) * np.ptp(xy, axis=0).max() / max(size) * np.array(size)
    move = np.array(size) / (2 * half)
    matrix = np.array([[move[0], 0, -move[0] * (middle - half)[0]], [0, move[1], -move[1] * (middle - half)[1]]])
    return np.asarray(cv2.warpAffine(picture, matrix, size, flags=cv2.INTER_AREA), dtype=np.uint8)


def _colour(joint: int) -> tuple[int, int, int]:
    name = BODY_25.joints[joint]
    return {"R": _RIGHT, "L": _LEFT}.get(name[0], _MIDDLE)


def _pixel(xy: NDArray[np.float64]) -> tuple[int, int]:
    x, y = np.clip(np.round(xy), -30000, 30000).astype(int).tolist()
    return x, y
