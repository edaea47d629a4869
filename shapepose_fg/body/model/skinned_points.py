"""Points on a skinned body without its mesh: regressor and skinning weights contract to a few numbers.

A point `k` is a fixed weighted sum of vertices, a vertex a weighted sum over bones. Exchanging the sums leaves,
for each point and bone, one offset that is linear in the shape (and in the pose blend shapes, if any):

    x_k = a_k J_0(betas) + sum_j R_j d_kj(betas, pose) + s_k transl

with `R_j` the world rotation of bone j and `J_0` the rest position of the root. This is `regressor @ vertices`
exactly. Turning joint j by `R_j exp(delta)` turns the terms of its subtree, so the derivative is a cross product
with their sum.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from shapepose_fg.core.arrays import Array

NUM_BONES = 24
NUM_COLUMNS = 10 + 3 * NUM_BONES + 3
"""Columns of a Jacobian: betas, global_orient, body_pose, transl."""
_CHUNK = 64
"""Bodies whose Jacobians are worked on at a time, so that the intermediate arrays stay in cache."""


@dataclass(frozen=True)
class SkinnedPoints:
    """K points that ride on a skinned body."""

    offsets: Tensor
    """(K, 3, 24) metres: d_kj of the mean shape, in the frame of bone j."""
    offsets_shape: Tensor
    """(10, K, 3, 24) metres per unit of each beta."""
    offsets_pose: Tensor | None
    """(207, K, 3, 24) metres per unit of each entry of R - I; None for a model without pose blend shapes."""
    root: Tensor
    """(K, 3) metres: a_k J_0 of the mean shape."""
    root_shape: Tensor
    """(10, K, 3) metres per unit of each beta."""
    translation: Tensor
    """(K,) s_k, how much of `transl` a point takes: 1 for a regressor whose rows sum to 1."""
    subtree: Tensor
    """(24, 24) 1 where bone i (row) hangs on joint j (column) or is j itself."""

    def to(self, dtype: torch.dtype) -> "SkinnedPoints":
        """The same points in another floating point type."""
        converted = {name: value.to(dtype) for name, value in vars(self).items() if value is not None}
        return replace(self, **converted)

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
        """These points, then those of `other`, of the same body; points without pose blend shapes have zeros."""
        poses = [points.offsets_pose for points in (self, other)]
        if any(pose is not None for pose in poses):
            shapes = [(207, *points.offsets.shape) for points in (self, other)]
            empty = self.offsets.dtype
            poses = [torch.zeros(s, dtype=empty) if p is None else p for s, p in zip(shapes, poses, strict=True)]
        return replace(
            self,
            offsets=torch.cat((self.offsets, other.offsets)),
            offsets_shape=torch.cat((self.offsets_shape, other.offsets_shape), 1),
            offsets_pose=None if poses[0] is None or poses[1] is None else torch.cat((poses[0], poses[1]), 1),
            root=torch.cat((self.root, other.root)),
            root_shape=torch.cat((self.root_shape, other.root_shape), 1),
            translation=torch.cat((self.translation, other.translation)),
        )

    def feature(self, local: Tensor) -> Tensor | None:
        """(B, 207) R - I of the joints but the pelvis (B, 24, 3, 3); None where pose blend shapes move nothing."""
        if self.offsets_pose is None:
            return None
        return (local[:, 1:] - torch.eye(3, dtype=local.dtype)).flatten(1)

    def positions(self, rotations: Tensor, betas: Tensor, transl: Tensor, pose_feature: Tensor | None) -> Tensor:
        """(B, K, 3) world positions from world rotations (B, 24, 3, 3), betas (B, 10) and transl (B, 3)."""
        terms = self._terms(rotations, self._offsets(betas, pose_feature))
        return terms.sum(-1) + self._anchor(betas, transl)

    def positions_with_jacobian(
        self,
        rotations: Tensor,
        betas: Tensor,
        transl: Tensor,
        local: Tensor,
        pose_feature: Tensor | None,
        tangents: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Positions (B, K, 3) and their Jacobian (B, K, 3, 85); `local` are the joints' own rotations.

        Columns: betas 10, then 24 right tangents `R <- R exp(T delta)` of the local rotations, with T of
        `tangents` (B, 24, 3, 3) or the identity, then transl 3.
        """
        axes = rotations if tangents is None else rotations @ tangents
        batch, count = len(betas), len(self.root)
        position = betas.new_empty(batch, count, 3)
        jacobian = betas.new_empty(batch, count, 3, NUM_COLUMNS)
        for start in range(0, batch, _CHUNK):
            part = slice(start, start + _CHUNK)
            feature = None if pose_feature is None else pose_feature[part]
            offsets = self._offsets(betas[part], feature)
            arms = self._write_turns(jacobian[part], rotations[part], axes[part], offsets)
            torch.add(arms, self._anchor(betas[part], transl[part]), out=position[part])
            self._write_shape(jacobian[part], rotations[part])
            if self.offsets_pose is not None:
                turns = None if tangents is None else tangents[part]
                self._add_pose_blend(jacobian[part], rotations[part], local[part], turns)
        jacobian[..., -3:] = self.translation[:, None, None] * torch.eye(3, dtype=betas.dtype)
        return position, jacobian

    def positions_with_arms(
        self, rotations: Tensor, betas: Tensor, transl: Tensor, pose_feature: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """Positions (B, K, 3), and lever arms (B, K, 3, 24) from each joint to what of the point it turns.

        The arms are all that `pull_back` needs: gradients at a third of the Jacobian's price.
        """
        arms = self._terms(rotations, self._offsets(betas, pose_feature)) @ self.subtree
        return arms[..., 0] + self._anchor(betas, transl), arms

    def pull_back(self, forces: Tensor, arms: Tensor, rotations: Tensor, local: Tensor) -> Tensor:
        """J^T f (B, 85) of `forces` f (B, K, 3) on the points, with the columns of `positions_with_jacobian`.

        Turning joint j moves what hangs on it: its gradient is the torque sum_k p_kj x f_k, in the joint's frame.
        """
        px, py, pz = arms.unbind(2)
        fx, fy, fz = forces[..., None].unbind(2)
        torque = torch.stack(((py * fz - pz * fy), (pz * fx - px * fz), (px * fy - py * fx)), 1).sum(2)
        turns = (rotations * torque.permute(0, 2, 1)[..., None]).sum(2)  # (B, 24, 3), R_j^T torque
        # The forces in the frame of every bone: (B, K, 3 y, 24 j).
        columns = rotations.permute(0, 2, 3, 1).flatten(2)  # (B, 3 x, y j)
        turned = (forces @ columns).flatten(1)
        shape = turned @ self.offsets_shape.flatten(1).T + forces.flatten(1) @ self.root_shape.flatten(1).T
        if self.offsets_pose is not None:
            by_entry = (turned @ self.offsets_pose.flatten(1).T).view(-1, NUM_BONES - 1, 3, 3)
            # d(L exp(delta)) = L hat(delta): <G, L hat(delta)> is delta times the axial part of L^T G.
            axial = local[:, 1:].mT @ by_entry
            turns = torch.cat((turns[:, :1], turns[:, 1:] + torch.stack((
                axial[..., 2, 1] - axial[..., 1, 2],
                axial[..., 0, 2] - axial[..., 2, 0],
                axial[..., 1, 0] - axial[..., 0, 1]), -1)), 1)  # fmt: skip
        shift = (self.translation[:, None] * forces).sum(1)
        return torch.cat((shape, turns.flatten(1), shift), 1)

    def _offsets(self, betas: Tensor, pose_feature: Tensor | None) -> Tensor:
        """(B, K, 3, 24) d_kj of these bodies."""
        offsets = torch.addmm(self.offsets.flatten(), betas, self.offsets_shape.flatten(1))
        if self.offsets_pose is not None and pose_feature is not None:
            offsets = torch.addmm(offsets, pose_feature, self.offsets_pose.flatten(1))
        return offsets.unflatten(-1, self.offsets.shape)

    def _anchor(self, betas: Tensor, transl: Tensor) -> Tensor:
        """(B, K, 3) what does not turn: the root joint's rest position and the translation."""
        root = torch.addmm(self.root.flatten(), betas, self.root_shape.flatten(1)).unflatten(-1, self.root.shape)
        return root + self.translation[:, None] * transl[:, None]

    @staticmethod
    def _terms(rotations: Tensor, offsets: Tensor) -> Tensor:
        """(B, K, 3, 24) R_j d_kj, with the bones last so that the arithmetic runs along them."""
        columns = rotations.permute(3, 0, 2, 1).contiguous()[:, :, None]  # (3 y, B, 1, 3 x, 24)
        x, y, z = offsets[:, :, :1], offsets[:, :, 1:2], offsets[:, :, 2:]
        return torch.addcmul(torch.addcmul(columns[0] * x, columns[1], y), columns[2], z)

    def _write_turns(self, jacobian: Tensor, rotations: Tensor, axes: Tensor, offsets: Tensor) -> Tensor:
        """Fills the columns of the rotations about `axes` A (B, 24, 3, 3); returns sum_j R_j d_kj (B, K, 3).

        With p the sum of the terms that hang on joint j, column c is `A_j[:, c] x p`.
        """
        # Each lever arm three times over, once per column of R_j: the product below writes that layout itself.
        arms = self._terms(rotations, offsets) @ self.subtree.repeat_interleave(3, dim=1)
        rows = axes.permute(0, 2, 1, 3).flatten(2)[:, :, None]  # (B, 3, 1, 72)
        for x, y, z in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
            column = jacobian[:, :, x, 10:-3]
            torch.mul(rows[:, y], arms[:, :, z], out=column)
            column.addcmul_(rows[:, z], arms[:, :, y], value=-1)
        return arms[..., 0]

    def _write_shape(self, jacobian: Tensor, rotations: Tensor) -> None:
        """Fills the columns of the betas: a_k dJ_0 + sum_j R_j dd_kj."""
        batch, count = jacobian.shape[:2]
        stacked = rotations.permute(0, 2, 3, 1).reshape(batch * 3, -1)  # (B x, y j)
        slopes = self.offsets_shape.permute(2, 3, 1, 0).reshape(3 * NUM_BONES, -1)  # (y j, K n)
        product = (stacked @ slopes).view(batch, 3, count, 10).transpose(1, 2)
        torch.add(product, self.root_shape.permute(1, 2, 0), out=jacobian[..., :10])

    def _add_pose_blend(self, jacobian: Tensor, rotations: Tensor, local: Tensor, tangents: Tensor | None) -> None:
        """Adds what a joint's own rotation does through the pose blend shapes."""
        assert self.offsets_pose is not None
        batch, count = jacobian.shape[:2]
        stacked = rotations.permute(0, 2, 3, 1).reshape(batch * 3, -1)
        slopes = self.offsets_pose.permute(2, 3, 1, 0).reshape(3 * NUM_BONES, -1)
        by_entry = (stacked @ slopes).view(batch, 3, count, NUM_BONES - 1, 9)
        # d(L exp(delta)) = L hat(e_c): the entries of L that each tangent direction moves.
        generators = local.new_tensor([[[0, 0, 0], [0, 0, -1], [0, 1, 0]], [[0, 0, 1], [0, 0, 0], [-1, 0, 0]],
                                       [[0, -1, 0], [1, 0, 0], [0, 0, 0]]])  # fmt: skip
        entries = (local[:, 1:, None] @ generators).flatten(-2).transpose(-1, -2)  # (B, 23, 9, 3)
        if tangents is not None:
            entries = entries @ tangents[:, 1:]
        turned = by_entry.permute(0, 3, 2, 1, 4).flatten(2, 3) @ entries  # (B, 23, 3K, 3)
        turned = turned.unflatten(2, (count, 3)).permute(0, 2, 3, 1, 4).flatten(-2)
        jacobian[..., 13:-3] += turned


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
    moments: (K, 24, 3, 1 + 10 + 207) sum over vertices of regressor x weight x vertex, for the template,
        each shape component and each pose blend shape.
    shares: (K, 24) sum over vertices of regressor x weight.
    joints: (24, 3, 11) rest positions of the joints: mean shape, then per unit of each beta.
    parents: (24,) the kinematic tree.
    translation: (K,) row sums of the regressor.
    has_pose_blend: whether the pose blend shapes are other than zero.
    """
    subtree = np.eye(NUM_BONES)
    for bone in range(NUM_BONES - 1, 0, -1):  # children come after their parents
        subtree[:, parents[bone]] += subtree[:, bone]
    hanging = shares @ subtree
    offsets = moments.copy()
    offsets[..., :11] -= shares[:, :, None, None] * joints
    for bone in range(1, NUM_BONES):
        length = joints[bone] - joints[parents[bone]]
        offsets[:, parents[bone], :, :11] += hanging[:, bone, None, None] * length
    root = hanging[:, 0, None, None] * joints[0]
    by_component = torch.from_numpy(np.ascontiguousarray(offsets.transpose(3, 0, 2, 1)))
    return SkinnedPoints(
        offsets=by_component[0].clone(),
        offsets_shape=by_component[1:11].clone(),
        offsets_pose=by_component[11:].clone() if has_pose_blend else None,
        root=torch.from_numpy(root[..., 0].copy()),
        root_shape=torch.from_numpy(np.ascontiguousarray(root[..., 1:].transpose(2, 0, 1))),
        translation=torch.from_numpy(np.array(translation, dtype=np.float64)),
        subtree=torch.from_numpy(subtree),
    )
