"""Inputs, outputs and workspace of the kernels in `body/kernels/bodies.py`: C-contiguous arrays."""

from typing import NamedTuple

import numpy as np

from shapepose_fg.core.arrays import Array, Index


class Limbs(NamedTuple):
    """K points as sums over bones: L terms, grouped by point, parents first."""

    kinds = "i1 i1 i1 f1 f2 f3 f2 f1 f2 f1 i1 i1"
    first: Index
    """(K + 1,) offset of the terms of each point."""
    bone: Index
    """(L,) bone of each term."""
    before: Index
    """(L,) index of the term of the bone's parent; -1 for the root."""
    offset: Array
    """(3 L,) vectors in the frame of the bone, metres."""
    by_shape: Array
    """(10, 3 L) derivative by each beta, metres."""
    shape: Array
    """(L, 3, 10) `by_shape` with another order of axes."""
    by_pose: Array
    """(3 L, 207) derivative by each entry of R - I, metres; (0, 207) without pose blend shapes."""
    root: Array
    """(3 K,) part of each point that does not rotate, metres."""
    root_by_shape: Array
    """(10, 3 K) derivative of `root` by each beta, metres."""
    share: Array
    """(K,) share of the translation that each point moves by."""
    parent: Index
    """(24,) index of each bone's parent."""
    column: Index
    """(24,) first unknown of each rotation; -1 if it is fixed."""


class Own(NamedTuple):
    """Relation of K detected points to the body and to targets."""

    kinds = "i1 f2 i1"
    target: Index
    """(K,) index of the point's target; -1 for none."""
    offset: Array
    """(K, 3) offset of the detector's point from the body's, metres."""
    bone: Index
    """(K,) bone in the frame of which the offset is constant."""


class Priors(NamedTuple):
    """The pose prior: A of the 69 angles are unknowns, the others are at their conditional mean."""

    kinds = "f1 f2 i1 f2 f1"
    mean: Array
    """(A,) mean, rad."""
    precision: Array
    """(A, A) precision, 1/rad²."""
    place: Index
    """(69,) index of the unknown for each angle; -1 - h for the dependent angle h."""
    gain: Array
    """(69 - A, A) derivative of the dependent angles by the unknowns."""
    at_zero: Array
    """(69 - A,) dependent angles if the unknowns are zero, rad."""


class Rows(NamedTuple):
    """Targets and priors of B rows."""

    kinds = "f3 f4 f2 f1 f2"
    xyz: Array
    """(B, K, 3) targets, metres."""
    information: Array
    """(B, K, 3, 3) inverse covariances of the targets, 1/m²."""
    betas: Array
    """(B, 10) centre of the shape prior."""
    stiffness: Array
    """(B,) precision of each beta."""
    angles: Array
    """(B, A) centre of the pose prior, rad."""


class Linear(NamedTuple):
    """Linearised energy of B rows; filled in by kernels."""

    kinds = "f1 f3 f2 f2 f3"
    energy: Array
    """(B,) energy, in squared standard deviations."""
    xyz: Array
    """(B, K, 3) keypoints, metres."""
    squared: Array
    """(B, K) squared Mahalanobis distance of each keypoint to its target."""
    gradient: Array
    """(B, P) half the gradient."""
    system: Array
    """(B, P + 1 + 3 N + 10, P): the lower triangle of half the Gauss-Newton Hessian, including
    robust weights; below it the gradient, the Jacobian of some keypoints, and the unit vectors of
    the betas. (0, ...) if only the gradient is needed."""

    @property
    def hessian(self) -> Array:
        """(B, P, P) half the Gauss-Newton Hessian."""
        lower = np.tril(self.system[:, : self.system.shape[2]])
        return lower + np.tril(lower, -1).swapaxes(1, 2)

    @property
    def jacobian(self) -> Array:
        """(B, 3 N, P) derivatives of the keypoints by the parameters."""
        return self.system[:, self.system.shape[2] + 1 : -10]


class Work(NamedTuple):
    """Workspace for one row."""

    kinds = "f3 f3 f3 f3 f1 f1 f1 f2 f2 f1 f1 f3 i2 i1 f1 f1 f1"
    local: Array
    """(24, 3, 3) rotations relative to the parent."""
    tangent: Array
    """(24, 3, 3) tangents T of the updates: R <- R exp(T delta)."""
    world: Array
    """(24, 3, 3) world from bone."""
    axes: Array
    """(24, 3, 3) axes of the bones' rotations, in the world."""
    inside: Array
    """(3 L,) the terms in the frames of their bones, metres."""
    term: Array
    """(3 L,) the terms in the world, metres."""
    force: Array
    """(3 L,) forces on the terms, in the frames of the bones."""
    torque: Array
    """(24, 3) torques on the bones, in the world."""
    entry: Array
    """(3, 207) temporary values."""
    xyz: Array
    """(3 K,) points, metres."""
    push: Array
    """(3 K,) forces on the points."""
    J: Array
    """(K, 3, 85) Jacobian of each point, its first `count` columns."""
    column: Index
    """(K, 85) index of the unknown of each column."""
    count: Index
    """(K,) number of columns used for each point."""
    squared: Array
    """(K,) squared Mahalanobis distance of each point to its target."""
    weight: Array
    """(K,) robust weights."""
    gradient: Array
    """(P,) half the gradient of the energy."""

    @classmethod
    def of(cls, limbs: Limbs, unknowns: int) -> "Work":
        """Workspace for the rows of a body; initially, rotations are updated in their own right
        tangents.
        """
        K, L = len(limbs.share), len(limbs.bone)
        eye = np.tile(np.eye(3), (24, 1, 1))
        rotations = (eye.copy(), eye.copy(), eye.copy(), eye.copy())
        terms = (np.zeros(3 * L), np.zeros(3 * L), np.zeros(3 * L), np.zeros((24, 3)))
        points = (np.zeros((3, 207)), np.zeros(3 * K), np.zeros(3 * K), np.zeros((K, 3, 85)))
        columns = (np.zeros((K, 85), dtype=np.intp), np.zeros(K, dtype=np.intp))
        return cls(
            *rotations, *terms, *points, *columns, np.zeros(K), np.zeros(K), np.zeros(unknowns)
        )
