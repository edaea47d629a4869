"""Rotations: axis-angle to matrix and back, their six numbers for networks, and Jacobians.

Everything takes leading batch dimensions and is exact at angle 0 (no epsilon).
The tangent convention of the whole package is the right one: `R exp(delta)`.
"""

import numpy as np

from shapepose_fg.core.arrays import Array

_SERIES_BELOW = 1e-2
"""Squared angle (rad^2) under which closed forms lose digits to cancellation and their series is used."""


def hat(v: Array) -> Array:
    """The matrix of the cross product: `hat(v) @ u = v x u`; (..., 3) -> (..., 3, 3)."""
    x, y, z = np.moveaxis(v, -1, 0)
    zero = np.zeros_like(x)
    return np.stack((zero, -z, y, z, zero, -x, -y, x, zero), -1).reshape(*v.shape, 3)


def exp_so3(axis_angle: Array) -> Array:
    """Rotation matrices of axis-angle vectors in radians, any norm; (..., 3) -> (..., 3, 3) (Rodrigues)."""
    angle = np.linalg.norm(axis_angle, axis=-1)[..., None, None]
    first = np.sinc(angle / np.pi)  # sin(t) / t
    second = 0.5 * np.sinc(angle / (2 * np.pi)) ** 2  # (1 - cos(t)) / t^2 without cancellation
    cross = hat(axis_angle)
    return np.eye(3) + first * cross + second * (cross @ cross)


def quaternion(R: Array) -> Array:
    """Unit quaternions (w, x, y, z) with w >= 0 of rotation matrices; (..., 3, 3) -> (..., 4)."""
    (a, b, c), (d, e, f), (g, h, i) = np.moveaxis(R, (-2, -1), (0, 1))
    # Each row is the quaternion times four times one of its own components; the longest row divides best.
    rows = np.stack(
        (
            np.stack((1 + a + e + i, h - f, c - g, d - b), -1),
            np.stack((h - f, 1 + a - e - i, b + d, c + g), -1),
            np.stack((c - g, b + d, 1 - a + e - i, f + h), -1),
            np.stack((d - b, c + g, f + h, 1 - a - e + i), -1),
        ),
        -2,
    )
    best = np.diagonal(rows, axis1=-2, axis2=-1).argmax(-1)
    chosen = np.take_along_axis(rows, best[..., None, None], axis=-2)[..., 0, :]
    unit = chosen / np.linalg.norm(chosen, axis=-1, keepdims=True)
    return np.where(unit[..., :1] < 0, -unit, unit)


def log_so3(R: Array) -> Array:
    """Axis-angle vectors of rotation matrices, norm at most pi; (..., 3, 3) -> (..., 3).

    Goes by way of the quaternion, so that nothing is lost near pi; at exactly pi either axis may come out.
    """
    real, xyz = np.split(quaternion(R), [1], axis=-1)
    sine = np.linalg.norm(xyz, axis=-1, keepdims=True)
    safe = np.where(sine > 0, sine, 1.0)
    return xyz * np.where(sine > 0, 2 * np.arctan2(sine, real) / safe, 2.0)


def right_jacobian_inverse(axis_angle: Array) -> Array:
    """Inverse of the right Jacobian: `log(exp(a) exp(d)) ~ a + Jr^-1 d`; (..., 3) -> (..., 3, 3).

    Good for angles under 2 pi, where Jr itself is singular; `log_so3` returns at most pi.
    """
    square = np.square(axis_angle).sum(-1)[..., None, None]
    small = square < _SERIES_BELOW
    safe = np.where(small, 1.0, square)
    half = np.sqrt(safe) / 2
    series = 1 / 12 + square / 720 + square**2 / 30240 + square**3 / 1209600
    factor = np.where(small, series, (1 - half / np.tan(half)) / safe)  # (1 - t/2 cot(t/2)) / t^2
    cross = hat(axis_angle)
    return np.eye(3) + 0.5 * cross + factor * (cross @ cross)


def six_d(R: Array) -> Array:
    """The first two columns of rotation matrices, a continuous form for networks; (..., 3, 3) -> (..., 6).

    Zhou et al., "On the Continuity of Rotation Representations in Neural Networks", CVPR 2019.
    """
    return R[..., :2].swapaxes(-1, -2).reshape(*R.shape[:-2], 6)


def from_six_d(columns: Array) -> Array:
    """Rotation matrices from two columns that need be neither unit nor orthogonal; (..., 6) -> (..., 3, 3).

    Gram-Schmidt; parallel or zero columns have no rotation and give NaN.
    """
    first, second = columns[..., :3], columns[..., 3:]
    with np.errstate(divide="ignore", invalid="ignore"):
        x = first / np.linalg.norm(first, axis=-1, keepdims=True)
        across = second - (x * second).sum(-1, keepdims=True) * x
        y = across / np.linalg.norm(across, axis=-1, keepdims=True)
    (a, b, c), (d, e, f) = np.moveaxis(x, -1, 0), np.moveaxis(y, -1, 0)
    return np.stack((x, y, np.stack((b * f - c * e, c * d - a * f, a * e - b * d), -1)), -1)
