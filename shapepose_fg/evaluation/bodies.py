"""What the bodies of a result say: their own joints, and how tall they are."""

import numpy as np
import torch
from numpy.typing import NDArray

from shapepose_fg.body.model.body_model import BodyModel, BodyParameters
from shapepose_fg.body.model.keypoint_offsets import KeypointOffsets
from shapepose_fg.reconstruction import Reconstruction


def body_joints(people: Reconstruction, model: BodyModel | None = None) -> NDArray[np.float64]:
    """(N, J, 3) the joints of the fitted bodies, where the detector puts them; NaN where there is no body.

    The offsets are those that the run learnt (`run["keypoint_offsets"]`); without any, the model's own joints.
    """
    model = BodyModel.default() if model is None else model
    offsets = people.run.get("keypoint_offsets")
    if offsets is not None:
        model = model.with_keypoint_offsets(KeypointOffsets.from_dict(offsets))
    columns = (people.betas, people.global_orient, people.body_pose, people.transl)
    with torch.no_grad():
        return model.keypoints(BodyParameters(*(_tensor(c, model) for c in columns))).double().numpy()


def statures(betas: NDArray[np.float64], model: BodyModel | None = None) -> NDArray[np.float64]:
    """(N,) height in metres of bodies of shape `betas` (N, 10) in the T-pose, sole to crown; NaN where unknown."""
    model = BodyModel.default() if model is None else model
    arrays = model.arrays
    up = arrays.template[:, 1]
    # No shape within three standard deviations moves a vertex past another that is 10 cm higher.
    ends = np.flatnonzero((up < up.min() + 0.1) | (up > up.max() - 0.1))
    height = up[ends] + np.asarray(betas, dtype=np.float64) @ arrays.shapes[ends, 1].T
    return height.max(axis=1) - height.min(axis=1)


def _tensor(column: NDArray[np.float64], model: BodyModel) -> torch.Tensor:
    return torch.from_numpy(column).to(model.dtype)
