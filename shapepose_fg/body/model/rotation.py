"""Rotations in torch: axis-angle to matrix and back, and the Jacobians between them; inverses of 3x3 matrices.

Everything takes leading batch dimensions, is exact at angle 0 (no epsilon) and differentiable.
The tangent convention of the whole package is the right one: `R exp(delta)`.
"""

import torch
from torch import Tensor

_SERIES_BELOW = 1e-2
"""Squared angle (rad^2) under which closed forms lose digits to cancellation and their series is used."""


def hat(v: Tensor) -> Tensor:
    """The matrix of the cross product: `hat(v) @ u = v x u`; (..., 3) -> (..., 3, 3)."""
    x, y, z = v.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack((zero, -z, y, z, zero, -x, -y, x, zero), -1).unflatten(-1, (3, 3))


def exp_so3(axis_angle: Tensor) -> Tensor:
    """Rotation matrices of axis-angle vectors in radians, any norm; (..., 3) -> (..., 3, 3) (Rodrigues)."""
    angle = torch.linalg.vector_norm(axis_angle, dim=-1, keepdim=True)
    first = torch.sinc(angle / torch.pi)  # sin(t) / t, which torch has exact at 0
    second = 0.5 * torch.sinc(angle / (2 * torch.pi)).square()  # (1 - cos(t)) / t^2 without cancellation
    x, y, z = axis_angle.unbind(-1)
    sx, sy, sz = (first * axis_angle).unbind(-1)
    bx, by, bz = (second * axis_angle).unbind(-1)
    xx, yy, zz, xy, xz, yz = bx * x, by * y, bz * z, bx * y, bx * z, by * z
    rows = (1 - yy - zz, xy - sz, xz + sy, xy + sz, 1 - xx - zz, yz - sx, xz - sy, yz + sx, 1 - xx - yy)
    return torch.stack(rows, -1).unflatten(-1, (3, 3))


def _quaternion(R: Tensor) -> Tensor:
    """Unit quaternions (w, x, y, z) with w >= 0 of rotation matrices; (..., 3, 3) -> (..., 4)."""
    (a, b, c), (d, e, f), (g, h, i) = (row.unbind(-1) for row in R.unbind(-2))
    # Each row is the quaternion times four times one of its own components; the longest row divides best.
    rows = torch.stack(
        (
            torch.stack((1 + a + e + i, h - f, c - g, d - b), -1),
            torch.stack((h - f, 1 + a - e - i, b + d, c + g), -1),
            torch.stack((c - g, b + d, 1 - a + e - i, f + h), -1),
            torch.stack((d - b, c + g, f + h, 1 - a - e + i), -1),
        ),
        -2,
    )
    best = torch.diagonal(rows, dim1=-2, dim2=-1).argmax(-1)
    chosen = torch.take_along_dim(rows, best[..., None, None], dim=-2).squeeze(-2)
    unit = chosen / torch.linalg.vector_norm(chosen, dim=-1, keepdim=True)
    return torch.where(unit[..., :1] < 0, -unit, unit)


def log_so3(R: Tensor) -> Tensor:
    """Axis-angle vectors of rotation matrices, norm at most pi; (..., 3, 3) -> (..., 3).

    Goes by way of the quaternion, so that nothing is lost near pi; at exactly pi either axis may come out.
    """
    quaternion = _quaternion(R)
    w, xyz = quaternion[..., :1], quaternion[..., 1:]
    square = xyz.square().sum(-1, keepdim=True)
    small = square < _SERIES_BELOW**2
    sine = torch.where(small, torch.ones_like(square), square).sqrt()  # the dummy 1 keeps gradients finite
    ratio = square / w.clamp_min(0.5).square()  # tan^2 of half the angle, only used where it is small
    series = 2 / w.clamp_min(0.5) * (1 - ratio / 3 + ratio.square() / 5)
    return xyz * torch.where(small, series, 2 * torch.atan2(sine, w) / sine)


def right_jacobian(axis_angle: Tensor) -> Tensor:
    """`Jr` of `exp(a + da) ~ exp(a) exp(Jr da)`; (..., 3) -> (..., 3, 3)."""
    square = axis_angle.square().sum(-1)[..., None, None]
    small = square < _SERIES_BELOW
    safe = torch.where(small, torch.ones_like(square), square)
    angle = safe.sqrt()
    cubic_series = 1 / 6 - square / 120 + square**2 / 5040 - square**3 / 362880
    cubic = torch.where(small, cubic_series, (angle - angle.sin()) / (safe * angle))
    quadratic_series = 1 / 2 - square / 24 + square**2 / 720 - square**3 / 40320
    quadratic = torch.where(small, quadratic_series, (1 - angle.cos()) / safe)
    cross = hat(axis_angle)
    return torch.eye(3, dtype=axis_angle.dtype) - quadratic * cross + cubic * (cross @ cross)


def right_jacobian_inverse(axis_angle: Tensor) -> Tensor:
    """Inverse of `right_jacobian`: `log(exp(a) exp(d)) ~ a + Jr^-1 d`; (..., 3) -> (..., 3, 3).

    Good for angles under 2 pi, where Jr itself is singular; `log_so3` returns at most pi.
    """
    square = axis_angle.square().sum(-1)[..., None, None]
    small = square < _SERIES_BELOW
    safe = torch.where(small, torch.ones_like(square), square)
    half = safe.sqrt() / 2
    series = 1 / 12 + square / 720 + square**2 / 30240 + square**3 / 1209600
    factor = torch.where(small, series, (1 - half / half.tan()) / safe)  # (1 - t/2 cot(t/2)) / t^2
    cross = hat(axis_angle)
    return torch.eye(3, dtype=axis_angle.dtype) + 0.5 * cross + factor * (cross @ cross)


def six_d(R: Tensor) -> Tensor:
    """The first two columns of rotation matrices, a continuous form for networks; (..., 3, 3) -> (..., 6).

    Zhou et al., "On the Continuity of Rotation Representations in Neural Networks", CVPR 2019.
    """
    return R[..., :2].transpose(-1, -2).flatten(-2)


def from_six_d(columns: Tensor) -> Tensor:
    """Rotation matrices from two columns that need be neither unit nor orthogonal; (..., 6) -> (..., 3, 3).

    Gram-Schmidt; parallel or zero columns have no rotation and give NaN.
    """
    first, second = columns[..., :3], columns[..., 3:]
    x = first / torch.linalg.vector_norm(first, dim=-1, keepdim=True)
    across = second - (x * second).sum(-1, keepdim=True) * x
    y = across / torch.linalg.vector_norm(across, dim=-1, keepdim=True)
    return torch.stack((x, y, torch.linalg.cross(x, y)), -1)


def inverse_3x3(matrix: Tensor) -> Tensor:
    """Inverses (..., 3, 3) by cross products of the rows; a singular matrix gives infinities, not an error.

    LAPACK would go through a batch one by one.
    """
    a, b, c = matrix.unbind(-2)
    columns = torch.stack((torch.linalg.cross(b, c), torch.linalg.cross(c, a), torch.linalg.cross(a, b)), -1)
    determinant = (a * columns[..., 0]).sum(-1)
    return columns / determinant[..., None, None]
