"""Pieces of kernels that several files share: a camera's view of a point, and what it says of the point.

A `camera` (3, 4) is K [R | t]; a point is (3,) in the world; pixels are undistorted.
"""

import math

from shapepose_fg.core.compiled import part

ROBUST = {None: 0, "none": 0, "huber": 1, "cauchy": 2, "geman_mcclure": 3, "tukey": 4}
"""Robust kernels by their number in compiled functions."""


@part
def robust_weight(robust, ratio):
    """`factors.kernel_weight` of the squared norm over the squared width."""
    if robust == 0:
        return 1.0
    if robust == 1:
        return 1.0 / math.sqrt(max(ratio, 1.0))
    if robust == 2:
        return 1.0 / (1.0 + ratio)
    if robust == 3:
        return 1.0 / (1.0 + ratio) ** 2
    return max(1.0 - ratio, 0.0) ** 2


@part
def project(camera, x):
    """Pixel and depth of a point."""
    depth = camera[2, 0] * x[0] + camera[2, 1] * x[1] + camera[2, 2] * x[2] + camera[2, 3]
    u = camera[0, 0] * x[0] + camera[0, 1] * x[1] + camera[0, 2] * x[2] + camera[0, 3]
    v = camera[1, 0] * x[0] + camera[1, 1] * x[1] + camera[1, 2] * x[2] + camera[1, 3]
    return u / depth, v / depth, depth


@part
def add_view(camera, u, v, depth, to_u, to_v, weight, information, gradient):
    """Add J^T w J and J^T w r, with J the derivative of the pixel (u, v) and r = (to_u, to_v)."""
    for a in range(3):
        ua, va = (camera[0, a] - u * camera[2, a]) / depth, (camera[1, a] - v * camera[2, a]) / depth
        gradient[a] += weight * (ua * to_u + va * to_v)
        for b in range(3):
            ub, vb = camera[0, b] - u * camera[2, b], camera[1, b] - v * camera[2, b]
            information[a, b] += weight * (ua * ub + va * vb) / depth
