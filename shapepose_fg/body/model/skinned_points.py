"""Points on a skinned body without its mesh, by contraction of regressor and skinning weights.

A point `k` is a fixed weighted sum of vertices, a vertex a weighted sum over bones. Exchanging the
sums leaves, for each point and bone, one offset that is linear in the shape (and in the pose blend
shapes, if any):

    x_k = a_k J_0(betas) + sum_j R_j d_kj(betas, pose) + s_k transl

with `R_j` the world rotation of bone j and `J_0` the rest position of the root. This equals
`regressor @ vertices` exactly. A rotation of joint j, `R_j exp(delta)`, rotates the terms of its
subtree, so that the derivative is a cross product with their sum; `body/kernels/bodies.py` computes
it.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from shapepose_fg.body.kernels.bodies import placed
from shapepose_fg.body.kernels.rows import Limbs, Work
from shapepose_fg.body.model.smpl_file import SMPL_PARENTS
from shapepose_fg.core.arrays import Array, Index

NUM_BONES = len(SMPL_PARENTS)
NUM_COLUMNS = 10 + 3 * NUM_BONES + 3
"""Number of columns of a Jacobian: betas, global_orient, body_pose, transl."""
_EVERY = 10 + 3 * np.arange(NUM_BONES)


@dataclass(frozen=True, eq=False)
class SkinnedPoints:
    """K points that move with a skinned body."""

    offsets: Array
    """(K, 3, 24) metres: d_kj of the mean shape, in the frame of bone j."""
    offsets_shape: Array
    """(10, K, 3, 24) derivatives of `offsets` by each beta, metres."""
    offsets_pose: Array | None
    """(207, K, 3, 24) derivatives of the points by each entry of R - I, metres; None without pose
    blend shapes."""
    root: Array
    """(K, 3) metres: a_k J_0 of the mean shape."""
    root_shape: Array
    """(10, K, 3) derivatives of `root` by each beta, metres."""
    translation: Array
    """(K,) s_k, the share of `transl` that each point moves by: 1 for a regressor with rows that
    sum to 1."""

    def part(self, rows: list[int]) -> "SkinnedPoints":
        """Some of the points."""
        pose = self.offsets_pose
        return replace(
            self,
            offsets=self.offsets[rows],
            offsets_shape=self.offsets_shape[:, rows],
            offsets_pose=None if pose is None else pose[:, rows],
            root=self.root[rows],
            root_shape=self.root_shape[:, rows],
            translation=self.translation[rows],
        )

    def joined(self, other: "SkinnedPoints") -> "SkinnedPoints":
        """These points, then those of `other`, of the same body; missing pose blend shapes are
        zeros.
        """
        both = (self, other)
        pose = None
        if any(points.offsets_pose is not None for points in both):
            empty = [np.zeros((207, *points.offsets.shape)) for points in both]
            parts = [
                e if p.offsets_pose is None else p.offsets_pose
                for p, e in zip(both, empty, strict=True)
            ]
            pose = np.concatenate(parts, 1)
        return replace(
            self,
            offsets=np.concatenate((self.offsets, other.offsets)),
            offsets_shape=np.concatenate((self.offsets_shape, other.offsets_shape), 1),
            offsets_pose=pose,
            root=np.concatenate((self.root, other.root)),
            root_shape=np.concatenate((self.root_shape, other.root_shape), 1),
            translation=np.concatenate((self.translation, other.translation)),
        )

    def limbs(self, column: Index = _EVERY) -> Limbs:
        """The points in the form that kernels take; `column` (24,) is the first unknown of each
        rotation, -1 for none.

        A point has a term for each of its bones and for all bones above these; with pose blend
        shapes, for all bones.
        """
        size = np.abs(self.offsets).max(1) + np.abs(self.offsets_shape).max((0, 2))
        rides = size > 0 if self.offsets_pose is None else np.ones_like(size, dtype=bool)
        for bone in range(NUM_BONES - 1, 0, -1):  # children first
            rides[:, SMPL_PARENTS[bone]] |= rides[:, bone]
        rides[:, 0] = True
        point, bone = np.nonzero(rides)
        term = np.full(rides.shape, -1)
        term[point, bone] = np.arange(len(bone))
        parents = np.array(SMPL_PARENTS, dtype=np.intp)
        shape = self.offsets_shape[:, point, :, bone].transpose(0, 2, 1)
        pose = (
            np.zeros((0, 207, 3))
            if self.offsets_pose is None
            else self.offsets_pose[:, point, :, bone]
        )
        parts = (
            np.append(0, np.cumsum(rides.sum(1))), bone,
            np.where(bone > 0, term[point, parents[bone]], -1),
            self.offsets[point, :, bone].ravel(), shape.reshape(-1, 10).T, shape,
            pose.transpose(0, 2, 1).reshape(-1, 207), self.root.ravel(),
            self.root_shape.reshape(10, -1), self.translation, parents, column,
        )  # fmt: skip
        return Limbs(*map(_contiguous, parts))

    @cached_property
    def _limbs(self) -> Limbs:
        return self.limbs()

    def positions(self, local: Array, betas: Array, transl: Array) -> Array:
        """(B, K, 3) world positions from rotations relative to the parents (B, 24, 3, 3), betas (B,
        10) and transl (B, 3).
        """
        return self._placed(local, betas, transl, jacobian=False)[0]

    def positions_with_jacobian(
        self, local: Array, betas: Array, transl: Array
    ) -> tuple[Array, Array]:
        """Positions (B, K, 3) and their Jacobian (B, K, 3, 85).

        Columns: betas 10, then 24 right tangents `R <- R exp(delta)` of the local rotations, then
        transl 3.
        """
        return self._placed(local, betas, transl, jacobian=True)

    def _placed(
        self, local: Array, betas: Array, transl: Array, *, jacobian: bool
    ) -> tuple[Array, Array]:
        B, K = len(betas), len(self.root)
        local, betas, transl = (
            np.require(part, float, ["C", "W"]) for part in (local, betas, transl)
        )
        xyz, slopes = np.zeros((B, K, 3)), np.zeros((B if jacobian else 0, K, 3, NUM_COLUMNS))
        placed(self._limbs, local, betas, transl, xyz, slopes, Work.of(self._limbs, NUM_COLUMNS))
        return xyz, slopes


def _contiguous(part: Any) -> Any:
    """A C-contiguous copy, as kernels require."""
    return np.array(part, order="C")


def contract(
    moments: Array,
    shares: Array,
    joints: Array,
    parents: tuple[int, ...],
    translation: Array,
    has_pose_blend: bool,
) -> SkinnedPoints:
    """The contraction of points with moments and shares per bone.

    Parameters
    ----------
    moments: (K, 24, 3, 1 + 10 + 207) sum over vertices of regressor x weight x vertex, for the
    template,
        each shape component and each pose blend shape.
    shares: (K, 24) sum over vertices of regressor x weight.
    joints: (24, 3, 11) rest positions of the joints: mean shape, then per unit of each beta.
    parents: (24,) the kinematic tree.
    translation: (K,) row sums of the regressor.
    has_pose_blend: whether the pose blend shapes are other than zero.
    """
    subtree = np.eye(NUM_BONES)
    for bone in range(NUM_BONES - 1, 0, -1):  # children first
        subtree[:, parents[bone]] += subtree[:, bone]
    hanging = shares @ subtree
    offsets = moments.copy()
    offsets[..., :11] -= shares[:, :, None, None] * joints
    for bone in range(1, NUM_BONES):
        length = joints[bone] - joints[parents[bone]]
        offsets[:, parents[bone], :, :11] += hanging[:, bone, None, None] * length
    root = hanging[:, 0, None, None] * joints[0]
    by_component = np.ascontiguousarray(offsets.transpose(3, 0, 2, 1))
    return SkinnedPoints(
        offsets=by_component[0],
        offsets_shape=by_component[1:11],
        offsets_pose=by_component[11:] if has_pose_blend else None,
        root=root[..., 0],
        root_shape=root[..., 1:].transpose(2, 0, 1),
        translation=np.array(translation, dtype=np.float64),
    )
