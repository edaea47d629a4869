"""Kalman filter of joint positions and velocities, batched over people and joints."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from factors import Motion
from shapepose_fg.body.fitting.evidence import WELL_SEEN_M
from shapepose_fg.core.arrays import Array, Index, Mask
from shapepose_fg.core.compiled import kernel, part
from shapepose_fg.core.rows import Rows
from shapepose_fg.core.skeleton import Skeleton
from shapepose_fg.estimation.in_time import KNOWN_M

LOST_M = 0.2
"""Standard deviation, m, above which the place of a joint is not known. If it is predicted, the
joint is lost, and searched for around its parent; a joint seen by one view is not lost, however
uncertain its depth."""
_FOLLOW_S = 0.25
"""Time constant with which the velocity of a joint that is not well seen approaches that of the
person, s."""


@dataclass(frozen=True)
class JointStates(Rows):
    """Gaussian states of A people's J joints: position and n - 1 derivatives (`factors.Motion`)."""

    mean: Array
    """(A, J, 3 n) position, metres in the world, velocity, metres per second, and so on."""
    covariance: Array
    """(A, J, 3 n, 3 n) covariance of the states."""

    @property
    def position(self) -> Array:
        """(A, J, 3) positions, metres."""
        return self.mean[..., :3]

    @property
    def velocity(self) -> Array:
        """(A, J, 3) velocities, metres per second."""
        return self.mean[..., 3:6]

    @property
    def sigma_m(self) -> Array:
        """(A, J) standard deviation of the position, root mean square over the axes, metres."""
        return np.sqrt(sum(self.covariance[..., k, k] for k in range(3)) / 3)

    @classmethod
    def at(cls, position: Array, sigma_m: Array, start: Sequence[float]) -> "JointStates":
        """States at `position` (A, J, 3), sigma `sigma_m` (A, J); derivatives are 0 with the sigmas
        `start`.
        """
        mean = np.concatenate([position, *[np.zeros_like(position)] * len(start)], axis=-1)
        sigma = np.stack([sigma_m, *(np.full_like(sigma_m, each) for each in start)], axis=-1)
        return cls(mean, np.repeat(sigma**2, 3, axis=-1)[..., None] * np.eye(mean.shape[-1]))


class Bones(NamedTuple):
    """Skeleton of J joints with its bone limits, in the form that kernels take."""

    kinds = "b1 i1 i1 i1 f1"
    core: Mask
    """(J,) mask of the core joints."""
    order: Index
    """(J,) all joints, parents first."""
    parents: Index
    """(J,) parent of each joint, -1 for the root."""
    hips: Index
    """(2,) right and left hip."""
    longest_m: Array
    """(J,) maximum distance of each joint from its parent, metres; unused for the root."""

    @classmethod
    def of(cls, skeleton: Skeleton, longest_m: Array) -> "Bones":
        """The bones of a detector's skeleton."""
        core, order = (
            np.zeros(len(skeleton), dtype=bool),
            np.concatenate(skeleton.tree_levels).astype(np.intp),
        )
        core[list(skeleton.core)] = True
        return cls(
            core,
            order,
            np.array(skeleton.parents),
            np.array(skeleton.hips),
            np.array(longest_m, dtype=float),
        )


def predicted(
    joints: JointStates, step_s: float, motion: Motion, density: Array, bones: Bones
) -> tuple[JointStates, Mask]:
    """Predict joints `step_s` later by a motion model with noise density `density` (J,); also which
    (A, J) are lost.

    A negative step predicts backwards. The velocity of an unseen joint decays to the person's
    velocity. Lost joints are placed at their parents, with a sigma from the bone's length; a lost
    root between the hips.
    """
    mean, covariance = np.empty_like(joints.mean), np.empty_like(joints.covariance)
    lost, room = np.empty(mean.shape[:2], dtype=bool), np.empty((2, mean.shape[2]))
    F, noise = _step(motion, step_s)
    decay = float(np.exp(-abs(step_s) / _FOLLOW_S))
    _predict(
        joints.mean,
        joints.covariance,
        F,
        noise,
        density,
        decay,
        bones,
        room,
        mean,
        covariance,
        lost,
    )
    return JointStates(mean, covariance), lost


@lru_cache(256)
def _step(motion: Motion, step_s: float) -> tuple[Array, Array]:
    return motion.step(step_s, 1.0)


@part
def sigma(P):
    """`JointStates.sigma_m` for the covariance of one joint."""
    return np.sqrt((P[0, 0] + P[1, 1] + P[2, 2]) / 3)


@part
def _across(P):
    """Standard deviation of the position across the viewing ray of a joint that one view sees,
    metres. An axis that is much less certain than the others drops out; for an isotropic covariance
    it equals `sigma`.
    """
    pairs = P[0, 0] * P[1, 1] + P[0, 0] * P[2, 2] + P[1, 1] * P[2, 2]
    pairs -= P[0, 1] * P[1, 0] + P[0, 2] * P[2, 0] + P[1, 2] * P[2, 1]
    return np.sqrt(pairs / (P[0, 0] + P[1, 1] + P[2, 2]))


@kernel("f3 f4 f2 f2 f1 f0", Bones, "f2 f3 f4 b2")
def _predict(
    mean, covariance, F, noise, density, decay, bones, room, mean_after, covariance_after, lost
):
    """Predict all joints: F m and F P F^T + q Q, with F and Q (n, n) per axis; `room` (2, S) is
    workspace.
    """
    people, joints, size = mean.shape
    half, moving, core, order, parents = room[0], room[1], bones.core, bones.order, bones.parents
    right, left, velocity = bones.hips[0], bones.hips[1], np.empty(3)
    for a in range(people):
        # Without information the velocity is 0; else the joint would drift along a ray.
        certain = 1 / KNOWN_M**2
        velocity[0] = velocity[1] = velocity[2] = 0.0
        for j in range(joints):
            if core[j]:
                certainty = 1 / sigma(covariance[a, j]) ** 2
                certain += certainty
                for x in range(3):
                    velocity[x] += certainty * mean[a, j, 3 + x]
        any_placed = False
        for j in range(joints):
            unseen, was_m = sigma(covariance[a, j]) > WELL_SEEN_M, _across(covariance[a, j])
            for k in range(size):
                moving[k] = mean[a, j, k]
            if unseen:
                for x in range(3):
                    common = velocity[x] / certain
                    moving[3 + x] = common + decay * (moving[3 + x] - common)
                for k in range(6, size):
                    moving[k] *= decay
            for row in range(size):
                total = 0.0
                for k in range(row % 3, size, 3):
                    total += F[row // 3, k // 3] * moving[k]
                mean_after[a, j, row] = total
                for column in range(size):
                    half[column] = 0.0
                    for k in range(row % 3, size, 3):
                        half[column] += F[row // 3, k // 3] * covariance[a, j, k, column]
                for column in range(row + 1):
                    total = (
                        density[j] * noise[row // 3, column // 3] if row % 3 == column % 3 else 0.0
                    )
                    for k in range(column % 3, size, 3):
                        total += half[k] * F[column // 3, k // 3]
                    covariance_after[a, j, row, column] = covariance_after[a, j, column, row] = (
                        total
                    )
            lost[a, j] = _across(covariance_after[a, j]) > LOST_M and was_m > KNOWN_M
            any_placed = any_placed or (core[j] and not lost[a, j])
        for j in order:
            lost[a, j] = lost[a, j] and any_placed  # else no parent is placed
            if lost[a, j]:
                _put_beside(
                    mean_after[a],
                    covariance_after[a],
                    j,
                    parents[j],
                    right,
                    left,
                    bones.longest_m[j],
                )


@part
def _put_beside(mean, covariance, j, above, right, left, longest_m):
    """Place joint `j` of a person's states (J, S) at its parent."""
    size = mean.shape[1]
    for i in range(size):
        mean[j, i] = mean[above, i] if above >= 0 else (mean[right, i] + mean[left, i]) / 2
        for k in range(size):
            if above < 0:
                covariance[j, i, k] = (covariance[right, i, k] + covariance[left, i, k]) / 2
            else:
                covariance[j, i, k] = 0.0 if (i < 3) != (k < 3) else covariance[above, i, k]
        if above >= 0:
            # Standard deviation along an unknown direction.
            covariance[j, i, i] += (longest_m / 1.5) ** 2 if i < 3 else 1.0
