"""Where grouped sightings are in space, and what remains of each camera's pixels: structure without a body."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.camera import Views
from shapepose_fg.setup_check.matching import Groups, centres_of
from shapepose_fg.setup_check.sightings import Sightings

Array = NDArray[np.float64]

_STEPS = 6
"""Gauss-Newton steps of a robust triangulation; errors fall under a hundredth of a pixel in four."""
KERNEL = 0.02
"""Width of the Cauchy kernel, as a part of a person's size in the picture: a detector errs by 3 cm of 170."""


@dataclass(frozen=True)
class Structure:
    """P people, J joints, V cameras."""

    points: Array
    """(P, J, 3) in the world, the calibration's unit; NaN where fewer than two cameras saw a joint."""
    xy: Array
    """(P, J, V, 2) detections, undistorted pixels; NaN where there is none."""
    residual: Array
    """(P, J, V, 2) projection minus detection, pixels; NaN where there is none."""
    depth: Array
    """(P, J, V) depth of each joint before each camera, the calibration's unit."""
    size_px: Array
    """(P, V) the person's size in each picture."""
    weight: Array
    """(P, J, V) robust weight of each detection, in 1 / pixels^2 of a unit of its noise; 0 where there is none."""
    jacobian: Array
    """(P, J, V, 2, 3) derivative of each projection by the point."""


def observed(groups: Groups, sightings: Sightings) -> tuple[Array, Array, Array]:
    """Detections (P, J, V, 2), confidences (P, J, V) and sizes (P, V) of groups; NaN, 0 and NaN for none."""
    there = groups.member >= 0
    xy = np.where(there[..., None, None], sightings.xy[groups.member], np.nan)
    confidence = np.where(there[..., None], sightings.confidence[groups.member], 0.0)
    size = np.where(there, sightings.size_px[groups.member], np.nan)
    return np.moveaxis(xy, 1, 2), np.moveaxis(confidence, 1, 2), size


def triangulate(xy: Array, confidence: Array, size: Array, views: Views, steps: int = _STEPS) -> Structure:
    """Robust triangulation of all joints: linear, then reweighted Gauss-Newton.

    Needs two cameras for a joint; see `observed` for the arguments.
    """
    seen = ~np.isnan(xy[..., 0])
    prior = np.where(seen, confidence, 0.0) / (KERNEL * np.where(np.isnan(size), 1.0, size)[:, None]) ** 2
    prior = np.where((seen.sum(axis=-1) >= 2)[..., None], prior, 0.0)
    points = _linear(xy, prior, views)
    weight = prior
    for _ in range(steps):
        pixels, depth, jacobian = views.project(points)
        residual = np.where(seen[..., None] & (prior > 0)[..., None], pixels - xy, np.nan)
        ok = ~np.isnan(residual[..., 0])
        square = np.where(ok, prior * np.nansum(residual**2, axis=-1), 0.0)
        weight = np.where(ok, prior / (1 + square), 0.0)
        root = np.sqrt(weight)[..., None]
        A = np.where(ok[..., None, None], jacobian, 0.0) * root[..., None]
        A = A.reshape(*A.shape[:2], 2 * len(views), 3)
        r = (np.where(ok[..., None], residual, 0.0) * root).reshape(*A.shape[:3], 1)
        H = A.swapaxes(-1, -2) @ A
        scale = np.trace(H, axis1=-2, axis2=-1)[..., None, None]
        H = H + (1e-9 * scale + 1e-300) * np.eye(3)
        points = points - np.linalg.solve(H, A.swapaxes(-1, -2) @ r)[..., 0]
    pixels, depth, jacobian = views.project(points)
    residual = np.where((prior > 0)[..., None], pixels - xy, np.nan)
    return Structure(points, xy, residual, depth, size, weight, jacobian)


def _linear(xy: Array, weight: Array, views: Views) -> Array:
    """(P, J, 3) points nearest to all rays, squares weighted; NaN where fewer than two cameras see a joint."""
    inverse = np.linalg.inv(views.K)
    to_world = views.cTw[:, :, :3].swapaxes(1, 2) @ inverse
    rays = (to_world[:, :, :2] @ xy[..., None])[..., 0] + to_world[:, :, 2]
    rays = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    seen = weight > 0
    rays = np.where(seen[..., None], rays, 0.0)
    centres = centres_of(views)
    # Sum over views of (1 - d d') x = sum of (1 - d d') c.
    A = seen.sum(axis=-1)[..., None, None] * np.eye(3) - rays.swapaxes(-1, -2) @ rays
    along = (rays * centres).sum(axis=-1, keepdims=True)
    b = seen.astype(np.float64) @ centres - (rays * along).sum(axis=-2)
    enough = seen.sum(axis=-1) >= 2
    A = np.where(enough[..., None, None], A + 1e-12 * np.eye(3), np.eye(3))
    return np.where(enough[..., None], np.linalg.solve(A, b[..., None])[..., 0], np.nan)
