"""How surely a fitted body knows each joint, with and without that joint's own target."""

from dataclasses import dataclass

import torch
from torch import Tensor

from shapepose_fg.body.model.small_matrices import inverse_3x3


@dataclass(frozen=True)
class JointPosterior:
    """Gaussian beliefs about the joints of B bodies around their fitted place (Laplace)."""

    covariance: Tensor
    """(B, K, 3, 3) A_i = J_i H^-1 J_iᵀ: given all targets, m²."""
    left_out_xyz: Tensor
    """(B, K, 3) place of each joint without its own target, metres."""
    left_out_covariance: Tensor
    """(B, K, 3, 3) and its covariance, m²."""


LIMB_M = 0.4
"""Radius on which the end of a swinging limb moves, for the curvature that a linearisation leaves out.

Chosen so that hidden wrists, arms and legs of held-out motions lie where their covariance says."""


def joint_posterior(xyz: Tensor, half: Tensor, residual: Tensor, root: Tensor) -> JointPosterior:
    """Take each joint's own target out of the posterior again (the cavity), to first order.

    With A_i the joint's posterior and L_i = S_i² its target's information, the belief without the target is

        C_i = (A_i^-1 - L_i)^-1 = A_i + A_i S_i (I - S_i A_i S_i)^-1 S_i A_i
        c_i = x_i - C_i L_i (z_i - x_i)

    where the second form of C_i needs no inverse of A_i or L_i: L_i may be singular (a ray) or zero, and
    S_i A_i S_i < I because the priors are proper.

    To first order a limb that may swing moves in a plane; in truth on a sphere. Where A_i is large, the sag
    tr(A_i) / (2 LIMB_M) is added as a sigma along every axis: a hidden wrist is not a thin disc.

    Parameters
    ----------
    xyz: (B, K, 3) x_i, metres.
    half: (B, P, 3 K) G^-1 J^T with G G^T the Hessian, so that A_i is its block i squared.
    residual: (B, K, 3) x_i - z_i, metres.
    root: (B, K, 3, 3) S_i, symmetric, robust weight included, 1/m.
    """
    blocks = half.mT.unflatten(1, (-1, 3))  # (B, K, 3, P)
    A = blocks @ blocks.mT
    AS = A @ root
    remainder = torch.eye(3, dtype=A.dtype) - _symmetric(root @ AS)
    C = A + _symmetric(AS @ inverse_3x3(remainder) @ AS.mT)
    pull = root @ (root @ residual[..., None])
    sag = torch.diagonal(A, dim1=-2, dim2=-1).sum(-1) / (2 * LIMB_M)
    curvature = sag.square()[..., None, None] * torch.eye(3, dtype=A.dtype)
    return JointPosterior(A + curvature, xyz + (C @ pull).squeeze(-1), C + curvature)


def _symmetric(matrix: Tensor) -> Tensor:
    return (matrix + matrix.mT) / 2
