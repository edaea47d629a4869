"""The person's own frame, in closed form: where fits start, and in which learned descent works."""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from shapepose_fg.body.model.body_model import BodyModel, BodyParameters, accumulate
from shapepose_fg.body.model.rotation import exp_so3
from shapepose_fg.body.model.target_skeletons import BODY_POINTS
from shapepose_fg.core.arrays import Array, Real


@dataclass(frozen=True)
class PersonFrame:
    """Puts the mean body in its mean pose on joint targets (weighted Kabsch); its pelvis is the origin.

    A joint weighs by how surely the mean pose knows its place: the trunk much, wrists little. So the trunk
    decides where it is seen, and limbs only where there is nothing better.
    """

    rest_xyz: Tensor
    """(K, 3) `BODY_POINTS` of the mean body in its mean pose, from the pelvis, metres."""
    rest_variance: Tensor
    """(K,) how far poses and shapes move each, mean over the axes, m²."""
    local: Tensor
    """(24, 3, 3) the mean pose's local rotations; the root's is the identity."""
    transl: Tensor
    """(3,) which puts the pelvis at the origin, metres."""

    def __post_init__(self) -> None:
        K = len(BODY_POINTS)
        shapes = {"rest_xyz": (K, 3), "rest_variance": (K,), "local": (24, 3, 3), "transl": (3,)}
        for name, shape in shapes.items():
            if getattr(self, name).shape != shape:
                raise ValueError(f"{name} must be {shape}, got {tuple(getattr(self, name).shape)}")

    @classmethod
    def of(cls, model: BodyModel, poses: Real, weight: Real) -> "PersonFrame":
        """The frame of a body that takes `poses` (N, 24, 3), axis-angle, root first, weighing (N,); float32."""
        angles, share = poses[:, 1:].reshape(len(poses), 69).astype(np.float64), weight / weight.sum()
        mean = share @ angles
        frame = cls.of_angles(model, mean, (angles - mean).T @ ((angles - mean) * share[:, None]))
        return cls(frame.rest_xyz.float(), frame.rest_variance.float(), frame.local.float(), frame.transl.float())

    @classmethod
    def of_angles(cls, model: BodyModel, mean: Array, covariance: Array) -> "PersonFrame":
        """The frame of a body whose 69 joint angles have this mean (69,) and covariance (69, 69), rad; float64."""
        model = model.to(torch.float64)
        pose = torch.from_numpy(mean).view(1, 23, 3)
        zero = torch.zeros(1, 3, dtype=torch.float64)
        pelvis = model.joints(BodyParameters(torch.zeros(1, 10, dtype=torch.float64), zero, pose, zero))[0, 0]
        local = exp_so3(torch.cat((zero[:, None], pose), 1))
        xyz, jacobian = model.points.positions_with_jacobian(
            accumulate(local), torch.zeros(1, 10, dtype=torch.float64), zero, local, model.points.feature(local)
        )
        by_shape, by_pose = jacobian[0, ..., :10], jacobian[0, ..., 13:-3]
        spread = by_pose @ torch.from_numpy(covariance)
        variance = by_shape.square().sum(-1) + (spread * by_pose).sum(-1)
        return cls(xyz[0] - pelvis, variance.mean(-1), local[0], -pelvis)

    def place(self, xyz: Tensor, variance: Tensor, slots: tuple[int, ...]) -> tuple[Tensor, Tensor]:
        """World from person: rotations (B, 3, 3), and where the pelvis is (B, 3).

        Parameters
        ----------
        xyz: (B, J, 3) targets, metres.
        variance: (B, J) mean variance of each over the three axes; infinite where it is not to be used.
        slots: (J,) places of the targets among `BODY_POINTS`.
        """
        rows = list(slots)
        rest_xyz, rest_variance = self.rest_xyz[rows].to(xyz.dtype), self.rest_variance[rows].to(xyz.dtype)
        weight = 1 / (rest_variance + variance)
        weight = weight / weight.sum(1, keepdim=True)
        rest_centre = weight @ rest_xyz
        target_centre = (weight[:, None] @ xyz)[:, 0]
        rest = rest_xyz - rest_centre[:, None]
        moment = (weight[..., None] * (xyz - target_centre[:, None])).mT @ rest
        U, _, Vt = torch.linalg.svd(moment.double())
        sign = torch.det(U @ Vt).sign()
        U = torch.cat((U[..., :2], U[..., 2:] * sign[:, None, None]), -1)  # a rotation, not a mirror image
        rotation = (U @ Vt).to(xyz.dtype)
        return rotation, target_centre - (rotation @ rest_centre[..., None]).squeeze(-1)
