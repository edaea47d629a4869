"""What fits say: of joints, given all targets and without each joint's own; and of shapes, rows put together."""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from shapepose_fg.body.fitting.energy import Evaluated, Held, factored
from shapepose_fg.body.fitting.fitter import Rows
from shapepose_fg.body.fitting.left_out import Passes
from shapepose_fg.core.arrays import Array, Index, Mask

LIMB_M = 0.4
"""Radius on which the end of a swinging limb moves, for the curvature that a linearisation leaves out.

Chosen so that hidden wrists, arms and legs of held-out motions lie where their covariance says."""


@dataclass(frozen=True)
class JointPosterior(Rows):
    """What B passes say of their joints."""

    free: Array
    """(B, P) parameters of the body."""
    xyz: Array
    """(B, J, 3) joints, metres."""
    covariance: Array
    """(B, N, 3, 3) of the joints that were asked for (`Passes.asked`), m² (Laplace)."""
    squared: Array
    """(B, J) squared Mahalanobis distance of each joint to its target."""
    left: Array
    """(B,) by how much a Newton step would still lower the energy."""

    @classmethod
    def of(cls, body: Evaluated, asked: Index) -> "JointPosterior":
        """From bodies and the joints (B, N) whose covariance is asked for."""
        by_joint = body.jacobian.unflatten(1, (-1, 3))
        if asked.shape[1] == by_joint.shape[1]:  # with all targets: in double precision
            covariance = joint_covariance(factored(body.here.hessian.double()), by_joint.double())
        else:
            rows = torch.arange(len(asked))[:, None]
            covariance = joint_covariance(body.factor, by_joint[rows, torch.from_numpy(asked)])
        parts = (body.free, body.here.xyz, covariance, body.here.squared, body.left)
        return cls(*(part.double().numpy() for part in parts))

    @classmethod
    def concatenated(cls, parts: "list[JointPosterior]") -> "JointPosterior":
        """The rows of all, in order."""
        return cls(*map(np.concatenate, zip(*(vars(part).values() for part in parts), strict=True)))


def joint_covariance(factor: Tensor, jacobian: Tensor) -> Tensor:
    """(B, N, 3, 3) covariance A_i = J_i H^-1 J_iᵀ of joints around their fitted places (Laplace), m².

    To first order a limb that may swing moves in a plane; in truth on a sphere. Where A_i is large, the sag
    tr(A_i) / (2 LIMB_M) is added as a sigma along every axis: a hidden wrist is not a thin disc.

    Parameters
    ----------
    factor: (B, P, P) lower Cholesky factor of the Hessian H.
    jacobian: (B, N, 3, P) J_i, of some or all joints.
    """
    half = torch.linalg.solve_triangular(factor, jacobian.flatten(1, 2).mT, upper=False)
    blocks = half.mT.unflatten(1, (-1, 3))
    A = blocks @ blocks.mT
    sag = torch.diagonal(A, dim1=-2, dim2=-1).sum(-1) / (2 * LIMB_M)
    A = (A + A.mT) / 2  # to the last digit: products of single precision are not
    return A + sag.square()[..., None, None] * torch.eye(3, dtype=A.dtype)


def left_out_places(
    passes: Passes, found: JointPosterior, left_out: JointPosterior | None = None
) -> tuple[Array, Array]:
    """Place (R, J, 3) and covariance (R, J, 3, 3) of each joint in the pass that never saw its targets."""
    if left_out is None:
        return found.xyz, found.covariance
    R, J = passes.source.shape
    xyz = np.concatenate([found.xyz, left_out.xyz])[passes.source, np.arange(J)]
    covariance, index = found.covariance.copy(), np.arange(R, len(passes.row))
    asked = passes.asked(index)
    wanted = np.take_along_axis(passes.without[index], asked, axis=1)  # not what only fills up a smaller set
    row = np.broadcast_to(passes.row[index, None], asked.shape)
    covariance[row[wanted], asked[wanted]] = left_out.covariance[wanted]
    return xyz, covariance


def shape_precision(factor: Tensor) -> Tensor:
    """(B, 10, 10) what each row by itself knows of its betas, from the Cholesky factor (B, P, P) of its Hessian.

    The Schur complement: the inverse of the betas' block of the Hessian's inverse.
    """
    by_betas = torch.eye(factor.shape[-1], 10, dtype=factor.dtype).expand(len(factor), -1, -1)
    half = torch.linalg.solve_triangular(factor, by_betas, upper=False)
    return torch.linalg.inv(half.mT @ half)


def pooled_betas(alone: Tensor, precision: Tensor, pool: Index, votes: Mask, held: Held) -> Tensor:
    """Shapes (B, 10) at which the rows of each `pool` (B,) agree best, to first order; single rows keep their own.

    A row's fit is a Gaussian over its betas: `precision` S (B, 10, 10) around the shape `alone` (B, 10). Taken out
    of it, what the row was held by leaves what its joints said, so that what a pool was held by counts once, not
    once a row:

        (W + sum_i (S_i - W)) b = W c + sum_i (S_i b_i - W c_i)

    with W the stiffness and c_i where row i was held. Bone lengths that were well seen decide. Rows that do not
    vote (B,) take the shape of the others.
    """
    eye = held.stiffness[..., None] * torch.eye(10)
    centre = held.betas.expand(len(alone), 10)
    own = precision - eye
    said = (precision @ alone[..., None] - eye @ centre[..., None]).squeeze(-1)
    _, place = np.unique(pool, return_inverse=True)
    size = np.bincount(place, weights=votes)
    index, used = torch.from_numpy(place), torch.from_numpy(votes)
    count = torch.from_numpy(np.maximum(size, 1)).to(alone.dtype)

    def summed(values: Tensor) -> Tensor:
        zeros = values.new_zeros(len(size), *values.shape[1:])
        return zeros.index_add_(0, index[used], values[used])

    mean_centre = summed(centre) / count[:, None]
    weight = summed(eye.expand_as(own)) / count[:, None, None]
    weight[torch.from_numpy(size == 0)] = torch.eye(10, dtype=weight.dtype)
    right = (weight @ mean_centre[..., None]).squeeze(-1) + summed(said)
    betas = torch.linalg.solve(weight + summed(own), right)[index]
    return torch.where(shared(pool, votes)[:, None], betas, alone)


def shared(pool: Index, votes: Mask) -> Tensor:
    """(B,) which rows take a shape that others of their `pool` (B,) have a part in."""
    _, place = np.unique(pool, return_inverse=True)
    return torch.from_numpy((np.bincount(place, weights=votes)[place] - votes) > 0)
