"""Joints of associated people, triangulated robustly by all of their cameras, or by all but one."""

import math
from dataclasses import dataclass

import numpy as np

from shapepose_fg.cameras.sightings import Groups, Pinhole, Sightings
from shapepose_fg.core.arrays import Array, Mask
from shapepose_fg.core.camera import Views
from shapepose_fg.core.compiled import kernel
from shapepose_fg.core.kernel_geometry import add_view, project, solved, triangulated

KERNEL = 0.02
"""Width of the Cauchy kernel, as a share of a person's size in the picture: a detector errs by 3 cm
of 170."""


@dataclass(frozen=True)
class Structure:
    """Triangulated joints: P people, J joints, V cameras."""

    points: Array
    """(P, J, 3) in the world, the calibration's unit; NaN where fewer than two cameras saw a
    joint."""
    xy: Array
    """(P, J, V, 2) detections, undistorted pixels; NaN where there is none."""
    miss_px: Array
    """(P, J, V) reprojection error, pixels; NaN without a detection."""
    depth: Array
    """(P, J, V) depth of each joint in each camera, in the calibration's unit."""
    size_px: Array
    """(P, V) the person's size in each picture, pixels."""
    weight: Array
    """(P, J, V) robust weight of each detection, 1 / pixels^2, up to its noise; 0 without a
    detection."""


def observed(groups: Groups, sightings: Sightings) -> tuple[Array, Array, Array]:
    """Detections (P, J, V, 2), confidences (P, J, V) and sizes (P, V) of groups; NaN, 0 and NaN if
    missing.
    """
    has_sighting = groups.member >= 0
    xy = np.where(has_sighting[..., None, None], sightings.xy[groups.member], np.nan)
    confidence = np.where(has_sighting[..., None], sightings.confidence[groups.member], 0.0)
    size = np.where(has_sighting, sightings.size_px[groups.member], np.nan)
    return np.moveaxis(xy, 1, 2), np.moveaxis(confidence, 1, 2), size


def triangulate(
    xy: Array, confidence: Array, size: Array, views: Views, steps: int = 6
) -> Structure:
    """Robust triangulation of the arrays of `observed`, two or more views: linear, then `steps` of
    reweighted Gauss-Newton; errors are below 0.01 px after four.
    """
    seen = ~np.isnan(xy[..., 0])
    prior = (
        np.where(seen, confidence, 0.0)
        / (KERNEL * np.where(np.isnan(size), 1.0, size)[:, None]) ** 2
    )
    prior = np.where((seen.sum(axis=-1) >= 2)[..., None], prior, 0.0)
    xy, prior = np.ascontiguousarray(xy), np.ascontiguousarray(prior)
    points = np.empty((*prior.shape[:2], 3))
    miss_px, depth, weight = (np.empty(prior.shape) for _ in range(3))
    _triangulate(
        xy, prior, views.K @ views.cTw, views.focal[0], steps, points, miss_px, depth, weight
    )
    return Structure(points, xy, miss_px, depth, size, weight)


def left_out(
    xy: Array, weight: Array, size: Array, views: Views, used: Mask
) -> tuple[Array, Array]:
    """(P, J, V) distances of detections from joints triangulated by the `used` ones (P, J, V) of
    two or more *other* views only, pixels; and the joints' depths.

    The other arguments are those of `triangulate`.
    """
    px, depth = np.full(weight.shape, np.nan), np.full(weight.shape, np.nan)
    for view in range(len(views)):
        others = used & (np.arange(len(views)) != view)
        kept = np.where(others[..., None], xy, np.nan)
        placed = triangulate(kept, np.where(others, weight, 0.0), size, views)
        at, depth[..., view] = Pinhole(views.K[view], views.cTw[view]).project(placed.points)
        px[..., view] = np.linalg.norm(at - xy[..., view, :], axis=-1)
    return px, depth


@kernel("f4 f3 f3 f1 i0 f3 f3 f3 f3")
def _triangulate(
    xy: Array,
    prior: Array,
    cameras: Array,
    focal: Array,
    steps: int,
    points: Array,
    miss_px: Array,
    depth: Array,
    weight: Array,
) -> None:
    """Kernel of `triangulate`, with K [R t] as `cameras` (V, 3, 4), and their `focal` lengths (V,),
    pixels.
    """
    A, b, x, step_m = np.empty((3, 3)), np.empty(3), np.empty(3), np.empty(3)
    views, room = len(cameras), np.empty(len(cameras))
    for p in range(prior.shape[0]):
        for j in range(prior.shape[1]):
            x[0] = x[1] = x[2] = math.nan
            seen = 0
            for v in range(views):
                seen += prior[p, j, v] > 0
            if seen >= 2:
                triangulated(
                    cameras, focal, xy[p, j], prior[p, j], math.inf, math.inf, -math.inf, room, x
                )
            for step in range(steps + 1):
                for i in range(3):
                    b[i] = A[i, 0] = A[i, 1] = A[i, 2] = 0.0
                for v in range(views):
                    u, w, z = project(cameras[v], x)
                    depth[p, j, v], miss_px[p, j, v], weight[p, j, v] = z, math.nan, 0.0
                    if z > 0 and prior[p, j, v] > 0:
                        du, dw = u - xy[p, j, v, 0], w - xy[p, j, v, 1]
                        square = du * du + dw * dw
                        miss_px[p, j, v] = math.sqrt(square)
                        weight[p, j, v] = prior[p, j, v] / (1 + prior[p, j, v] * square)
                        add_view(cameras[v], u, w, z, du, dw, weight[p, j, v], A, b)
                if step < steps:
                    least = 1e-9 * (A[0, 0] + A[1, 1] + A[2, 2]) + 1e-300
                    for i in range(3):
                        A[i, i] += least
                    solved(
                        A[0, 0],
                        A[0, 1],
                        A[0, 2],
                        A[1, 1],
                        A[1, 2],
                        A[2, 2],
                        b[0],
                        b[1],
                        b[2],
                        step_m,
                    )
                    for i in range(3):
                        x[i] -= step_m[i]
            points[p, j, 0], points[p, j, 1], points[p, j, 2] = x[0], x[1], x[2]
