"""How far a joint can be from its parent on a detector's skeleton, over all adults and poses."""

from functools import cache

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.body.fitting.pose_prior import PosePrior
from shapepose_fg.body.model.target_skeletons import BODY_POINTS
from shapepose_fg.core.skeleton import Skeleton

_SAMPLES = 2000
_MARGIN, _NOISE_M = 1.25, 0.05
"""Other people than the body model knows, and the errors of two joints (3 cm each, one and a half sigma)."""
_UNKNOWN_M = 0.75
"""No bone is longer: the trunk of a tall adult, hip to neck, is about 0.65 m."""


@cache
def longest_bones(skeleton: Skeleton) -> NDArray[np.float64]:
    """(J,) metres from each joint to its parent that hardly anybody exceeds; infinite for the root.

    The 99.9 % quantile over bodies within three standard deviations of shape, in poses drawn from the pose prior,
    with a margin. Joints that the body does not have get the longest of all.
    """
    import torch  # not before bodies are asked for: who only imports this needs none

    from shapepose_fg.body.model.body_model import BodyModel, BodyParameters

    known = [j for j, name in enumerate(skeleton.joints) if name in BODY_POINTS]
    model = BodyModel.default().with_keypoints(tuple(skeleton.joints[j] for j in known))
    rng = np.random.default_rng(0)
    pose = torch.from_numpy(PosePrior.default().sample(rng, _SAMPLES)).to(model.dtype)
    betas = torch.from_numpy(rng.standard_normal((_SAMPLES, 10)).clip(-3, 3)).to(model.dtype)
    still = pose.new_zeros(_SAMPLES, 3)
    xyz = np.full((_SAMPLES, len(skeleton), 3), np.nan)
    with torch.inference_mode():
        xyz[:, known] = model.keypoints(BodyParameters(betas, still, pose, still)).numpy()
    parents = np.array(skeleton.parents)
    length = np.quantile(np.linalg.norm(xyz - xyz[:, parents], axis=-1), 0.999, axis=0)
    longest = np.where(np.isfinite(length), _MARGIN * length + _NOISE_M, _UNKNOWN_M)
    return np.where(parents < 0, np.inf, longest)
