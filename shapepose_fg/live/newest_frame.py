"""The people of the newest frame, and predictions beyond it: joints with covariances, velocities,
bodies.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, cast

import numpy as np

from shapepose_fg.body.fitting.fitter import BodyFit, BodyFitter, JointTargets
from shapepose_fg.core.arrays import Array, Mask
from shapepose_fg.core.camera import Rig, Views
from shapepose_fg.core.observations import Observations
from shapepose_fg.core.reconstruction import BODY, Known, Reconstruction, Status
from shapepose_fg.core.skeleton import Skeleton
from shapepose_fg.estimation.camera_pose_uncertainty import carried_covariance
from shapepose_fg.estimation.draft import MODEL_SIGMA_M
from shapepose_fg.estimation.estimator_config import EstimatorConfig
from shapepose_fg.estimation.gated_views import linearise, observation_sigmas
from shapepose_fg.estimation.motion_densities import MotionModel
from shapepose_fg.live.filtering import FilterState
from shapepose_fg.tracking.motion_filter import LOST_M, JointStates
from shapepose_fg.tracking.tracker import Tracker

_OWN_S, _TOGETHER_S = 0.3, 0.7
"""Time constants with which the velocity of a joint relative to its person, and that of the person,
decay, s: 0.3 and 1 s ahead errors are 11 and 39 % smaller than with constant velocity (simulated,
split tune and crossing)."""
_LATER, _FADES_S = 3.5, 0.25
"""Factor on the power spectral density of accelerations (`MotionModel.acceleration`) in
predictions, and the time constant with which accelerations decay, s."""
_PACE, _PACE_UNSEEN = 0.1, 0.4
"""Factors on the filter's variances of velocities, for joints that two views see and for others:
the filter assumes fast joints (`pipeline.setup.FAST_M_S`). With these factors, 95 % regions contain
94 to 97 % of joints 0.1 to 1 s ahead (four stretches of split `tune`, six cameras, on which they
were chosen)."""
_FORGOTTEN = 0.1
"""Share of the filter's variance, which grows while no two views see a joint, that is added to the
variance from the body: a hidden head may have turned. 95 % regions then contain 98 to 100 % of
unseen joints in three stretches of split `tune`, and 92 and 86 % in crowds; without it 91 to 95, 75
and 57 %."""


def fed_back(tracker: Tracker, now: FilterState, refined: Reconstruction) -> FilterState:
    """The state after a frame, with joints replaced by those of its `refined` rows where these are
    known.
    """
    _, rows, which = np.intersect1d(now.identity, refined.person, return_indices=True)
    by, known = _states(tracker, refined.rows(which))
    mean, covariance = now.tracks.joints.mean.copy(), now.tracks.joints.covariance.copy()
    mean[rows] = np.where(known[..., None], by.mean, mean[rows])
    covariance[rows] = np.where(known[..., None, None], by.covariance, covariance[rows])
    return replace(now, tracks=replace(now.tracks, joints=JointStates(mean, covariance)))


def of_poses(rows: Observations, joints: JointStates, rig: Rig, config: EstimatorConfig) -> Array:
    """(A, J, 3, 3) part of the joints' covariances, m², due to uncertain poses of moving cameras.

    `rows` are the newest frame's rows of A people. Pose errors are correlated over time, so that
    frames do not average them out.
    """
    places, views = joints.position, Views.of(rig, rows.time_s)
    sigmas = observation_sigmas(rows, places, views, config.observations, config.joints)
    evidence = linearise(rows, sigmas, places, views, config.observations)
    nothing = JointTargets(places, np.zeros((*places.shape, 3)))
    return carried_covariance(evidence, nothing, sigmas, views, config.observations)


@dataclass(frozen=True)
class Newest:
    """The newest frame, from which `people` is computed."""

    frame: int
    """Number of the newest frame."""
    state: FilterState
    """The tracks, also those without an identity yet."""
    fitter: BodyFitter
    """Fits the bodies of the tracks."""
    doubted: bool = False
    """Whether cameras contradict each other and it is unknown which are wrong."""
    doubt: Array | None = None
    """(A, J, 3, 3) added to covariances, m², for moving cameras (`of_poses`) and ambiguous sides;
    None for nothing."""

    @cached_property
    def people(self) -> tuple[FilterState, Array, Array, BodyFit]:
        """Tracks with identities, covariances (P, J, 3, 3) of their joints, NaN where unknown,
        codes (P, J) of `Known`, and their bodies.

        Bodies are fitted to the known joints. Joints that fewer than two views see are taken from
        the body if its covariance is smaller and two views see another joint; otherwise the body
        follows from motion and the prior. Tracks without a known joint are left out.
        """
        named = np.flatnonzero(
            self.state.named & (self.state.tracks.joints.sigma_m < LOST_M).any(axis=1)
        )
        order = named[np.argsort(self.state.identity[named], kind="stable")]
        now = self.state.rows(order)
        joints, known = now.tracks.joints, now.tracks.joints.sigma_m < LOST_M
        covariance = joints.covariance[..., :3, :3].copy()
        information = np.zeros_like(covariance)
        information[known] = np.linalg.inv(covariance[known])
        fit = self.fitter.fit(
            JointTargets(np.where(known[..., None], joints.position, 0.0), information)
        )
        of_body = fit.covariance + MODEL_SIGMA_M**2 * np.eye(3) + _FORGOTTEN * covariance
        surer = np.trace(of_body, axis1=2, axis2=3) < np.trace(
            covariance, axis1=2, axis2=3
        )  # false for NaN
        seen = now.views >= 2
        surer &= ~seen & seen.any(axis=1, keepdims=True)
        mean = joints.mean.copy()
        mean[surer, :3], covariance[surer] = fit.joints[surer], of_body[surer]
        covariance[~(known | surer)] = np.nan
        if self.doubt is not None:
            covariance += self.doubt[order]
        unseen = np.where(surer, Known.BODY, Known.MOTION)
        code = np.where(now.views >= 2, Known.SEEN, np.where(now.views == 1, Known.WEAK, unseen))
        code = np.where(known | surer, code, Known.UNKNOWN)
        return (
            replace(now, tracks=replace(now.tracks, joints=JointStates(mean, joints.covariance))),
            covariance,
            code,
            fit,
        )


def people_at(
    newest: Newest, skeleton: Skeleton, motion: MotionModel, ahead_s: float
) -> Reconstruction:
    """Rows of all people, predicted `ahead_s` after the newest frame, with its frame number."""
    now, present, code, fit = newest.people
    P, J = now.views.shape
    mean, covariance = later(now, present, skeleton, motion, ahead_s)
    known = code != Known.UNKNOWN
    moved = (mean[..., :3] - now.tracks.joints.position)[:, list(skeleton.core)].mean(axis=1)
    body = {name: getattr(fit, name).copy() for name in BODY}
    for each in body.values():
        each[~fit.ok] = np.nan
    status = np.where(
        fit.ok, Status.CONTRADICTED if newest.doubted else Status.OK, Status.BODY_UNDETERMINED
    )
    return Reconstruction(
        frame=np.full(P, newest.frame),
        person=now.identity,
        joint_names=np.array(skeleton.joints),
        joints=np.where(known[..., None], mean[..., :3], np.nan),
        covariance=np.where(known[..., None, None], covariance[..., :3, :3], np.nan),
        confidence=np.zeros((P, J)),
        status=status,
        time_s=np.full(P, now.tracks.time_s + ahead_s),
        velocity=np.where(known[..., None], mean[..., 3:], np.nan),
        velocity_covariance=np.where(known[..., None, None], covariance[..., 3:, 3:], np.nan),
        known=code.astype(np.uint8),
        **cast(Any, body | {"transl": body["transl"] + moved}),
    )


def later(
    now: FilterState, present: Array, skeleton: Skeleton, motion: MotionModel, ahead_s: float
) -> tuple[Array, Array]:
    """Position and velocity (A, J, 6) of all joints `ahead_s` later, and covariances (A, J, 6, 6)
    to report.

    The covariances neglect the correlation of position and velocity. `present` (A, J, 3, 3) are the
    joints' present covariances. A joint's velocity converges to that of its person, the median of
    the core joints', which decays. Accelerations are white noise with friction, stronger the faster
    the joint and the person's joints are: in walking, the leg that stood still swings next.
    """
    joints = now.tracks.joints
    x, v = joints.position, joints.velocity
    core = np.median(v[:, list(skeleton.core)], axis=1, keepdims=True)
    own, together = (tau * -np.expm1(-ahead_s / tau) for tau in (_OWN_S, _TOGETHER_S))
    mean = np.empty((*x.shape[:2], 6))
    mean[..., :3] = x + together * core + own * (v - core)
    mean[..., 3:] = np.exp(-ahead_s / _TOGETHER_S) * core + np.exp(-ahead_s / _OWN_S) * (v - core)
    speed = np.linalg.norm(v, axis=-1)
    density = _LATER * motion.acceleration((speed + speed.mean(axis=1, keepdims=True)) / 2)
    tau, a = _FADES_S, ahead_s / _FADES_S
    fades = -np.expm1(-2 * a) / 2
    covariance, eye = np.zeros((*x.shape[:2], 6, 6)), np.eye(3)
    moves = (
        np.where(now.views >= 2, _PACE, _PACE_UNSEEN)[..., None, None]
        * joints.covariance[..., 3:6, 3:6]
    )
    grows = (density * tau**3 * (a + 2 * np.expm1(-a) + fades))[..., None, None]
    covariance[..., :3, :3] = present + own**2 * moves + grows * eye
    covariance[..., 3:, 3:] = moves + (density * tau * fades)[..., None, None] * eye
    return mean, covariance


def _states(tracker: Tracker, rows: Reconstruction) -> tuple[JointStates, Mask]:
    """Refined joints as states of the filter, and which of them (P, J) are known."""
    start = tracker.scale.motion.start
    known = np.asarray(np.isfinite(rows.joints).all(axis=-1)) & np.isfinite(rows.covariance).all(
        axis=(-2, -1)
    )
    states = JointStates.at(
        np.where(known[..., None], rows.joints, 0.0), np.ones(known.shape), start
    )
    moving = known & np.isfinite(rows.velocity).all(axis=-1)
    moving &= np.isfinite(rows.velocity_covariance).all(axis=(-2, -1))
    mean, covariance = states.mean, states.covariance
    covariance[known, :3, :3] = rows.covariance[known]
    mean[moving, 3:6] = rows.velocity[moving]
    covariance[moving, 3:6, 3:6] = rows.velocity_covariance[moving]
    return JointStates(mean, covariance), known
