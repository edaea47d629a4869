"""Propagates uncertain poses of moving cameras to joints."""

from collections.abc import Sequence

import numpy as np

from shapepose_fg.body.fitting.fitter import JointTargets
from shapepose_fg.body.model.rotation import hat
from shapepose_fg.core.arrays import Array
from shapepose_fg.core.camera import Views
from shapepose_fg.core.observations import Observations
from shapepose_fg.estimation.gated_views import (
    ObservationConfig,
    ViewEvidence,
    information_by_view,
    inverses,
    linearise,
    observation_sigmas,
)

_NOTHING = 1.0
"""Information added to joints without any, 1/m²: one metre."""
POSES_LAST_S = 3.0
"""Correlation time of pose errors from SLAM, s: within it they count as one error."""


def carried_covariance(
    evidence: ViewEvidence,
    body: JointTargets,
    sigmas: Array,
    views: Views,
    config: ObservationConfig,
) -> Array:
    """(N, J, 3, 3) covariance of joints from uncertain camera poses, m²; zero for
    static cameras.
    """
    if views.carried is None or len(evidence.points) == 0:
        return np.zeros((*evidence.points.shape, 3))
    goes = goes_with_poses(evidence, body, sigmas, views, config)
    return np.einsum("njbik,nbkl,njbml->njim", goes, views.carried.covariance, goes, optimize=True)


def reported_with_poses(
    rows: Observations, joints: Array, views: Views, config: ObservationConfig, names: Sequence[str]
) -> Array:
    """(N, J, B, 3, 6) derivatives of `joints` (N, J, 3), with the given names, by the poses of
    carriers.
    """
    sigmas = observation_sigmas(rows, joints, views, config, names)
    nothing = JointTargets(joints, np.zeros((*joints.shape, 3)))
    return goes_with_poses(
        linearise(rows, sigmas, joints, views, config), nothing, sigmas, views, config
    )


def goes_with_poses(
    evidence: ViewEvidence,
    body: JointTargets,
    sigmas: Array,
    views: Views,
    config: ObservationConfig,
) -> Array:
    """(N, J, B, 3, 6) derivatives of joints by the poses of the B carriers of cameras, at least
    one.

    Joints are solved given the poses; the law of total covariance adds G S G^T, with S the
    covariance of a pose and G the derivative of the joint by it: the share of the joint's
    information from cameras on that carrier, times the derivative of a point fixed to the carrier.
    A body follows its views: its constraint moves with each carrier as its person's joints do on
    average, and so does a joint without information.
    """
    carried, points = views.carried, np.nan_to_num(evidence.points)
    assert carried is not None
    found = np.zeros((*points.shape[:2], carried.wTb.shape[1], 3, 6))
    by_view = information_by_view(evidence, sigmas, views, config)
    of_views = by_view.sum(axis=2)
    least = _NOTHING * np.eye(3)
    total = inverses(of_views + body.information + least)
    whole = np.maximum(np.trace(of_views.sum(axis=1), axis1=1, axis2=2), 1e-9)
    for number in range(carried.wTb.shape[1]):
        on = carried.carrier == number
        own = by_view[:, :, on].sum(axis=2)
        share = np.trace(own.sum(axis=1), axis1=1, axis2=2) / whole
        gain = total @ (own + share[:, None, None, None] * (body.information + least))
        R, t = carried.wTb[:, number, :3, :3], carried.wTb[:, number, :3, 3]
        arm = points - t[:, None]
        # A rotation w and a translation v along the carrier's axes move a point by R w x arm + R v.
        goes = np.concatenate(
            [-hat(arm) @ R[:, None], np.broadcast_to(R[:, None], (*arm.shape, 3))], axis=-1
        )
        found[:, :, number] = gain @ goes
    return found
