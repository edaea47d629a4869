"""Rows of people over time as chains: how they are cut, the motion prior along them, their linear systems."""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from shapepose_fg.body.model.rotation import log_so3, right_jacobian_inverse

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Segment:
    """Rows of one person that follow each other."""

    rows: NDArray[np.intp]
    """(T,) in the order of time."""
    kept: NDArray[np.bool_]
    """(T,) whether a row belongs to this segment; the others overlap with the one before or after."""
    group: int
    """Whose."""


def cut_segments(
    rows: NDArray[np.intp],
    group: NDArray[np.intp],
    time_s: Array,
    *,
    gap_s: float,
    length: int,
    overlap: int,
) -> list[Segment]:
    """The `rows` (R,), of so many people `group` (B,) at the times `time_s` (B,), as segments.

    A gap of more than `gap_s` ends a chain; one of more than `length` rows is cut, with so many rows `overlap` on
    either side. ValueError where one person has two rows at one time.
    """
    order = rows[np.lexsort((time_s[rows], group[rows]))]
    same, step = np.diff(group[order]) == 0, np.diff(time_s[order])
    if (same & (step <= 0)).any():
        twice = order[1:][same & (step <= 0)][0]
        raise ValueError(f"group {group[twice]} has two rows at {time_s[twice]} s: give one row a time")
    segments = []
    for chain in np.split(order, np.flatnonzero(~same | (step > gap_s)) + 1):
        for start in range(0, len(chain), length) if len(chain) > 0 else ():
            first, stop = max(start - overlap, 0), min(start + length + overlap, len(chain))
            place = np.arange(first, stop)
            kept = (place >= start) & (place < start + length)
            segments.append(Segment(chain[first:stop], kept, int(group[chain[0]])))
    return segments


class Motion:
    """`MotionPrior` along G chains of up to T rows of N numbers, as a part of a least-squares problem.

    The root's rotation moves in tangents of the world, exp(delta) R, in which its coupling is as diagonal as that
    of the other numbers, up to the turn from frame to frame; its gradient is exact.
    """

    diagonal: Tensor
    """(T, G, N) of half the Hessian: couplings of one number with itself only."""
    next_one: Tensor
    """(T, G, N) coupling of a row with the next."""
    next_two: Tensor
    """(T, G, N) coupling of a row with the one after."""

    def __init__(self, acceleration: Array, velocity: Array, step_s: Tensor):
        """Densities (N,) as in `MotionPrior`; `step_s` (T - 1, G) seconds from row to row, infinite past the end.

        T is 2 or more: a single row is one with nothing after it.
        """
        real = step_s.isfinite()
        self._rate = torch.where(real, 1 / step_s, 0.0)[..., None]
        slow = torch.where(real, step_s, 0.0)[..., None] / torch.from_numpy(velocity)
        pair = torch.where(real[1:], (step_s[1:] + step_s[:-1]) / 2, 1.0)[..., None]
        smooth = real[1:, :, None] / (pair * torch.from_numpy(acceleration))
        edge = torch.zeros_like(slow[:1])
        # In velocities the prior is tridiagonal, slow v² + smooth (v_next - v)²; in rows it is V^T M V, with their
        # differences V.
        self._own = slow + torch.cat((edge, smooth)) + torch.cat((smooth, edge))
        self._slow, self._smooth = slow, smooth
        own = self._rate.square() * self._own
        across = self._rate[:-1] * self._rate[1:] * -smooth  # v_k with v_k+1
        self.diagonal = torch.cat((edge, own)) + torch.cat((own, edge))
        self.diagonal[1:-1] -= 2 * across
        one = -own.clone()
        one[1:] += across
        one[:-1] += across
        self.next_one = torch.cat((one, edge))
        self.next_two = torch.cat((-across, edge, edge))[: len(self.diagonal)]

    def at(self, root: Tensor, others: Tensor) -> tuple[Tensor, Tensor]:
        """Energy (G,) in squared standard deviations, and half its gradient (T, G, N).

        At rotations of the root (T, G, 3, 3) and everything else (T, G, N - 3), double precision.
        """
        turn = log_so3(root[1:] @ root[:-1].mT)
        v = self._rate * torch.cat((turn, others[1:] - others[:-1]), -1)
        change = v[1:] - v[:-1]
        energy = (self._slow * v.square()).sum((0, 2)) + (self._smooth * change.square()).sum((0, 2))
        force = self._own * v
        force[:-1] += -self._smooth * v[1:]
        force[1:] += -self._smooth * v[:-1]
        force = self._rate * force
        after, before = force.clone(), force.clone()
        inverse = right_jacobian_inverse(turn)
        # log(exp(d) R_t+1 R_tᵀ) = a + Jl^-1 d, and log(R_t+1 R_tᵀ exp(-d)) = a - Jr^-1 d.
        after[..., :3] = (inverse @ force[..., :3, None]).squeeze(-1)
        before[..., :3] = (inverse.mT @ force[..., :3, None]).squeeze(-1)
        edge = torch.zeros_like(v[:1])
        return energy, torch.cat((edge, after)) - torch.cat((before, edge))


def solve_banded(diagonal: Tensor, next_one: Tensor, next_two: Tensor, right: Tensor) -> Tensor:
    """X (T, G, N, K) with H X = `right`, for G symmetric positive definite H of T blocks each.

    Block elimination along the chain: time and memory grow with T, not with its square. A chain that is shorter
    than T has identity blocks and no coupling at its end.

    Parameters
    ----------
    diagonal: (T, G, N, N) blocks H_tt; is overwritten.
    next_one: (T, G, N) diagonal of H_t,t+1, which is a diagonal matrix; of the last row nothing is used.
    next_two: (T, G, N) the same of H_t,t+2.
    right: (T, G, N, K); is overwritten.
    """
    T, _, N, _ = diagonal.shape
    lower, upper = [], []
    coupling = torch.diag_embed(next_one[0])
    for t in range(T):
        factor = torch.linalg.cholesky_ex(diagonal[t])[0]
        beyond = torch.diag_embed(next_two[t])
        solved = torch.linalg.solve_triangular(factor, torch.cat((coupling, beyond, right[t]), -1), upper=False)
        right[t] = solved[..., 2 * N :]
        lower.append(factor)
        upper.append(solved[..., : 2 * N])
        if t + 1 < T:
            fill = solved[..., : 2 * N].mT @ solved
            diagonal[t + 1] -= fill[:, :N, :N]
            right[t + 1] -= fill[:, :N, 2 * N :]
            coupling = torch.diag_embed(next_one[t + 1]) - fill[:, :N, N : 2 * N]
        if t + 2 < T:
            diagonal[t + 2] -= fill[:, N:, N : 2 * N]
            right[t + 2] -= fill[:, N:, 2 * N :]
    nothing = torch.zeros_like(right[0])
    for t in range(T - 1, -1, -1):
        ahead = [right[s] if s < T else nothing for s in (t + 1, t + 2)]
        rest = right[t] - upper[t] @ torch.cat(ahead, -2)
        right[t] = torch.linalg.solve_triangular(lower[t].mT, rest, upper=True)
    return right
