"""Posteriors of passes: joints, with and without their own targets, and pooled shapes."""

from dataclasses import dataclass

import numpy as np

from shapepose_fg.body.fitting.energy import Evaluated, Held
from shapepose_fg.core.arrays import Array, Index, Mask
from shapepose_fg.core.rows import Rows


@dataclass(frozen=True)
class JointPosterior(Rows):
    """Posterior of the joints in B passes."""

    free: Array
    """(B, P) parameters of the body."""
    xyz: Array
    """(B, J, 3) joints, metres."""
    covariance: Array
    """(B, N, 3, 3) covariances of the joints asked for (`Passes.asked`), m² (Laplace)."""
    squared: Array
    """(B, J) squared Mahalanobis distance of each joint to its target."""
    left: Array
    """(B,) predicted decrease of the energy by a further Newton step."""

    @classmethod
    def of(cls, body: Evaluated) -> "JointPosterior":
        """Build it from evaluated bodies, with systems for the joints asked for."""
        return cls(body.free, body.xyz, body.covariances()[0], body.squared, body.left)


def pooled_betas(alone: Array, precision: Array, pool: Index, votes: Mask, held: Held) -> Array:
    """Pooled shapes (B, 10) of the rows of each `pool` (B,), to first order; single rows keep their
    own.

    A row's fit is a Gaussian over its betas: `precision` S (B, 10, 10) around the shape `alone` (B,
    10). Subtracting each row's prior leaves its measurements, so that a pool's prior counts once,
    not once per row:

        (W + sum_i (S_i - W)) b = W c + sum_i (S_i b_i - W c_i)

    with W the stiffness and c_i the prior centre of row i. Well observed bone lengths dominate.
    Rows that do not contribute (B,) take the shape of the others.
    """
    eye = held.stiffness[:, None, None] * np.eye(10)
    centre = held.betas
    own = precision - eye
    said = (precision @ alone[..., None] - eye @ centre[..., None])[..., 0]
    _, place = np.unique(pool, return_inverse=True)
    size = np.bincount(place, weights=votes)
    count = np.maximum(size, 1)

    def summed(values: Array) -> Array:
        total = np.zeros((len(size), *values.shape[1:]))
        np.add.at(total, place[votes], values[votes])
        return total

    mean_centre = summed(centre) / count[:, None]
    weight = summed(eye) / count[:, None, None]
    weight[size == 0] = np.eye(10)
    right = (weight @ mean_centre[..., None])[..., 0] + summed(said)
    betas = np.linalg.solve(weight + summed(own), right[..., None])[place, :, 0]
    return np.where(shared(pool, votes)[:, None], betas, alone)


def shared(pool: Index, votes: Mask) -> Mask:
    """(B,) rows that take a shape to which other rows of their `pool` (B,) contribute."""
    _, place = np.unique(pool, return_inverse=True)
    return np.asarray(np.bincount(place, weights=votes)[place] - votes > 0)
