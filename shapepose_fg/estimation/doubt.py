"""What it means for a joint that it is not certain whose its detections are."""

import numpy as np
from numpy.typing import NDArray

from factors import kernel_weight
from shapepose_fg.core.camera import Views
from shapepose_fg.core.observations import Observations
from shapepose_fg.estimation.linearisation import LEAST_PROBABILITY, ObservationConfig, ViewEvidence
from shapepose_fg.estimation.message import Message

Array = NDArray[np.float64]

CERTAIN = 0.99
"""Observations that are more probably the person's make no alternatives: four in five."""
FREE_M = 0.3
"""A joint that nothing but a doubtful observation places is known to this, metres, without it: half an arm."""


def association_spread(
    observations: Observations,
    sigmas: Array,
    evidence: ViewEvidence,
    body: Message,
    views: Views,
    config: ObservationConfig,
) -> Array:
    """(N, J, 3, 3) covariance between the places that joints have with and without each doubtful observation, m².

    An observation of probability p is in the solution with p times its information. Were it certain, the joint
    would be in one place, without it in another; of the mixture of both the solution's covariance stands for what
    each leaves, and p (1 - p) d d^T is what is between them, d being the way from one to the other. Whole
    stretches are the one or the other: d is taken from one frame's views, `evidence` at the solved joints, and
    from what the `body` says, without the motion that holds a frame to its neighbours. The sum over the views.
    """
    joints = evidence.points
    spread = np.zeros((*joints.shape, 3))
    probability = np.maximum(observations.probability, LEAST_PROBABILITY)
    doubtful = evidence.inlier & (probability < CERTAIN)
    row, joint, view = np.nonzero(doubtful)
    if len(row) == 0:
        return spread
    _, _, jacobian = views.project(joints)
    jacobian, residual = jacobian[row, joint, view], evidence.residual_px[row, joint, view]
    sigma, p = sigmas[row, joint, view], probability[row, joint, view]
    weight = kernel_weight(config.robust_kernel, np.linalg.norm(residual, axis=-1) / sigma) / sigma**2
    information = weight[:, None, None] * jacobian.mT @ jacobian
    gradient = weight[:, None] * np.einsum("nik,ni->nk", jacobian, residual)
    pull = np.einsum("...ij,...j->...i", body.information, joints - np.nan_to_num(body.xyz))
    all_of_it = (evidence.gradient + pull)[row, joint] - gradient
    rest = (evidence.information + body.information)[row, joint] - information + np.eye(3) / FREE_M**2
    without = np.linalg.solve(rest, all_of_it[..., None])
    certain = np.linalg.solve(
        rest + information / p[:, None, None], (all_of_it + gradient / p[:, None])[..., None]
    )
    apart = (without - certain)[..., 0] * np.sqrt(p * (1 - p))[:, None]
    np.add.at(spread, (row, joint), apart[:, :, None] * apart[:, None])
    return spread
