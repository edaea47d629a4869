"""Where a body can have the joints that views hardly determine: with the body, and limbs as long as its own."""

from collections.abc import Iterable, Sequence

import numpy as np

from shapepose_fg.body.fitting.fitter import BodyFitter, JointTargets
from shapepose_fg.core.arrays import Array, Mask
from shapepose_fg.estimation.in_time import near_in_time, smoothed_in_time, waited_s
from shapepose_fg.estimation.linearisation import weakest_sigma
from shapepose_fg.estimation.motion_model import LOST_M
from shapepose_fg.estimation.state import State

LIMB_SIGMA_M = 0.03
"""Sigma of an unseen joint from which on it is more the body's than its own."""
STEP_S = 0.1
"""Time over which what a body changes of unseen joints is averaged, seconds, one sigma."""
LENGTH_SIGMA_M = 0.1
"""How far a limb of a detector's joints may be from its length, metres, in one sweep: as far as the views may
leave open a joint that counts as seen (`motion_model.LOST_M`). With `_SWEEPS` sweeps the length counts about four
times, as if this were 5 cm: of what a limb lacks (s² / (v + s²))^4 is left, s being this and v the variance of its
ends along it. Ends of 2 cm each close a quarter of it, ends of 10 cm each all but a hundredth. Results are
measured so."""
ARMS_AND_LEGS = {
    ("Shoulder", "Elbow"): 0.06, ("Elbow", "Wrist"): 0.05, ("Hip", "Knee"): 0.09, ("Knee", "Ankle"): 0.07,
}  # fmt: skip
"""From the trunk outwards, on either side, and half their widths, metres."""
_FEET = (("Ankle", "Heel"), ("Ankle", "BigToe"), ("BigToe", "SmallToe"))
_SWEEPS = 4
"""How often all limbs are gone through, each time with the covariances of before the first: a wrist follows the
elbow that the shoulder holds."""


def limbs_kept(state: State, covariance: Array, fitter: BodyFitter) -> Array:
    """Joints (N, J, 3): those that no view saw, in windows of several frames, where a body can have them, and
    limbs as long as the body's where views leave an end open. `covariance` (N, J, 3, 3) is the joints' own.

    Not those with factors of the user's own. Steps are averaged over time: bodies are fitted frame by frame.
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
    """Steps (N, J, 3), metres, that take joints that no view saw, `unseen` (N, J), to where a body can have them.

    Motion carries each joint by itself: elbow and wrist, both hidden, drift apart. A body is fitted to all joints
    as they are known, and an unseen one goes towards the body's, C (C + s² I)^-1 of the way, for its covariance C
    and s = `LIMB_SIGMA_M`. Covariances stay: what the body says of the joint is in them already.
    """
    known = np.asarray(np.isfinite(joints).all(axis=-1) & np.isfinite(covariance).all(axis=(-2, -1)))
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
    """The arms, legs and feet among a detector's joints, as pairs of their numbers."""
    return on_both_sides((*ARMS_AND_LEGS, *_FEET), joints)


def on_both_sides(parts: Iterable[tuple[str, ...]], joints: Sequence[str]) -> list[tuple[int, ...]]:
    """The numbers of the joints of `parts`, named without their side, right and left; those that a detector's
    `joints` have all of.
    """
    named = [tuple(f"{side}{name}" for name in part) for side in "RL" for part in parts]
    return [tuple(joints.index(name) for name in part) for part in named if {*part} <= {*joints}]


def limb_lengths(body: Array, limbs: Sequence[tuple[int, ...]]) -> Array:
    """(L,) length of each limb, metres: the median of those of one person's body in T frames; NaN where unknown.

    `body` (T, J, 3) are the body's joints, NaN in frames without a body.
    """
    first, second = np.array(limbs, dtype=np.intp).reshape(-1, 2).T
    length = np.linalg.norm(body[:, first] - body[:, second], axis=-1)
    length = length[np.isfinite(length).all(axis=1)]
    return np.median(length, axis=0) if len(length) > 0 else np.full(len(first), np.nan)


def with_lengths(
    joints: Array, covariance: Array, moved: Mask, lengths: Array, limbs: Sequence[tuple[int, ...]]
) -> Array:
    """Joints (N, J, 3), metres, of which those `moved` (N, J) go where limbs have their `lengths` (L,).

    In each of `_SWEEPS` sweeps each limb is observed to have its length to `LENGTH_SIGMA_M`, and its ends share
    what is missing by their `covariance` (N, J, 3, 3): a joint that one view saw moves along the ray, one that
    nothing saw any way. The covariance does not shrink from sweep to sweep, so that a length counts once in each.
    Joints that are not `moved` are held.
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
