"""Lens distortion and its inverse: OpenCV's models, also for intrinsics with skew."""

from collections.abc import Sequence
from typing import Literal

import cv2
import numpy as np

from shapepose_fg.core.arrays import Array

Lens = Literal["perspective", "fisheye"]
"""OpenCV's two families of lenses: Brown's model with its rational extension, and the equidistant
fisheye."""
COEFFICIENTS: dict[str, tuple[int, ...]] = {"perspective": (5, 8, 12, 14), "fisheye": (4,)}
"""Numbers of coefficients that OpenCV's functions accept, for each kind of lens."""


def undistorted(xy: Array, K: Array, distortion: Array, lens: Lens) -> Array:
    """See `Camera.undistort`: undistorted pixels (N, 2); NaN if there are none."""
    if len(xy) == 0 or not _bends(distortion, lens):
        return xy
    rays = _normalised(xy, K).reshape(-1, 1, 2)
    undo = cv2.fisheye.undistortPoints if lens == "fisheye" else cv2.undistortPoints
    # Number of iterations and accuracy, in normalised coordinates, for inverting a
    # distortion.
    ideal = np.asarray(
        undo(
            rays,
            np.eye(3),
            distortion,
            criteria=(cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12),
        ),
        dtype=np.float64,
    )
    pixels = ideal.reshape(-1, 2) @ K[:2, :2].T + K[:2, 2]
    with np.errstate(invalid="ignore", over="ignore"):
        # Maximum error when an undistorted point is distorted again, pixels. Above it,
        # the distortion cannot be inverted at this point. If it can, OpenCV's iteration
        # ends within 1e-6 px.
        undone = np.abs(distorted(pixels, K, distortion, lens) - xy).max(axis=1) < 0.5
    pixels[~undone] = np.nan
    return pixels


def distorted(xy: Array, K: Array, distortion: Array, lens: Lens) -> Array:
    """See `Camera.distort`: distorted pixels (N, 2)."""
    if len(xy) == 0 or not _bends(distortion, lens):
        return xy
    rays = _normalised(xy, K)
    if lens == "fisheye":
        bent = cv2.fisheye.distortPoints(rays.reshape(-1, 1, 2), np.eye(3), distortion)
    else:
        rays = np.concatenate([rays, np.ones((len(rays), 1))], axis=1)
        bent, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), np.eye(3), distortion)
    bent = np.asarray(bent, dtype=np.float64).reshape(-1, 2)
    return bent @ K[:2, :2].T + K[:2, 2]


def padded_distortion(coefficients: Sequence[float], lens: Lens = "perspective") -> Array:
    """`coefficients` padded with zeros to the next number that OpenCV accepts; ValueError if there
    are too many.
    """
    given = np.asarray(coefficients, dtype=np.float64)
    for count in COEFFICIENTS[lens]:
        if len(given) <= count:
            return np.concatenate([given, np.zeros(count - len(given))])
    raise ValueError(f"a {lens} lens has at most {count} distortion coefficients, got {len(given)}")


def _bends(distortion: Array, lens: Lens) -> bool:
    """Whether the lens moves any pixel; a fisheye does even if all coefficients are zero."""
    return lens == "fisheye" or bool(distortion.any())


def _normalised(xy: Array, K: Array) -> Array:
    """Normalised image coordinates (N, 2) of pixels (N, 2); unlike OpenCV's functions, with the
    skew in K.
    """
    inverse = np.linalg.inv(K)
    return np.ascontiguousarray(xy @ inverse[:2, :2].T + inverse[:2, 2])
