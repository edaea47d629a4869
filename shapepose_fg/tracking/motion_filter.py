"""Where joints are, how fast they move and how surely: a Kalman filter, batched over people and joints."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from factors import Motion
from shapepose_fg.core.arrays import Array, Index, Mask
from shapepose_fg.core.compiled import kernel, part
from shapepose_fg.core.rows import Rows
from shapepose_fg.core.skeleton import Skeleton

LOST_M = 0.2
"""A joint whose predicted place has a larger sigma is lost: it is sought around its parent on the skeleton. A
joint that one view sees is not, however far along the ray it may be."""
TRUSTED_M = 0.1
"""A joint with a smaller sigma is judged by the length of its bones, and is not lost in the next frame, however
long that is in coming: at 10 frames a second the velocity of a new person's joints alone makes it uncertain by 20
cm."""
_FOLLOW_S = 0.25
"""Time constant with which the velocity of an unseen joint becomes that of the person."""
_FOLLOW_SIGMA_M = 0.05
"""Sigma from which on a joint counts as unseen in this sense."""


@dataclass(frozen=True)
class JointStates(Rows):
    """States of A people's J joints, a Gaussian each: position and n - 1 derivatives (`factors.Motion`)."""

    mean: Array
    """(A, J, 3 n) position, metres in the world, velocity, metres per second, and so on."""
    covariance: Array
    """(A, J, 3 n, 3 n) its covariance."""

    @property
    def position(self) -> Array:
        """(A, J, 3) metres."""
        return self.mean[..., :3]

    @property
    def velocity(self) -> Array:
        """(A, J, 3) metres per second."""
        return self.mean[..., 3:6]

    @property
    def sigma_m(self) -> Array:
        """(A, J) standard deviation of the position, root mean square over the axes, metres."""
        return np.sqrt(np.trace(self.covariance[..., :3, :3], axis1=-2, axis2=-1) / 3)

    @classmethod
    def at(cls, position: Array, sigma_m: Array, start: Sequence[float]) -> "JointStates":
        """People at `position` (A, J, 3), known to `sigma_m` (A, J), whose derivatives are 0, known to `start`."""
        mean = np.concatenate([position, *[np.zeros_like(position)] * len(start)], axis=-1)
        sigma = np.stack([sigma_m, *(np.full_like(sigma_m, each) for each in start)], axis=-1)
        return cls(mean, np.repeat(sigma**2, 3, axis=-1)[..., None] * np.eye(mean.shape[-1]))


class Bones(NamedTuple):
    """A skeleton of J joints, and how people are made, as kernels take them."""

    kinds = "b1 i1 i1 i1 f1"
    core: Mask
    """(J,) the core joints."""
    order: Index
    """(J,) all joints, parents first."""
    parents: Index
    """(J,) -1 for the root."""
    hips: Index
    """(2,) right and left."""
    longest_m: Array
    """(J,) the longest distance of a joint to its parent, metres; the root's counts nothing."""

    @classmethod
    def of(cls, skeleton: Skeleton, longest_m: Array) -> "Bones":
        """A detector's."""
        core, order = np.zeros(len(skeleton), dtype=bool), np.concatenate(skeleton.tree_levels).astype(np.intp)
        core[list(skeleton.core)] = True
        return cls(
            core, order, np.array(skeleton.parents), np.array(skeleton.hips), np.array(longest_m, dtype=float)
        )


def predicted(
    joints: JointStates, step_s: float, motion: Motion, density: Array, bones: Bones
) -> tuple[JointStates, Mask]:
    """Joints `step_s` later, by a model of motion with noise of this `density` (J,); and which (A, J) are lost.

    A negative step predicts into the past. An unseen joint comes to move as the person does, straight on. Lost
    joints are put where their parents are, known to a bone's length; a lost root between its hips.
    """
    mean, covariance = np.empty_like(joints.mean), np.empty_like(joints.covariance)
    lost, room = np.empty(mean.shape[:2], dtype=bool), np.empty((2, mean.shape[2]))
    F, noise = _step(motion, step_s)
    decay = float(np.exp(-abs(step_s) / _FOLLOW_S))
    _predict(joints.mean, joints.covariance, F, noise, density, decay, bones, room, mean, covariance, lost)
    return JointStates(mean, covariance), lost


@lru_cache(256)
def _step(motion: Motion, step_s: float) -> tuple[Array, Array]:
    return motion.step(step_s, 1.0)


@part
def sigma(P):
    """`JointStates.sigma_m` of one joint's covariance."""
    return np.sqrt((P[0, 0] + P[1, 1] + P[2, 2]) / 3)


@part
def _across(P):
    """Standard deviation of the position across the ray of a joint that one view sees, metres: an axis that is
    known much worse than the others drops out, and where all are alike it is `sigma`.
    """
    pairs = P[0, 0] * P[1, 1] + P[0, 0] * P[2, 2] + P[1, 1] * P[2, 2]
    pairs -= P[0, 1] * P[1, 0] + P[0, 2] * P[2, 0] + P[1, 2] * P[2, 1]
    return np.sqrt(pairs / (P[0, 0] + P[1, 1] + P[2, 2]))


@kernel("f3 f4 f2 f2 f1 f0", Bones, "f2 f3 f4 b2")
def _predict(mean, covariance, F, noise, density, decay, bones, room, mean_after, covariance_after, lost):
    """F m and F P F^T + q Q of all joints, with F and Q (n, n) for each axis; `room` (2, S) is for work."""
    people, joints, size = mean.shape
    half, moving, core, order, parents = room[0], room[1], bones.core, bones.order, bones.parents
    right, left, velocity = bones.hips[0], bones.hips[1], np.empty(3)
    for a in range(people):
        # What nothing is known of stands still: it must not drift along a ray.
        certain = 1 / TRUSTED_M**2
        velocity[0] = velocity[1] = velocity[2] = 0.0
        for j in range(joints):
            if core[j]:
                certainty = 1 / sigma(covariance[a, j]) ** 2
                certain += certainty
                for x in range(3):
                    velocity[x] += certainty * mean[a, j, 3 + x]
        any_placed = False
        for j in range(joints):
            unseen, was_m = sigma(covariance[a, j]) > _FOLLOW_SIGMA_M, _across(covariance[a, j])
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
                    total = density[j] * noise[row // 3, column // 3] if row % 3 == column % 3 else 0.0
                    for k in range(column % 3, size, 3):
                        total += half[k] * F[column // 3, k // 3]
                    covariance_after[a, j, row, column] = covariance_after[a, j, column, row] = total
            lost[a, j] = _across(covariance_after[a, j]) > LOST_M and was_m > TRUSTED_M
            any_placed = any_placed or (core[j] and not lost[a, j])
        for j in order:
            lost[a, j] = lost[a, j] and any_placed  # beside whom would they be sought?
            if lost[a, j]:
                _put_beside(mean_after[a], covariance_after[a], j, parents[j], right, left, bones.longest_m[j])


@part
def _put_beside(mean, covariance, j, above, right, left, longest_m):
    """A joint where its parent is, of a person's states (J, S)."""
    size = mean.shape[1]
    for i in range(size):
        mean[j, i] = mean[above, i] if above >= 0 else (mean[right, i] + mean[left, i]) / 2
        for k in range(size):
            if above < 0:
                covariance[j, i, k] = (covariance[right, i, k] + covariance[left, i, k]) / 2
            else:
                covariance[j, i, k] = 0.0 if (i < 3) != (k < 3) else covariance[above, i, k]
        if above >= 0:
            # The sigma of a direction that is not known.
            covariance[j, i, i] += (longest_m / 1.5) ** 2 if i < 3 else 1.0
