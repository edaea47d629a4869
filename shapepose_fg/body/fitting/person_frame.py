"""The person's own frame, in closed form: initial pose of fits, and frame of learned descent."""

from dataclasses import dataclass

import numpy as np

from shapepose_fg.body.model.body_model import BodyModel, BodyParameters
from shapepose_fg.body.model.target_skeletons import BODY_POINTS
from shapepose_fg.core.arrays import Array, Real
from shapepose_fg.core.decompositions import nearest_rotation


@dataclass(frozen=True)
class PersonFrame:
    """Aligns the mean body in its mean pose with joint targets (weighted Kabsch); the pelvis is the
    origin.

    Weights are inverse variances of the joints in the mean pose: large for the trunk, small for
    wrists. So the trunk determines the alignment if it is seen, and limbs only otherwise.
    """

    rest_xyz: Array
    """(K, 3) `BODY_POINTS` of the mean body in its mean pose, relative to the pelvis, metres."""
    rest_variance: Array
    """(K,) variance of each point over poses and shapes, mean over the axes, m²."""
    local: Array
    """(24, 3, 3) the mean pose's local rotations; the root's is the identity."""
    transl: Array
    """(3,) translation that puts the pelvis at the origin, metres."""

    def __post_init__(self) -> None:
        K = len(BODY_POINTS)
        shapes = {"rest_xyz": (K, 3), "rest_variance": (K,), "local": (24, 3, 3), "transl": (3,)}
        for name, shape in shapes.items():
            value = np.asarray(getattr(self, name), dtype=np.float64)
            if value.shape != shape:
                raise ValueError(f"{name} must be {shape}, got {value.shape}")
            object.__setattr__(self, name, value)

    @classmethod
    def of(cls, model: BodyModel, poses: Real, weight: Real) -> "PersonFrame":
        """The frame of a body with sample `poses` (N, 24, 3), axis-angle, root first, weighted by
        `weight` (N,).
        """
        angles, share = (
            poses[:, 1:].reshape(len(poses), 69).astype(np.float64),
            weight / weight.sum(),
        )
        mean = share @ angles
        return cls.of_angles(model, mean, (angles - mean).T @ ((angles - mean) * share[:, None]))

    @classmethod
    def of_angles(cls, model: BodyModel, mean: Array, covariance: Array) -> "PersonFrame":
        """The frame of a body with this mean (69,), rad, and covariance (69, 69), rad², of the
        joint angles.
        """
        still = np.zeros((1, 3))
        body = BodyParameters(np.zeros((1, 10)), still, mean.reshape(1, 23, 3), still)
        pelvis = model.joints(body)[0, 0]
        xyz, jacobian = model.points.positions_with_jacobian(body.local, body.betas, body.transl)
        by_shape, by_pose = jacobian[0, ..., :10], jacobian[0, ..., 13:-3]
        variance = np.square(by_shape).sum(-1) + ((by_pose @ covariance) * by_pose).sum(-1)
        return cls(xyz[0] - pelvis, variance.mean(-1), body.local[0], -pelvis)

    def place(self, xyz: Array, variance: Array, slots: tuple[int, ...]) -> tuple[Array, Array]:
        """World from person: rotations (B, 3, 3), and positions of the pelvis (B, 3).

        Parameters
        ----------
        xyz: (B, J, 3) targets, metres.
        variance: (B, J) mean variance of each over the three axes; infinite for targets to ignore.
        slots: (J,) indices of the targets in `BODY_POINTS`.
        """
        rows = list(slots)
        rest_xyz, rest_variance = self.rest_xyz[rows], self.rest_variance[rows]
        weight = 1 / (rest_variance + variance)
        weight = weight / weight.sum(1, keepdims=True)
        rest_centre = weight @ rest_xyz
        target_centre = (weight[:, None] @ xyz)[:, 0]
        rest = rest_xyz - rest_centre[:, None]
        moment = (weight[..., None] * (xyz - target_centre[:, None])).swapaxes(-1, -2) @ rest
        rotation = nearest_rotation(moment)
        return rotation, target_centre - (rotation @ rest_centre[..., None])[..., 0]
