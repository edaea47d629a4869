"""Parts of kernels that several files share: projection into a camera, and triangulation.

A `camera` (3, 4) is K [R | t]; a point is (3,) in the world; pixels are undistorted.
"""

import math

from shapepose_fg.core.compiled import part

ROBUST = {None: 0, "none": 0, "huber": 1, "cauchy": 2, "geman_mcclure": 3, "tukey": 4}
"""Robust kernels by their number in compiled functions."""


@part
def robust_weight(robust, ratio):
    """Weight of a robust kernel (`factors.kernel_weight`), from `ratio`: squared norm over squared
    width.
    """
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
    """Pixel and depth of a point in a camera."""
    depth = camera[2, 0] * x[0] + camera[2, 1] * x[1] + camera[2, 2] * x[2] + camera[2, 3]
    u = camera[0, 0] * x[0] + camera[0, 1] * x[1] + camera[0, 2] * x[2] + camera[0, 3]
    v = camera[1, 0] * x[0] + camera[1, 1] * x[1] + camera[1, 2] * x[2] + camera[1, 3]
    return u / depth, v / depth, depth


@part
def add_view(camera, u, v, depth, to_u, to_v, weight, information, gradient):
    """Add J^T w J to `information` and J^T w r to `gradient`, with J the derivative of the pixel
    (u, v) by the point, and r = (to_u, to_v).
    """
    for a in range(3):
        ua, va = (
            (camera[0, a] - u * camera[2, a]) / depth,
            (camera[1, a] - v * camera[2, a]) / depth,
        )
        gradient[a] += weight * (ua * to_u + va * to_v)
        for b in range(3):
            ub, vb = camera[0, b] - u * camera[2, b], camera[1, b] - v * camera[2, b]
            information[a, b] += weight * (ua * ub + va * vb) / depth


@part
def triangulated(cameras, focal, uv, confidence, scale_m, reach_m, least_depth, weight, x):
    """Triangulate pixels `uv` (V, 2) to `x` (3,), metres; returns the number of views with rays
    within `reach_m` of it.

    Linear least squares, weighted by confidence `confidence` (V,) (0: no detection) and, in
    iterations, by a Cauchy kernel of width `scale_m`, metres; `weight` (V,) is scratch space.
    """
    for v in range(len(confidence)):
        weight[v] = confidence[v]
    agree = 0
    # Number of iterations of reweighted triangulation.
    for _ in range(3):
        xx = xy = xz = yy = yz = zz = right_x = right_y = right_z = 0.0
        for v in range(len(confidence)):
            if confidence[v] > 0:
                for k in range(2):
                    P, at, w = cameras[v], uv[v, k], weight[v] / (focal[v] * focal[v])
                    a, b, c = at * P[2, 0] - P[k, 0], at * P[2, 1] - P[k, 1], at * P[2, 2] - P[k, 2]
                    d = w * (P[k, 3] - at * P[2, 3])
                    xx, xy, xz = xx + w * a * a, xy + w * a * b, xz + w * a * c
                    yy, yz, zz = yy + w * b * b, yz + w * b * c, zz + w * c * c
                    right_x, right_y, right_z = right_x + a * d, right_y + b * d, right_z + c * d
        damping = 1e-9 * (xx + yy + zz)
        solved(xx + damping, xy, xz, yy + damping, yz, zz + damping, right_x, right_y, right_z, x)
        agree = 0
        for v in range(len(confidence)):
            if confidence[v] > 0:
                u_, v_, depth = project(cameras[v], x)
                off_m = (
                    math.sqrt((u_ - uv[v, 0]) ** 2 + (v_ - uv[v, 1]) ** 2) * abs(depth) / focal[v]
                )
                weight[v] = (
                    confidence[v] / (1.0 + (off_m / scale_m) ** 2) / max(depth, least_depth) ** 2
                )
                if off_m < reach_m and depth > least_depth:
                    agree += 1
    return agree


@part
def solved(xx, xy, xz, yy, yz, zz, right_x, right_y, right_z, x):
    """Write A^-1 b to `x` (3,), for a symmetric A (3, 3), by cofactors."""
    first, second, third = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
    over = 1.0 / (xx * first + xy * second + xz * third)
    middle, last, both = xx * zz - xz * xz, xx * yy - xy * xy, xy * xz - xx * yz
    x[0] = (first * right_x + second * right_y + third * right_z) * over
    x[1] = (second * right_x + middle * right_y + both * right_z) * over
    x[2] = (third * right_x + both * right_y + last * right_z) * over
