"""The pose prior as an energy of the angles that keypoints can see, batched: value, gradient, Hessian."""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from shapepose_fg.body.fitting.pose_prior import NUM_ANGLES, PosePrior


@dataclass(frozen=True)
class PosePull:
    """The pose energy at the angles of B rows, and how it pulls them."""

    energy: Tensor
    """(B,) -2 log density, 0 or more."""
    gradient: Tensor
    """(B, A) half the gradient, exact."""
    hessian: Tensor
    """(B, A, A) half the Gauss-Newton Hessian, positive definite."""


class PoseEnergy:
    """-2 log of the prior's marginal density over the visible angles, shifted to be 0 or more.

        E(theta) = -2 log sum_k exp(c_k - |theta - mean_k|²_Pk / 2) + 2 log sum_k exp(c_k)

    with c_k = log w_k + log det P_k / 2. With r_k the share of component k in the sum, half the gradient is
    sum_k r_k P_k (theta - mean_k), and sum_k r_k P_k stands for half the Hessian: what it leaves out, minus the
    covariance of the components' pulls, is negative. (The same surrogate lies above E: expectation maximisation.)
    One component is a Gaussian, E its squared Mahalanobis distance.
    """

    def __init__(self, prior: PosePrior, angles: np.ndarray, dtype: torch.dtype):
        """For the visible `angles` (A,), places among the 69, computing in `dtype`."""
        hidden = np.setdiff1d(np.arange(NUM_ANGLES), angles)
        precisions = prior.marginal_precisions(angles)
        constant = np.log(prior.weights) + 0.5 * np.linalg.slogdet(precisions)[1]

        def tensor(array: np.ndarray) -> Tensor:
            return torch.from_numpy(np.ascontiguousarray(array)).to(dtype)

        self._means = tensor(prior.means[:, None, angles])  # (K, 1, A)
        self._precisions = tensor(precisions)  # (K, A, A)
        self._constant = tensor(constant - constant.max())  # (K,)
        self._floor = 2 * torch.logsumexp(self._constant, 0)
        gains = prior.regressions(angles, hidden)  # (K, M, A)
        at_zero = prior.means[:, hidden] - np.einsum("kma,ka->km", gains, prior.means[:, angles])
        self._gains, self._at_zero = tensor(gains), tensor(at_zero)

    def __call__(self, angles: Tensor) -> PosePull:
        """Energy, gradient and Hessian at visible angles (B, A)."""
        distance, pulls = self._distances(angles)
        share, energy = self._shares(distance)
        gradient = (share[..., None] * pulls).sum(0)
        return PosePull(energy, gradient, self._mixed(share, self._precisions))

    def around(self, anchor: Tensor, angles: Tensor) -> PosePull:
        """The quadratic with its minimum at `anchor` (B, A) and the Hessian of there, at `angles` (B, A)."""
        share, error = self._shares_at(anchor), angles - anchor
        gradient = (share[..., None] * (error @ self._precisions)).sum(0)
        return PosePull((gradient * error).sum(-1), gradient, self._mixed(share, self._precisions))

    def hidden(self, angles: Tensor) -> Tensor:
        """(B, M) what the prior expects of the invisible angles: its regressions, weighted by the shares."""
        share = self._shares_at(angles)
        return (share[..., None] * (angles @ self._gains.mT)).sum(0) + share.T @ self._at_zero

    def _shares_at(self, angles: Tensor) -> Tensor:
        """Share (K, B) of every component."""
        if len(self._constant) == 1:
            return angles.new_ones(1, len(angles))
        return self._shares(self._distances(angles)[0])[0]

    def _distances(self, angles: Tensor) -> tuple[Tensor, Tensor]:
        """Squared Mahalanobis distance (K, B) to every component and its pull P_k (theta - mean_k) (K, B, A)."""
        error = angles - self._means
        pulls = error @ self._precisions
        return (pulls * error).sum(-1), pulls

    def _shares(self, distance: Tensor) -> tuple[Tensor, Tensor]:
        """Share (K, B) of every component, and the energy (B,)."""
        log_density = self._constant[:, None] - 0.5 * distance
        return torch.softmax(log_density, 0), self._floor - 2 * torch.logsumexp(log_density, 0)

    @staticmethod
    def _mixed(share: Tensor, matrices: Tensor) -> Tensor:
        """(B, I, J) the mean of `matrices` (K, I, J) with the weights `share` (K, B)."""
        if len(matrices) == 1:
            return matrices.expand(share.shape[1], -1, -1)
        return (share.T @ matrices.flatten(1)).unflatten(1, matrices.shape[1:])
