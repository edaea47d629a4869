"""Roughly where joints are, without a graph: enough to give the detections out again."""

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.body.fitting.fitter import BodyFit, BodyFitter, JointTargets
from shapepose_fg.estimation.linearisation import ViewEvidence

MODEL_SIGMA_M = 0.02
"""How far a detector's joints lie from the body's, metres."""

NARROWING = (4.0, 2.0, 1.0, 1.0)
"""How many times as wide as in the end the kernel of a draft's body is, fit by fit. With priors that are stiff as
long as it is wide, as in SMPLify, F1 rose by 1.5 points on `tune`, and raised arms hung on real footage."""

MOVED_M = 0.02
"""A draft's body is fitted again only where a joint's target moved by this since its last fit, as much as a
detector's joints lie from the body's, or weighs another share: on Shelf a quarter of all fits are left."""

LIMB_SIGMA_M = 0.03
"""Sigma of an unseen joint from which on it is more the body's than its own."""


def changed_targets(before: JointTargets, now: JointTargets) -> NDArray[np.intp]:
    """Which rows have a joint whose target moved by more than `MOVED_M`, or weighs twice or half what it did."""
    weights = [np.trace(each.information, axis1=2, axis2=3) for each in (before, now)]
    less, more = np.minimum(*weights), np.maximum(*weights)
    moved = (more > 0) & (np.linalg.norm(now.xyz - before.xyz, axis=-1) > MOVED_M)
    return np.flatnonzero((moved | (more > 2 * less)).any(axis=1))


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


def limb_steps(
    joints: NDArray[np.float64],
    covariance: NDArray[np.float64],
    unseen: NDArray[np.bool_],
    fitter: BodyFitter,
) -> NDArray[np.float64]:
    """Steps (N, J, 3), metres, that take joints that no view saw, `unseen` (N, J), to where a body can have them.

    Motion carries each joint by itself: elbow and wrist, both hidden, drift apart. A body is fitted to all joints
    as they are known, and an unseen one goes towards the body's, C (C + s² I)^-1 of the way: hardly where it was
    seen a moment ago, and wholly where its covariance C is large. s is `LIMB_SIGMA_M`. Covariances stay: what the
    body says of the joint without its views is in them already.
    """
    known = np.asarray(np.isfinite(joints).all(axis=-1) & np.isfinite(covariance).all(axis=(-2, -1)))
    moved = unseen & known
    rows = np.flatnonzero(moved.any(axis=-1))
    steps = np.zeros(joints.shape)
    if len(rows) == 0:
        return steps
    C = np.where(known[rows][..., None, None], covariance[rows], np.eye(3))
    information = np.where(known[rows][..., None, None], np.linalg.inv(C), 0.0)
    targets = JointTargets(np.nan_to_num(joints[rows]), (information + information.swapaxes(2, 3)) / 2)
    body = fitter.fit_whole(targets)
    share = C @ np.linalg.inv(C + LIMB_SIGMA_M**2 * np.eye(3))
    step = np.einsum("...ij,...j->...i", share, body.joints - joints[rows])
    steps[rows] = np.where((moved[rows] & np.isfinite(step).all(axis=-1))[..., None], step, 0.0)
    return steps
