"""Roughly where joints are, without a graph: enough to give the detections out again."""

from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.body.fitting.fitter import BodyFit, BodyFitter, JointTargets
from shapepose_fg.estimation.linearisation import ViewEvidence

MODEL_SIGMA_M = 0.02
"""How far a detector's joints lie from the body's, metres."""


@runtime_checkable
class WholeFitter(BodyFitter, Protocol):
    """A fitter that is faster where nobody needs a joint's prior without its own target."""

    def fit_whole(self, targets: JointTargets, initial: BodyFit | None = None) -> BodyFit:
        """Bodies of all rows, `prior_xyz` and `prior_covariance` NaN."""
        ...


def drafted(
    evidence: ViewEvidence, body: BodyFit, disagreement: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Places (N, J, 3), metres, and covariances (N, J, 3, 3) of joints; NaN where neither views nor body say any.

    What the views say and what the body says, weighted by their information. Views that are `disagreement`
    standard deviations from the body count nothing: its robust kernel has passed over them, too.
    """
    known = (body.ok[:, None] & np.isfinite(body.covariance).all(axis=(2, 3)))[..., None]
    covariance = np.where(known[..., None], body.covariance + MODEL_SIGMA_M**2 * np.eye(3), np.eye(3))
    at = np.where(known, body.joints, np.nan_to_num(evidence.target))
    apart = np.nan_to_num(evidence.target) - at
    views = evidence.information
    weight = views @ np.linalg.inv(np.eye(3) + covariance @ views)
    agree = np.einsum("...i,...ij,...j->...", apart, weight, apart) < disagreement**2
    views = np.where(agree[..., None, None], views, 0.0)
    total = views + np.where(known[..., None], np.linalg.inv(covariance), 0.0)
    determined = np.linalg.eigvalsh(total)[..., 0] > 1.0  # to a metre
    joint_covariance = np.linalg.inv(np.where(determined[..., None, None], total, np.eye(3)))
    place = at + np.einsum("...ij,...j->...i", joint_covariance @ views, apart)
    place = np.where(determined[..., None], place, np.nan)
    return place, np.where(determined[..., None, None], joint_covariance, np.nan)
