"""The people of the newest moment, and after it: joints with covariances, velocities, the last refined bodies."""

from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np

from shapepose_fg.core.arrays import Array, Mask
from shapepose_fg.core.camera import Rig, Views
from shapepose_fg.core.observations import Observations
from shapepose_fg.core.reconstruction import BODY, Known, Reconstruction, Status
from shapepose_fg.core.skeleton import Skeleton
from shapepose_fg.estimation.carried_error import carried_covariance
from shapepose_fg.estimation.estimator_config import EstimatorConfig
from shapepose_fg.estimation.linearisation import Message, linearise, observation_sigmas
from shapepose_fg.estimation.motion_model import MotionModel
from shapepose_fg.live.filtering import Moment, replaced
from shapepose_fg.tracking.motion_filter import JointStates
from shapepose_fg.tracking.stitching import Trace
from shapepose_fg.tracking.tracker import Tracker
from shapepose_fg.tracking.worlds import PLACED_M

_OWN_S, _TOGETHER_S = 0.3, 0.7
"""So long a joint goes on as it moves beside its person, and the person as it moves: 0.3 and 1 s ahead errors are
11 and 39 % smaller than straight on (simulated, split tune and crossing)."""
_LATER, _FADES_S = 3.5, 0.25
"""What the density of accelerations (`MotionModel.acceleration`) is multiplied with; for so long they last."""
_PACE, _PACE_UNSEEN = 0.1, 0.4
"""What the filter's variances of velocities are multiplied with, of joints that two views see and of others: it
follows as if everybody were fast (`pipeline.setup.FAST_M_S`)."""
_OF_ONE_VIEW, _OF_NONE = 1.5, 1.8
"""The same of positions: whose detection a view has is less sure where no other agrees.

With all of these 95 % regions hold 96 to 98 % now and 0.1 s, 96 to 98 % 0.3 s and 95 to 98 % 1 s ahead, of joints
that one view sees or none 90 to 100 % (four stretches of split `tune`, refined 0.13 s later, on which they were
chosen; docs/live.md has others)."""


@dataclass(frozen=True)
class Bodies:
    """The bodies of the newest frame that was refined."""

    rows: Reconstruction
    """A row per person."""
    centre: Array
    """(P, 3) the centres of their core joints, metres."""

    @classmethod
    def of(cls, rows: Reconstruction, skeleton: Skeleton) -> "Bodies":
        """Of the rows of one frame."""
        return cls(rows, Trace.of(0, rows.time_s, rows.joints, skeleton).centre)


def fed_back(tracker: Tracker, now: Moment, refined: Reconstruction) -> Moment:
    """The people after a frame, with joints where its `refined` rows put them, as far as they do."""
    identity = refined.person.tolist()
    rows = np.array([n for n, who in enumerate(now.identity.tolist()) if who in identity], dtype=np.intp)
    if len(rows) == 0:
        return now
    which = np.array([identity.index(who) for who in now.identity[rows].tolist()], dtype=np.intp)
    by, known = _states(tracker, refined.rows(which))
    joints = now.tracks.joints.rows(rows)
    fed = replaced(joints, by, known)
    mean, covariance = now.tracks.joints.mean.copy(), now.tracks.joints.covariance.copy()
    of_body = now.of_body.copy()
    mean[rows], covariance[rows] = fed.mean, fed.covariance
    of_body[rows] |= known & (now.views[rows] == 0)
    return replace(now, tracks=replace(now.tracks, joints=JointStates(mean, covariance)), of_body=of_body)


def of_poses(rows: Observations, joints: JointStates, rig: Rig, config: EstimatorConfig) -> Array:
    """(A, J, 3, 3) what is in the covariances of joints because poses of cameras that move are not known exactly.

    `rows` are what the newest frame has of A people: errors of poses last, so that no frame averages them out.
    """
    places, views = joints.position, Views.of(rig, rows.time_s)
    sigmas = observation_sigmas(rows, places, views, config.observations, config.joints)
    evidence = linearise(rows, sigmas, places, views, config.observations)
    nothing = Message(places, np.zeros((*places.shape, 3)))
    return carried_covariance(evidence, nothing, sigmas, views, config.observations)


@dataclass(frozen=True)
class Newest:
    """The newest frame, as `people` is asked of it."""

    frame: int
    """Its number."""
    moment: Moment
    """The people."""
    bodies: Bodies | None
    """The last refined bodies."""
    of_poses: Array | None = None
    """(A, J, 3, 3) see `of_poses`; None where no camera moves."""


def people_at(tracker: Tracker, motion: MotionModel, newest: Newest, ahead_s: float) -> Reconstruction:
    """Everybody `ahead_s` after the newest moment, as rows of its frame."""
    now, bodies = newest.moment, newest.bodies
    order = np.flatnonzero(now.named)[np.argsort(now.identity[now.named], kind="stable")]
    now = now.rows(order)
    P, J = now.views.shape
    known = now.tracks.joints.sigma_m < PLACED_M
    mean, covariance = later(now, tracker.skeleton, motion, ahead_s)
    if newest.of_poses is not None:
        covariance[..., :3, :3] += newest.of_poses[order]
    code = np.where(now.views >= 2, Known.SEEN, np.where(now.views == 1, Known.WEAK, Known.MOTION))
    code = np.where(now.of_body, Known.BODY, code)
    places = np.where(known[..., None], mean[..., :3], np.nan)
    covariance = np.where(known[..., None, None], covariance, np.nan)
    status, body = np.full(P, str(Status.BODY_UNDETERMINED)), _no_body(P)
    if bodies is not None and P > 0:
        own = bodies.rows.person.tolist()
        rows = np.array([n for n, who in enumerate(now.identity.tolist()) if who in own], dtype=np.intp)
        which = np.array([own.index(who) for who in now.identity[rows].tolist()], dtype=np.intp)
        moved = Trace.of(0, np.zeros(len(rows)), places[rows], tracker.skeleton).centre - bodies.centre[which]
        for name in BODY:
            body[name][rows] = getattr(bodies.rows, name)[which]
        body["transl"][rows] += moved
        status[rows] = np.where(
            np.isfinite(body["transl"][rows]).all(axis=1), bodies.rows.status[which], status[rows]
        )
    return Reconstruction(
        frame=np.full(P, newest.frame),
        person=now.identity,
        joint_names=np.array(tracker.skeleton.joints),
        joints=places,
        covariance=covariance[..., :3, :3],
        confidence=np.zeros((P, J)),
        status=status,
        time_s=np.full(P, now.tracks.time_s + ahead_s),
        velocity=np.where(known[..., None], mean[..., 3:], np.nan),
        velocity_covariance=covariance[..., 3:, 3:],
        known=np.where(known, code, Known.UNKNOWN).astype(np.uint8),
        **cast(Any, body),
    )


def later(now: Moment, skeleton: Skeleton, motion: MotionModel, ahead_s: float) -> tuple[Array, Array]:
    """Position and velocity (A, J, 6) of everybody's joints `ahead_s` later, and what is reported of them:
    covariances (A, J, 6, 6) of either, without what they have in common.

    A joint's velocity becomes that of its person, the median of the core joints', and this fades: white noise on
    accelerations, with friction; more the faster the joint and the person's joints are: who walks swings the leg
    that stands.
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
    wider, pace = np.array([_OF_NONE, _OF_ONE_VIEW, 1.0]), np.array([_PACE_UNSEEN, _PACE_UNSEEN, _PACE])
    wider, pace = (each[np.minimum(now.views, 2)][..., None, None] for each in (wider, pace))
    moves = pace * joints.covariance[..., 3:6, 3:6]
    grows = (density * tau**3 * (a + 2 * np.expm1(-a) + fades))[..., None, None]
    covariance[..., :3, :3] = wider * joints.covariance[..., :3, :3] + own**2 * moves + grows * eye
    covariance[..., 3:, 3:] = moves + (density * tau * fades)[..., None, None] * eye
    return mean, covariance


def _no_body(P: int) -> dict[str, Array]:
    shapes = {"betas": (P, 10), "global_orient": (P, 3), "body_pose": (P, 23, 3), "transl": (P, 3)}
    return {name: np.full(shapes[name], np.nan) for name in BODY}


def _states(tracker: Tracker, rows: Reconstruction) -> tuple[JointStates, Mask]:
    """Refined joints as the filter's states, and which of them (P, J) are known."""
    start = tracker.scale.motion.start
    known = np.asarray(np.isfinite(rows.joints).all(axis=-1)) & np.isfinite(rows.covariance).all(axis=(-2, -1))
    states = JointStates.at(np.where(known[..., None], rows.joints, 0.0), np.ones(known.shape), start)
    moving = known & np.isfinite(rows.velocity).all(axis=-1)
    moving &= np.isfinite(rows.velocity_covariance).all(axis=(-2, -1))
    mean, covariance = states.mean, states.covariance
    covariance[known, :3, :3] = rows.covariance[known]
    mean[moving, 3:6] = rows.velocity[moving]
    covariance[moving, 3:6, 3:6] = rows.velocity_covariance[moving]
    return JointStates(mean, covariance), known
