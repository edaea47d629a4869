"""Whether the arrays of a body model are those of a person: in metres, upright, and left where left is."""

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.skeleton import BODY_25, SMPL_24

_HEIGHT_M = (0.4, 3.0)
"""From a newborn to more than any adult: a template in centimetres or millimetres is far outside."""
_SUM_TOLERANCE = 0.02
"""Regressors are weighted means, printed with a few digits."""
_BELONGS = {
    "RShoulder": "right_shoulder", "RElbow": "right_elbow", "RWrist": "right_wrist",
    "LShoulder": "left_shoulder", "LElbow": "left_elbow", "LWrist": "left_wrist",
    "RHip": "right_hip", "RKnee": "right_knee", "RAnkle": "right_ankle",
    "LHip": "left_hip", "LKnee": "left_knee", "LAnkle": "left_ankle",
}  # fmt: skip
"""SMPL joints that keypoints lie at."""
_FARTHEST = 0.15
"""How far they may be from these, as a part of the body's height."""
_RISING = ("ankle", "knee", "hip", "shoulder")
"""Joints from below to above in the T-pose."""


def implausible(
    template: NDArray[np.float64], joint_regressor: NDArray[np.float64], keypoint_regressor: NDArray[np.float64]
) -> str | None:
    """What is wrong, as the end of a sentence that names the array; None where it may be a person.

    `template` (Nv, 3) in T-pose, y up, facing +z; regressors (24, Nv) and (25, Nv).
    """
    height = float(np.ptp(template[:, 1]))
    if not _HEIGHT_M[0] <= height <= _HEIGHT_M[1]:
        return f"v_template is {height:.4g} high along y: give it in metres, y up"
    for name, regressor in (("J_regressor", joint_regressor), ("keypoint_regressor", keypoint_regressor)):
        off = np.abs(regressor.sum(axis=1) - 1).max()
        if off > _SUM_TOLERANCE:
            return (
                f"{name} has rows that do not sum to 1 (off by {off:.2g}): use the file of one and the same model"
            )
    joints: dict[str, NDArray[np.float64]] = dict(zip(SMPL_24, joint_regressor @ template, strict=True))
    keypoints: dict[str, NDArray[np.float64]] = dict(
        zip(BODY_25.joints, keypoint_regressor @ template, strict=True)
    )
    for part in (*_RISING, "elbow", "wrist"):
        if not joints[f"left_{part}"][0] > joints[f"right_{part}"][0]:
            return f"J_regressor puts left_{part} to the right of right_{part}: the body's left is +x"
    for side in ("left", "right"):
        for low, high in pairwise(_RISING):
            if not joints[f"{side}_{low}"][1] < joints[f"{side}_{high}"][1]:
                return (
                    f"J_regressor puts {side}_{low} above {side}_{high}: rows are SMPL's joints in order, y is up"
                )
    for name, joint in _BELONGS.items():
        distance = float(np.linalg.norm(keypoints[name] - joints[joint]))
        side, part = joint.split("_")
        mirrored = joints[f"{'right' if side == 'left' else 'left'}_{part}"]
        if distance > _FARTHEST * height or distance > np.linalg.norm(keypoints[name] - mirrored):
            return f"keypoint_regressor puts {name} {distance:.2g} m from {joint}: rows are BODY_25 in order"
    return None
