"""The bodies of a result: their own joints, how tall they are, and how their bones turn."""

import numpy as np
import torch
from numpy.typing import NDArray

from shapepose_fg.body.model.body_model import BodyModel, BodyParameters
from shapepose_fg.body.model.keypoint_offsets import KeypointOffsets
from shapepose_fg.body.shapes import statures_m
from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.core.skeleton import SMPL_24

TWIST_JUMP = np.deg2rad(20.0)
"""From one frame to the next, in radians: at 30 frames a second more than 600 degrees a second."""
_TWISTING = (
    *(("left_shoulder", "left_elbow"), ("left_elbow", "left_wrist"), ("left_hip", "left_knee")),
    *(("right_shoulder", "right_elbow"), ("right_elbow", "right_wrist"), ("right_hip", "right_knee")),
    *(("left_knee", "left_ankle"), ("right_knee", "right_ankle")),
)
"""The bone that starts at the first joint, and the joint at its end."""


def body_joints(people: Reconstruction) -> NDArray[np.float64]:
    """(N, J, 3) the joints of the fitted bodies, where the detector puts them; NaN where there is no body.

    The offsets are those that the run learnt (`run["keypoint_offsets"]`); without any, the model's own joints.
    """
    model = BodyModel.default()
    offsets = people.run.get("keypoint_offsets")
    if offsets is not None:
        model = model.with_keypoint_offsets(KeypointOffsets.from_dict(offsets))
    with torch.no_grad():
        return model.keypoints(_parameters(people, model)).double().numpy()


def statures(betas: NDArray[np.float64], model: BodyModel | None = None) -> NDArray[np.float64]:
    """(N,) height in metres of bodies of shape `betas` (N, 10) in the T-pose, sole to crown; NaN where unknown."""
    model = BodyModel.default() if model is None else model
    return statures_m(np.asarray(betas, dtype=np.float64), model.arrays)


def bone_rotations(people: Reconstruction) -> NDArray[np.float64]:
    """(N, 24, 3, 3) world from bone, of every bone of the bodies; NaN where there is no body."""
    model = BodyModel.default()
    with torch.no_grad():
        return model.bone_rotations(_parameters(people, model)).double().numpy()


def twists(rotations: NDArray[np.float64]) -> NDArray[np.float64]:
    """(T - 1, P, 8) by how many radians limbs turn about their own axes from one frame to the next.

    `rotations` (T, P, 24, 3, 3) are world from bone. The turn between two frames is a swing of the axis and a
    twist about it (swing-twist decomposition of the relative rotation, in the bone's frame).
    """
    model = BodyModel.default()
    rest = model.joints(BodyParameters.zeros(1, model.dtype))[0].double().numpy()
    bones, ends = (np.array([SMPL_24.index(limb[i]) for limb in _TWISTING]) for i in (0, 1))
    axis = rest[ends] - rest[bones]
    axis /= np.linalg.norm(axis, axis=-1, keepdims=True)
    before, after = rotations[:-1][:, :, bones], rotations[1:][:, :, bones]
    turn = np.swapaxes(before, -1, -2) @ after
    vector = np.stack([turn[..., i, j] - turn[..., j, i] for i, j in ((2, 1), (0, 2), (1, 0))], axis=-1)
    # A quaternion (w, v) has v = vector / (4 w) and 4 w² = 1 + trace: the twist is 2 atan2(v . axis, w).
    four_w_squared = 1 + np.trace(turn, axis1=-2, axis2=-1)
    return 2 * np.arctan2(np.sum(vector * axis, axis=-1), np.maximum(four_w_squared, 0.0))


def _parameters(people: Reconstruction, model: BodyModel) -> BodyParameters:
    columns = (people.betas, people.global_orient, people.body_pose, people.transl)
    return BodyParameters(*(torch.from_numpy(column).to(model.dtype) for column in columns))
