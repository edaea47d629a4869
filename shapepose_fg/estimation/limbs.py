"""Corrects joints that views hardly determine to positions that a body can have, with its limb
lengths.
"""

from collections.abc import Iterable, Sequence

import numpy as np

from shapepose_fg.body.fitting.fitter import BodyFitter, JointTargets
from shapepose_fg.core.arrays import Array, Mask
from shapepose_fg.estimation.in_time import near_in_time, smoothed_in_time, waited_s
from shapepose_fg.estimation.linearisation import weakest_sigma
from shapepose_fg.estimation.motion_model import LOST_M
from shapepose_fg.estimation.state import State

LIMB_SIGMA_M = 0.03
"""Standard deviation of an unseen joint, m, at which it moves half way to the body's."""
STEP_S = 0.1
"""Standard deviation of the temporal smoothing of the body's corrections, seconds."""
LENGTH_SIGMA_M = 0.1
"""Standard deviation of a limb's length between a detector's joints, metres, per sweep, as large as
the allowed uncertainty of a seen joint (`motion_model.LOST_M`). With `_SWEEPS` sweeps the length
counts about four times, as if it were 5 cm: the share (s² / (v + s²))^4 of a length error remains,
with s this value and v the variance of the ends along the limb. Ends of 2 cm each remove a quarter
of it, ends of 10 cm each all but a hundredth. Reported accuracies include this."""
ARMS_AND_LEGS = {
    ("Shoulder", "Elbow"): 0.06, ("Elbow", "Wrist"): 0.05, ("Hip", "Knee"): 0.09,
    ("Knee", "Ankle"): 0.07,
}  # fmt: skip
"""Limbs on either side, from the trunk outwards, and half their widths, metres."""
_FEET = (("Ankle", "Heel"), ("Ankle", "BigToe"), ("BigToe", "SmallToe"))
_SWEEPS = 4
"""Number of sweeps over all limbs, each with the initial covariances, so that a wrist follows the
elbow, and the elbow the shoulder."""


def limbs_kept(state: State, covariance: Array, fitter: BodyFitter) -> Array:
    """Joints (N, J, 3) in windows of several frames, with unseen ones moved to positions possible
    for a body, and limbs with an uncertain end set to the body's length. `covariance` (N, J, 3, 3)
    is that of the joints.

    Joints with user factors are excluded. Steps are smoothed over time, because bodies are fitted
    frame by frame.
    """
    X, limbs = state.joints, limbs_of(state.config.joints)
    unseen = ~np.asarray(state.inlier.any(axis=-1))
    for person in state.people:
        unseen[person.rows] &= person.temporal & ~person.touched
    steps = limb_steps(X, covariance, unseen, fitter)
    weak, placed = weakest_sigma(state.of_views.information) > LOST_M, X.copy()
    for person in state.people:
        rows, times_s = person.rows, person.times_s
        if not person.temporal:
            continue
        moved = near_in_time(weak[rows], times_s, STEP_S) & ~person.touched
        lengths = limb_lengths(state.fit.joints[rows], limbs)
        stepped = smoothed_in_time(steps[rows], times_s, STEP_S)
        into = np.minimum(waited_s(~unseen[rows], times_s) / STEP_S, 1.0)
        stepped = X[rows] + into[..., None] * stepped
        placed[rows] = with_lengths(stepped, covariance[rows], moved, lengths, limbs)
    return placed


def limb_steps(joints: Array, covariance: Array, unseen: Mask, fitter: BodyFitter) -> Array:
    """Steps (N, J, 3), metres, of `unseen` joints (N, J) towards positions possible for a body.

    The motion model moves each joint independently, so that a hidden elbow and wrist drift apart. A
    body is fitted to all joints with their covariances C, and an unseen joint moves by C (C + s²
    I)^-1 of the distance to the body's, with s = `LIMB_SIGMA_M`. Covariances are unchanged: they
    already include the body's information on the joint.
    """
    known = np.asarray(
        np.isfinite(joints).all(axis=-1) & np.isfinite(covariance).all(axis=(-2, -1))
    )
    moved = unseen & known
    rows = np.flatnonzero(moved.any(axis=-1))
    steps = np.zeros(joints.shape)
    if len(rows) == 0:
        return steps
    body = fitter.fit_whole(JointTargets.solved(joints[rows], covariance[rows]))
    C = np.where(known[rows][..., None, None], covariance[rows], np.eye(3))
    share = C @ np.linalg.inv(C + LIMB_SIGMA_M**2 * np.eye(3))
    step = np.einsum("...ij,...j->...i", share, body.joints - joints[rows])
    steps[rows] = np.where((moved[rows] & np.isfinite(step).all(axis=-1))[..., None], step, 0.0)
    return steps


def limbs_of(joints: Sequence[str]) -> list[tuple[int, ...]]:
    """Arms, legs and feet among a detector's joints, as pairs of indices."""
    return on_both_sides((*ARMS_AND_LEGS, *_FEET), joints)


def on_both_sides(parts: Iterable[tuple[str, ...]], joints: Sequence[str]) -> list[tuple[int, ...]]:
    """Indices of the joints of `parts`, named without side, right and left, if all are
    in `joints`.
    """
    named = [tuple(f"{side}{name}" for name in part) for side in "RL" for part in parts]
    return [tuple(joints.index(name) for name in part) for part in named if {*part} <= {*joints}]


def limb_lengths(body: Array, limbs: Sequence[tuple[int, ...]]) -> Array:
    """(L,) length of each limb, metres: the median over one person's body in T frames; NaN if
    unknown.

    `body` (T, J, 3) are the body's joints, NaN in frames without a body.
    """
    first, second = np.array(limbs, dtype=np.intp).reshape(-1, 2).T
    length = np.linalg.norm(body[:, first] - body[:, second], axis=-1)
    length = length[np.isfinite(length).all(axis=1)]
    return np.median(length, axis=0) if len(length) > 0 else np.full(len(first), np.nan)


def with_lengths(
    joints: Array, covariance: Array, moved: Mask, lengths: Array, limbs: Sequence[tuple[int, ...]]
) -> Array:
    """Joints (N, J, 3), metres, with the `moved` ones (N, J) adjusted to limb `lengths` (L,).

    In each of `_SWEEPS` sweeps each limb's length is a measurement with `LENGTH_SIGMA_M`, and the
    correction is shared by its ends according to their `covariance` (N, J, 3, 3): a joint seen by
    one view moves along the ray, an unseen one in any direction. The covariance is not reduced
    between sweeps, so that a length counts once in each. Joints that are not `moved` are fixed.
    """
    X = joints.copy()
    known = np.asarray(np.isfinite(X).all(axis=-1) & np.isfinite(covariance).all(axis=(-2, -1)))
    free = np.where((moved & known)[..., None, None], np.nan_to_num(covariance), 0.0)
    for _ in range(_SWEEPS):
        for length, ends in zip(lengths.tolist(), limbs, strict=True):
            a, b = ends
            rows = np.flatnonzero(known[:, a] & known[:, b] & (moved[:, a] | moved[:, b]))
            if not np.isfinite(length) or len(rows) == 0:
                continue
            apart = X[rows, b] - X[rows, a]
            distance = np.linalg.norm(apart, axis=1, keepdims=True)
            along = apart / np.maximum(distance, 1e-6)
            pulls = [np.einsum("nij,nj->ni", free[rows, end], along) for end in ends]
            variance = sum(np.einsum("ni,ni->n", pull, along) for pull in pulls) + LENGTH_SIGMA_M**2
            missing = (length - distance) / np.asarray(variance)[:, None]
            X[rows, a] -= pulls[0] * missing
            X[rows, b] += pulls[1] * missing
    return X
