"""A body's shape from the lengths of its bones, by ridge regression."""

import numpy as np
import torch
from torch import Tensor

from shapepose_fg.body.fitting.pose_prior import PosePrior
from shapepose_fg.body.model.body_model import BodyModel, BodyParameters
from shapepose_fg.core.skeleton import BODY_25

_ACROSS = (("RShoulder", "LShoulder"), ("RHip", "LHip"), ("REar", "LEar"))
"""Lengths that tell of the shape, besides the limbs of BODY_25."""
_POSES = 256
"""Random poses from which it is learnt how a length depends on the pose: shoulders shrug, trunks bend."""


class BoneLengths:
    """Lengths between BODY_25 joints that the shape decides, and how far the pose blurs each.

    A length is l = mean + slopes betas + e, with e of the variance that random poses give it.
    """

    def __init__(self, model: BodyModel, prior: PosePrior):
        across = [tuple(map(BODY_25.index, pair)) for pair in _ACROSS]
        self._ends = torch.tensor([*BODY_25.limbs, *across]).T
        poses = torch.from_numpy(prior.sample(np.random.default_rng(0), _POSES))
        still = torch.zeros(_POSES, 3, dtype=torch.float64)
        parameters = BodyParameters(torch.zeros(_POSES, 10, dtype=torch.float64), still, poses, still)
        xyz, jacobian = model.to(torch.float64).keypoints_with_jacobian(parameters)
        bone, length = self._bones(xyz)
        slopes = jacobian[:, self._ends[1], :, :10] - jacobian[:, self._ends[0], :, :10]
        slopes = ((bone / length[..., None])[..., None, :] @ slopes).squeeze(-2)
        self._mean, self._variance = length.mean(0).to(model.dtype), length.var(0).to(model.dtype)
        self._slopes = slopes.mean(0).to(model.dtype)

    def betas(self, xyz: Tensor, variance_m2: Tensor) -> Tensor:
        """(B, 10) the likeliest shapes of joints `xyz` (B, 25, 3), metres; standard normal beforehand.

        `variance_m2` (B, 25) is the variance of each joint along an axis; infinite for one that is not used.
        """
        _, length = self._bones(xyz)
        first, second = self._ends
        weight = 1 / (self._variance + variance_m2[:, first] + variance_m2[:, second])
        weighted = weight[..., None] * self._slopes
        normal = self._slopes.mT @ weighted + torch.eye(10, dtype=xyz.dtype)
        right = weighted.mT @ (length - self._mean)[..., None]
        return torch.cholesky_solve(right, torch.linalg.cholesky(normal)).squeeze(-1)

    def _bones(self, xyz: Tensor) -> tuple[Tensor, Tensor]:
        """Vectors (B, L, 3) along the bones and their lengths (B, L)."""
        bone = xyz[:, self._ends[1]] - xyz[:, self._ends[0]]
        return bone, torch.linalg.vector_norm(bone, dim=-1)
