"""Decompositions of matrices without arbitrary signs: equal results on every processor, up to
rounding.

LAPACK returns eigenvectors and singular vectors with signs, and bases of repeated values, that
depend on the processor's kernels. Results and random draws must not depend on them. Therefore only
this module and `factors` call `eigh`, `svd` and `qr`.
"""

import numpy as np
from numpy.typing import ArrayLike

from shapepose_fg.core.arrays import Array

ROTATION_TOLERANCE = 1e-3
"""Tolerance for R Rᵀ minus the identity: calibration files have four to six digits."""


def is_rotation(R: Array) -> bool:
    """Whether matrices (..., 3, 3) are rotations, up to `ROTATION_TOLERANCE`."""
    return bool(
        np.abs(R @ R.mT - np.eye(3)).max() <= ROTATION_TOLERANCE and (np.linalg.det(R) >= 0).all()
    )


def rotation_angle(R: Array) -> Array:
    """(...) angles of rotations (..., 3, 3), rad, to 1e-8."""
    return np.arccos(np.clip((np.trace(R, axis1=-2, axis2=-1) - 1) / 2, -1.0, 1.0))


def rigid(R: Array, t: Array) -> Array:
    """(..., 4, 4) rigid transformations with rotations R (..., 3, 3) and translations t (...,
    3).
    """
    found = np.zeros((*np.shape(t)[:-1], 4, 4))
    found[..., :3, :3], found[..., :3, 3], found[..., 3, 3] = R, t, 1.0
    return found


def symmetric_root(matrix: Array) -> Array:
    """Symmetric square roots (..., n, n) of positive semi-definite matrices; negative rounding
    counts as zero.
    """
    values, vectors = np.linalg.eigh(matrix)
    return np.einsum("...ik,...k,...jk->...ij", vectors, np.sqrt(np.maximum(values, 0.0)), vectors)


def raise_eigenvalues(matrix: Array, least: float) -> Array:
    """Matrices (..., n, n): the symmetric part, with eigenvalues below `least` raised to it."""
    values, vectors = np.linalg.eigh((matrix + matrix.mT) / 2)
    return (vectors * np.maximum(values, least)[..., None, :]) @ vectors.mT


def principal_axes(covariance: Array) -> tuple[Array, Array]:
    """Variances (..., 3) along the principal axes, ascending, and the axes as columns of rotations
    (..., 3, 3).

    The second and third axis have a positive component along (√2, √3, √5); the sign of the first
    makes the matrix a rotation. Axes of equal variances are not unique: use them only for results
    that do not depend on the choice.
    """
    variances, axes = np.linalg.eigh(covariance)
    # Reference direction for the signs of axes. It is not perpendicular to any axis of a
    # symmetrical arrangement.
    axes = axes * np.where(np.sqrt([2.0, 3.0, 5.0]) @ axes < 0, -1.0, 1.0)[..., None, :]
    axes[..., 0] *= np.sign(np.linalg.det(axes))[..., None]
    return variances, axes


def nearest_rotation(matrix: Array) -> Array:
    """Rotations (..., 3, 3) nearest to matrices: those with the largest trace(Rᵀ M) (Kabsch)."""
    U, _, Vt = np.linalg.svd(matrix)
    U[..., 2] *= np.sign(np.linalg.det(U @ Vt))[..., None]
    return U @ Vt


def basis_across(axis: Array) -> Array:
    """(2, 3) orthonormal directions perpendicular to a unit vector `axis` (3,) (Duff et al.
    2017).
    """
    x, y, z = axis
    sign = np.copysign(1.0, z)
    a = -1.0 / (sign + z)
    return np.array(
        [[1.0 + sign * x * x * a, sign * x * y * a, -sign * x], [x * y * a, sign + y * y * a, -y]]
    )


def comparable(values: ArrayLike) -> Array:
    """Values rounded for comparisons, so that those that differ only by the processor's rounding
    become equal.

    Periodic or symmetric motions give many ties, of which the first is then chosen.
    """
    return np.round(np.asarray(values, dtype=np.float64), 9)
