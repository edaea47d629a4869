"""What the kernels of bodies (`body/kernels/bodies.py`) are given and fill in: C-contiguous arrays."""

from typing import NamedTuple

import numpy as np

from shapepose_fg.core.arrays import Array, Index


class Limbs(NamedTuple):
    """K points as sums over bones; L terms, those of a point next to each other, parents first."""

    kinds = "i1 i1 i1 f1 f2 f3 f2 f1 f2 f1 i1 i1"
    first: Index
    """(K + 1,) where the terms of each point begin."""
    bone: Index
    """(L,) whose."""
    before: Index
    """(L,) the term of the bone's parent; -1 for the root's."""
    offset: Array
    """(3 L,) in the frame of the bone, metres."""
    by_shape: Array
    """(10, 3 L) metres per unit of each beta."""
    shape: Array
    """(L, 3, 10) `by_shape` in another order of axes."""
    by_pose: Array
    """(3 L, 207) metres per unit of each entry of R - I; (0, 207) without pose blend shapes."""
    root: Array
    """(3 K,) what does not turn, metres."""
    root_by_shape: Array
    """(10, 3 K) metres per unit of each beta."""
    share: Array
    """(K,) how much of the translation a point takes."""
    parent: Index
    """(24,) index of each bone's parent."""
    column: Index
    """(24,) where the unknowns of each rotation begin; -1 where it is none."""


class Own(NamedTuple):
    """How K points, which a detector sees, belong to the body and to targets."""

    kinds = "i1 f2 i1"
    target: Index
    """(K,) which target is of the point; -1: none."""
    offset: Array
    """(K, 3) how far the detector's point is from the body's, metres."""
    bone: Index
    """(K,) in the frame of which bone."""


class Priors(NamedTuple):
    """The pose prior: A of the 69 angles are unknowns, the rest are where it expects them."""

    kinds = "f1 f2 i1 f2 f1"
    mean: Array
    """(A,) rad."""
    precision: Array
    """(A, A) 1/rad²."""
    place: Index
    """(69,) which unknown each angle is; -1 - h where it is the hidden angle h."""
    gain: Array
    """(69 - A, A) how the hidden angles follow."""
    at_zero: Array
    """(69 - A,) where they are when those are zero, rad."""


class Rows(NamedTuple):
    """What B rows are fitted to, and what holds them."""

    kinds = "f3 f4 f2 f1 f2"
    xyz: Array
    """(B, K, 3) targets, metres."""
    information: Array
    """(B, K, 3, 3) inverse covariances of the targets, 1/m²."""
    betas: Array
    """(B, 10) around which shape."""
    stiffness: Array
    """(B,) precision of each beta."""
    angles: Array
    """(B, A) around which angles, rad."""


class Linear(NamedTuple):
    """The energy of B rows around their unknowns; written over."""

    kinds = "f1 f3 f2 f2 f3"
    energy: Array
    """(B,) in squared standard deviations."""
    xyz: Array
    """(B, K, 3) keypoints, metres."""
    squared: Array
    """(B, K) squared Mahalanobis distance of each to its target."""
    gradient: Array
    """(B, P) half the gradient."""
    system: Array
    """(B, P + 1 + 3 N + 10, P): the lower triangle of half the Gauss-Newton Hessian, robust weights included;
    below it the gradient, the Jacobian of some keypoints, and the unit vectors of the betas. (0, ...) where only
    the slope is asked for."""

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
    """Scratch arrays of one row."""

    kinds = "f3 f3 f3 f3 f1 f1 f1 f2 f2 f1 f1 f3 i2 i1 f1 f1 f1"
    local: Array
    """(24, 3, 3) rotations relative to the parent."""
    tangent: Array
    """(24, 3, 3) in which tangents they turn: R <- R exp(T delta)."""
    world: Array
    """(24, 3, 3) world from bone."""
    axes: Array
    """(24, 3, 3) about which the bones turn, in the world."""
    inside: Array
    """(3 L,) the terms in the frames of their bones, metres."""
    term: Array
    """(3 L,) the terms in the world, metres."""
    force: Array
    """(3 L,) on them, in the frames of the bones."""
    torque: Array
    """(24, 3) on the bones, in the world."""
    entry: Array
    """(3, 207) anything."""
    xyz: Array
    """(3 K,) points."""
    push: Array
    """(3 K,) forces on them."""
    J: Array
    """(K, 3, 85) Jacobian of each point, its first `count` columns."""
    column: Index
    """(K, 85) the unknowns of these."""
    count: Index
    """(K,) how many."""
    squared: Array
    """(K,) squared Mahalanobis distance of each point to its target."""
    weight: Array
    """(K,) robust weights."""
    gradient: Array
    """(P,) half the energy's."""

    @classmethod
    def of(cls, limbs: Limbs, unknowns: int) -> "Work":
        """For the rows of a body; as it is made, rotations turn in their own right tangents."""
        K, L = len(limbs.share), len(limbs.bone)
        eye = np.tile(np.eye(3), (24, 1, 1))
        rotations = (eye.copy(), eye.copy(), eye.copy(), eye.copy())
        terms = (np.zeros(3 * L), np.zeros(3 * L), np.zeros(3 * L), np.zeros((24, 3)))
        points = (np.zeros((3, 207)), np.zeros(3 * K), np.zeros(3 * K), np.zeros((K, 3, 85)))
        columns = (np.zeros((K, 85), dtype=np.intp), np.zeros(K, dtype=np.intp))
        return cls(*rotations, *terms, *points, *columns, np.zeros(K), np.zeros(K), np.zeros(unknowns))
