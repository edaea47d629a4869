"""Rows of people over time as chains: how they are cut, the motion prior along them, their linear systems."""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from factors import Motion
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


class Links:
    """`MotionPrior` along G chains of up to T rows of N numbers, as a part of a least-squares problem.

    A model of motion of order n (`factors.Motion`) links n + 1 rows that follow each other: how the last
    derivative of a state goes on, the derivatives being differences of rows. The root's rotation moves in tangents
    of the world, exp(delta) R, in which its coupling is as diagonal as that of the other numbers, up to the turn
    from frame to frame; its gradient is exact.
    """

    diagonal: Tensor
    """(T, G, N) of half the Hessian: couplings of one number with itself only."""
    beyond: Tensor
    """(T, G, N, n) coupling of a row with the next, the one after, and so on."""

    def __init__(self, law: Motion, acceleration: Array, velocity: Array, step_s: Tensor):
        """Densities (N,) as in `MotionPrior`; `step_s` (T - 1, G) seconds from row to row, infinite past the end.

        T is n or more: a single row is one with nothing after it.
        """
        real = step_s.isfinite()
        self._rate = torch.where(real, 1 / step_s, 0.0)[..., None]
        self._slow = torch.where(real, step_s, 0.0)[..., None] / torch.from_numpy(velocity)
        # What goes on: the derivative of this order in velocities v_k, v_k+1, ..., weighted.
        gaps, weights = step_s, [torch.ones_like(step_s)[..., None]]
        for order in range(2, law.order + 1):
            gaps = (gaps[1:] + gaps[:-1]) / 2
            gaps = torch.where(gaps.isfinite(), gaps, 1.0)
            last = order == law.order
            lasts = torch.from_numpy(law.transition(gaps.numpy())[..., -1, -1]) if last else 1.0 + 0 * gaps
            width = (1.0 + 0 * gaps if last else gaps)[..., None]
            none = 0 * weights[0]
            pairs = zip([*weights, none], [none, *weights], strict=True)
            weights = [(after[1:] - lasts[..., None] * here[:-1]) / width for here, after in pairs]
        self._weights, n = weights, law.order
        noise = torch.from_numpy(law.noise(gaps.numpy()[..., None], law.density(acceleration))[..., -1, -1])
        self._smooth = real[n - 1 :, :, None] / noise
        # In velocities the prior is banded: slow v² + smooth (weights v)².
        self._bands = [self._slow.clone(), *(0 * self._slow[k:] for k in range(1, n))]
        for i in range(n - 1, -1, -1):
            for k in range(n - i):
                part = slice(i, i + len(self._smooth))
                self._bands[k][part] += self._smooth * weights[i] * weights[i + k]
        self.diagonal, *beyond = self._couplings()
        self.beyond = torch.stack(beyond, -1)

    def at(self, root: Tensor, others: Tensor) -> tuple[Tensor, Tensor]:
        """Energy (G,) in squared standard deviations, and half its gradient (T, G, N).

        At rotations of the root (T, G, 3, 3) and everything else (T, G, N - 3), double precision.
        """
        turn = log_so3(root[1:] @ root[:-1].mT)
        v = self._rate * torch.cat((turn, others[1:] - others[:-1]), -1)
        K = len(self._smooth)
        change = sum(weight * v[i : i + K] for i, weight in reversed(list(enumerate(self._weights))))
        energy = (self._slow * v.square()).sum((0, 2)) + (self._smooth * change**2).sum((0, 2))
        force = self._bands[0] * v
        for k, band in enumerate(self._bands[1:], start=1):
            force[:-k] += band * v[k:]
            force[k:] += band * v[:-k]
        force = self._rate * force
        after, before = force.clone(), force.clone()
        inverse = right_jacobian_inverse(turn)
        # log(exp(d) R_t+1 R_tᵀ) = a + Jl^-1 d, and log(R_t+1 R_tᵀ exp(-d)) = a - Jr^-1 d.
        after[..., :3] = (inverse @ force[..., :3, None]).squeeze(-1)
        before[..., :3] = (inverse.mT @ force[..., :3, None]).squeeze(-1)
        edge = torch.zeros_like(v[:1])
        return energy, torch.cat((edge, after)) - torch.cat((before, edge))

    def _couplings(self) -> list[Tensor]:
        """H = V^T M V with V the differences of rows, M banded: diagonal, next, next but one, ... (T, G, N)."""
        edge, rate = torch.zeros_like(self._slow[:1]), self._rate
        found = [torch.cat((edge, 0 * self._slow)) for _ in range(len(self._bands) + 1)]
        for k, band in enumerate(self._bands):  # v_i with v_i+k
            L = len(band)
            across = rate[:L] * rate[k:] * band
            found[k][1 : 1 + L] += across
            found[k][:L] += across
            found[k + 1][:L] -= across
            if k > 0:
                found[k - 1][1 : 1 + L] -= 2 * across if k == 1 else across
        return found


def solve_banded(diagonal: Tensor, beyond: Tensor, right: Tensor) -> Tensor:
    """X (T, G, N, K) with H X = `right`, for G symmetric positive definite H of T blocks each.

    Block elimination along the chain: time and memory grow with T, not with its square. A chain that is shorter
    than T has identity blocks and no coupling at its end.

    Parameters
    ----------
    diagonal: (T, G, N, N) blocks H_tt; is overwritten.
    beyond: (T, G, N, B) diagonals of H_t,t+1 to H_t,t+B, which are diagonal matrices; unused past the end.
    right: (T, G, N, K); is overwritten.
    """
    (T, _, N, _), B = diagonal.shape, beyond.shape[-1]
    lower, upper, fills = [], [], dict[tuple[int, int], Tensor]()
    for t in range(T):
        factor = torch.linalg.cholesky_ex(diagonal[t])[0]
        blocks = torch.diag_embed(beyond[t].movedim(-1, 0))
        ahead = [blocks[b] - fills.pop((t, b)) if (t, b) in fills else blocks[b] for b in range(B)]
        solved = torch.linalg.solve_triangular(factor, torch.cat((*ahead, right[t]), -1), upper=False)
        right[t] = solved[..., B * N :]
        lower.append(factor)
        upper.append(solved[..., : B * N])
        fill = solved[..., : B * N].mT @ solved
        for a in range(min(B, T - 1 - t)):  # what row t leaves to those ahead of it
            rows = fill[:, a * N : a * N + N]
            diagonal[t + 1 + a] -= rows[..., a * N : a * N + N]
            right[t + 1 + a] -= rows[..., B * N :]
            for b in range(a + 1, B):
                key, block = (t + 1 + a, b - a - 1), rows[..., b * N : b * N + N]
                fills[key] = fills[key] + block if key in fills else block
    nothing = torch.zeros_like(right[0])
    for t in range(T - 1, -1, -1):
        ahead = [right[s] if s < T else nothing for s in range(t + 1, t + B + 1)]
        rest = right[t] - upper[t] @ torch.cat(ahead, -2)
        right[t] = torch.linalg.solve_triangular(lower[t].mT, rest, upper=True)
    return right
