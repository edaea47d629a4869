"""Where to start: root orientation and translation in closed form, from whatever joints are seen."""

import numpy as np
import torch
from numpy.typing import NDArray

from shapepose_fg.body.model import BodyModel, BodyParameters
from shapepose_fg.body.pose_prior import PosePrior

Array = NDArray[np.float64]


class RestAlignment:
    """Aligns the mean body in its mean pose with joint targets (weighted Kabsch).

    A joint weighs by how surely the mean pose knows its place: the trunk much, wrists little. So the trunk
    decides where it is seen, and limbs only where there is nothing better.
    """

    def __init__(self, model: BodyModel, prior: PosePrior):
        model = model.to(torch.float64)
        mean = BodyParameters(
            torch.zeros(1, 10, dtype=torch.float64),
            torch.zeros(1, 3, dtype=torch.float64),
            torch.from_numpy(prior.mean).view(1, 23, 3),
            torch.zeros(1, 3, dtype=torch.float64),
        )
        xyz, jacobian = model.keypoints_with_jacobian(mean)
        shape, pose = jacobian[0, ..., :10].numpy(), jacobian[0, ..., 13:-3].numpy()
        variance = np.square(shape).sum(-1) + np.einsum("kxi,ij,kxj->kx", pose, prior.covariance, pose)
        self._xyz = xyz[0].numpy()
        self._variance_m2 = variance.mean(-1)
        self._pelvis = model.joints(mean)[0, 0].numpy()

    def __call__(self, xyz: Array, variance_m2: Array) -> tuple[Array, Array]:
        """Root rotations (B, 3, 3) and translations `transl` (B, 3) for targets.

        Parameters
        ----------
        xyz: (B, K, 3) targets, metres.
        variance_m2: (B, K) mean variance of each over the three axes; infinite where it is not to be used.
        """
        weight = 1 / (self._variance_m2 + variance_m2)
        weight /= weight.sum(axis=1, keepdims=True)
        target_centre = np.einsum("bk,bkx->bx", weight, xyz)
        rest_centre = weight @ self._xyz
        rest = self._xyz - rest_centre[:, None]
        moment = np.einsum("bk,bkx,bky->bxy", weight, xyz - target_centre[:, None], rest, optimize=True)
        U, _, Vt = np.linalg.svd(moment)
        U[:, :, 2] *= np.sign(np.linalg.det(U @ Vt))[:, None]  # a rotation, not a mirror image
        rotation = U @ Vt
        # The root turns about the pelvis: x = R (rest - pelvis) + pelvis + transl.
        arm = (rotation @ (rest_centre - self._pelvis)[..., None])[..., 0]
        return rotation, target_centre - arm - self._pelvis
