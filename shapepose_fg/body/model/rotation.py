"""Rotations: axis-angle to matrix and back, and Jacobians.

All functions take leading batch dimensions and are exact at angle 0 (no epsilon). The whole package
uses right tangents: `R exp(delta)`.
"""

import math

import numpy as np

from shapepose_fg.core.arrays import Array
from shapepose_fg.core.compiled import kernel

_SERIES_BELOW = 1e-2
"""Squared angle (rad²) below which series are used, since closed forms lose digits to
cancellation."""


def hat(v: Array) -> Array:
    """The matrix of the cross product: `hat(v) @ u = v x u`; (..., 3) -> (..., 3, 3)."""
    x, y, z = np.moveaxis(v, -1, 0)
    zero = np.zeros_like(x)
    return np.stack((zero, -z, y, z, zero, -x, -y, x, zero), -1).reshape(*v.shape, 3)


def exp_so3(axis_angle: Array) -> Array:
    """Rotation matrices of axis-angle vectors in radians, any norm; (..., 3) -> (..., 3, 3)
    (Rodrigues).
    """
    R = np.empty((*axis_angle.shape, 3))
    _exp(np.require(axis_angle, float, ["C", "W"]).reshape(-1, 3), R.reshape(-1, 3, 3))
    return R


def quaternion(R: Array) -> Array:
    """Unit quaternions (w, x, y, z) with w >= 0 of rotation matrices; (..., 3, 3) -> (..., 4)."""
    turn = log_so3(R)
    half = np.linalg.norm(turn, axis=-1, keepdims=True) / 2
    return np.concatenate([np.cos(half), np.sinc(half / np.pi) / 2 * turn], axis=-1)


def log_so3(R: Array) -> Array:
    """Axis-angle vectors of rotation matrices, norm at most pi; (..., 3, 3) -> (..., 3).

    Computed by quaternions, so that it is accurate near pi; at exactly pi the axis may have either
    sign.
    """
    found = np.empty(R.shape[:-1])
    _log(np.require(R, float, ["C", "W"]).reshape(-1, 3, 3), found.reshape(-1, 3))
    return found


@kernel("f2 f3")
def _exp(vectors, R):
    """Fill R (N, 3, 3) from axis-angle vectors (N, 3)."""
    for n in range(len(R)):
        x, y, z = vectors[n]
        s = x * x + y * y + z * z
        if s < _SERIES_BELOW:  # closed forms lose digits to cancellation
            first, second = (
                1 - s / 6 * (1 - s / 20 * (1 - s / 42)),
                0.5 - s / 24 * (1 - s / 30 * (1 - s / 56)),
            )
        else:
            t = math.sqrt(s)
            first, second = math.sin(t) / t, (1 - math.cos(t)) / s
        R[n, 0, 0], R[n, 1, 1], R[n, 2, 2] = (
            1 - second * (y * y + z * z), 1 - second * (x * x + z * z),
            1 - second * (x * x + y * y),
        )  # fmt: skip
        R[n, 0, 1], R[n, 1, 0] = second * x * y - first * z, second * x * y + first * z
        R[n, 0, 2], R[n, 2, 0] = second * x * z + first * y, second * x * z - first * y
        R[n, 1, 2], R[n, 2, 1] = second * y * z - first * x, second * y * z + first * x


@kernel("f3 f2")
def _log(R, vectors):
    """Fill axis-angle vectors (N, 3) from R (N, 3, 3)."""
    for n in range(len(R)):
        a, e, i = R[n, 0, 0], R[n, 1, 1], R[n, 2, 2]
        x, y, z = R[n, 2, 1] - R[n, 1, 2], R[n, 0, 2] - R[n, 2, 0], R[n, 1, 0] - R[n, 0, 1]
        b, c, f = R[n, 0, 1] + R[n, 1, 0], R[n, 0, 2] + R[n, 2, 0], R[n, 1, 2] + R[n, 2, 1]
        # The quaternion times four times one of its components; the largest is the best divisor.
        if a + e + i >= max(a, e, i):
            w = 1 + a + e + i
        elif a >= e and a >= i:
            w, x, y, z = x, 1 + a - e - i, b, c
        elif e >= i:
            w, x, y, z = y, b, 1 - a + e - i, f
        else:
            w, x, y, z = z, c, f, 1 - a - e + i
        sine = math.sqrt(x * x + y * y + z * z)
        sign = -1.0 if w < 0 else 1.0
        scale = 2 * math.atan2(sine, sign * w) / sine if sine > 0 else 0.0
        vectors[n, 0], vectors[n, 1], vectors[n, 2] = (
            sign * scale * x,
            sign * scale * y,
            sign * scale * z,
        )


def right_jacobian_inverse(axis_angle: Array) -> Array:
    """Inverse of the right Jacobian: `log(exp(a) exp(d)) ~ a + Jr^-1 d`; (..., 3) -> (..., 3, 3).

    Valid for angles below 2 pi, where Jr is singular; `log_so3` returns at most pi.
    """
    square = np.square(axis_angle).sum(-1)[..., None, None]
    small = square < _SERIES_BELOW
    safe = np.where(small, 1.0, square)
    half = np.sqrt(safe) / 2
    series = 1 / 12 + square / 720 + square**2 / 30240 + square**3 / 1209600
    factor = np.where(small, series, (1 - half / np.tan(half)) / safe)  # (1 - t/2 cot(t/2)) / t^2
    cross = hat(axis_angle)
    return np.eye(3) + 0.5 * cross + factor * (cross @ cross)
