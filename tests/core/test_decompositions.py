"""Decompositions without a choice of LAPACK's: no sign, and no basis of equal values, is left in
them.
"""

import numpy as np
import pytest

from shapepose_fg.core.decompositions import (
    basis_across,
    nearest_rotation,
    principal_axes,
    raise_eigenvalues,
    symmetric_root,
)


def turned(rng: np.random.Generator, count: int) -> np.ndarray:
    """Rotations (count, 3, 3) in any direction."""
    Q = np.linalg.qr(rng.normal(size=(count, 3, 3)))[0]
    return Q * np.sign(np.linalg.det(Q))[:, None, None]


@pytest.mark.parametrize("values", [(1, 2, 3), (2, 2, 2), (0, 1, 1), (0, 0, 0)])
def test_a_root_is_the_symmetric_one(values):
    """It is the only root that is symmetric and positive semi-definite, also where eigenvalues are
    equal.
    """
    R = turned(np.random.default_rng(0), 20)
    matrix = R * np.array(values, dtype=float) @ R.mT
    root = symmetric_root(matrix)
    np.testing.assert_allclose(root, R * np.sqrt(values) @ R.mT, atol=1e-7)
    np.testing.assert_allclose(root @ root, matrix, atol=1e-12)


def test_the_root_of_a_singular_matrix_is_nothing_along_its_null_space():
    """A ray says nothing along itself: that direction stays nothing."""
    rng = np.random.default_rng(0)
    half = rng.normal(size=(20, 3, 3)) * rng.uniform(0, 30, (20, 3))[:, None]
    half[:5, :, 2] = 0.0  # rank 2
    information = half @ half.mT
    root = symmetric_root(information)
    np.testing.assert_allclose(root, root.mT, atol=1e-9)
    np.testing.assert_allclose(root @ root, information, atol=1e-9 * np.abs(information).max())


def test_eigenvalues_below_the_least_are_raised_to_it():
    R = turned(np.random.default_rng(1), 20)
    raised = raise_eigenvalues(R * [-1.0, 0.5, 3.0] @ R.mT, 0.6)
    np.testing.assert_allclose(raised, R * [0.6, 0.6, 3.0] @ R.mT, atol=1e-12)


def test_principal_axes_have_one_sign_however_the_covariance_is_rounded():
    rng = np.random.default_rng(2)
    R = turned(rng, 200)
    R[0] = np.eye(3)[[1, 0, 2]] * [1, 1, -1]  # axes of the coordinates have a side, too
    covariance = R * [1.0, 4.0, 9.0] @ R.mT
    variances, axes = principal_axes(covariance)
    np.testing.assert_allclose(variances, np.tile([1.0, 4.0, 9.0], (200, 1)))
    np.testing.assert_allclose(np.linalg.det(axes), 1.0)
    np.testing.assert_allclose(np.abs(np.einsum("nij,nij->nj", R, axes)), 1.0)
    side = np.sqrt([2.0, 3.0, 5.0]) @ axes[..., 1:]
    assert (side > 0).all()
    # Turned by any of the four half turns that leave the ellipsoid as it is, the axes are the same.
    for signs in ((1, -1, -1), (-1, 1, -1), (-1, -1, 1)):
        half = R * np.array(signs, dtype=float)
        np.testing.assert_allclose(
            principal_axes(half * [1.0, 4.0, 9.0] @ half.mT)[1], axes, atol=1e-9
        )


def test_the_nearest_rotation_is_one_also_of_what_mirrors():
    rng = np.random.default_rng(3)
    R = turned(rng, 20)
    np.testing.assert_allclose(nearest_rotation(R * 2.5), R, atol=1e-12)
    mirrored = nearest_rotation(R * [3.0, 2.0, -1.0])
    np.testing.assert_allclose(mirrored, R, atol=1e-9)  # the weakest direction gives way
    noisy = R + rng.normal(0, 0.3, R.shape)
    best = np.einsum("nij,nij->n", nearest_rotation(noisy), noisy)
    for other in turned(rng, 50):
        assert (np.einsum("ij,nij->n", other, noisy) <= best + 1e-9).all()


def test_a_basis_across_an_axis_is_orthonormal_and_does_not_jump():
    rng = np.random.default_rng(4)
    axes = np.concatenate([np.eye(3), -np.eye(3), rng.normal(size=(50, 3))])
    for axis in axes / np.linalg.norm(axes, axis=1, keepdims=True):
        across = basis_across(axis)
        whole = np.vstack([across, axis])
        np.testing.assert_allclose(whole @ whole.T, np.eye(3), atol=1e-12)
        if abs(axis[2]) > 1e-3:  # below, it may be taken from the other side
            near = axis + 1e-9 * rng.normal(size=3)
            np.testing.assert_allclose(basis_across(near / np.linalg.norm(near)), across, atol=1e-7)
