"""Chains of rows over time: the motion prior along them, and Levenberg-Marquardt for all poses and one shape."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from factors import Motion
from shapepose_fg.body.fitting.energy import BodyEnergy, Held, WhitenedTargets
from shapepose_fg.body.fitting.priors import MotionPrior
from shapepose_fg.body.model.rotation import exp_so3, log_so3, right_jacobian_inverse

Array = NDArray[np.float64]
T_ = TypeVar("T_", "_State", "_Normal")

MAX_ITERATIONS = 8
"""Steps of Levenberg-Marquardt, refused ones included."""
TOLERANCE = 0.05
"""A chain is done when a step lowers its energy by less than this a row, in squared standard deviations."""
_CHUNK = 128
"""Rows that are linearised at a time."""
_BATCH_ROWS = 768
"""Rows that are solved at a time, some 300 kB each."""
_DAMPING_START, _DAMPING_MIN, _DAMPING_MAX = 1e-4, 1e-8, 1e4


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
    rows: NDArray[np.intp], group: NDArray[np.intp], time_s: Array, *, gap_s: float, length: int, overlap: int
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


@dataclass(frozen=True)
class ChainRows:
    """R rows whose energies are minimised, with the motion prior between them; rows of a chain have one origin."""

    energy: BodyEnergy
    """Of a row."""
    kernel_scale: float
    """Of the robust kernel."""
    targets: WhitenedTargets
    """(R) where the joints should be."""
    angles: Tensor | None
    """(R, A) around where the pose prior holds them; None: where it expects them."""
    time_s: Array
    """(R,) when."""
    law: Motion
    """How they move from row to row."""

    def solved(
        self, free: Tensor, segments: list[Segment], mean: Array, information: Array, *, fixed: bool
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Parameters (R, P) of the rows that the `segments` (S) keep, from `free` (R, P) on, and their shapes.

        `mean` (S, 10) and `information` (S, 10, 10) are the prior of each segment's betas; with `fixed` they stay
        there. Of the shapes the betas (S, 10) come back, and what the rows alone say of them, (S, 10, 10): the
        Schur complement.
        """
        prior, firm = torch.from_numpy(mean), torch.from_numpy(information)
        found, betas, said = free.clone(), prior.clone(), torch.zeros_like(firm)
        for batch in _batches(segments):
            chosen = [segments[place] for place in batch]
            problem = _Batch(self, chosen, prior[batch], firm[batch], fixed)
            state, said[batch] = problem.solved(free)
            betas[batch], bodies = state.betas[0], state.free()
            for column, segment in enumerate(chosen):
                inside = np.flatnonzero(segment.kept)
                found[segment.rows[inside]] = bodies[inside, column].to(found.dtype)
        return found, betas, said


@dataclass(frozen=True)
class _State:
    """Bodies of G chains."""

    betas: Tensor
    """(1, G, 10)."""
    root: Tensor
    """(T, G, 3, 3) rotation."""
    others: Tensor
    """(T, G, N - 3) angles and place."""

    def moved(self, shape: Tensor, pose: Tensor) -> "_State":
        """After a step of the betas (G, 10) and of the rest (T, G, N)."""
        return _State(self.betas + shape, exp_so3(pose[..., :3]) @ self.root, self.others + pose[..., 3:])

    def free(self) -> Tensor:
        """(T, G, P) parameters of the energy."""
        return torch.cat((self.betas.expand(len(self.root), -1, -1), log_so3(self.root), self.others), -1)


@dataclass(frozen=True)
class _Normal:
    """The energy of G chains and its normal equations, but for the couplings of rows, which are `Links`'."""

    energy: Tensor
    """(1, G)."""
    shape_gradient: Tensor
    """(1, G, 10)."""
    shape: Tensor
    """(1, G, 10, 10) of the betas."""
    gradient: Tensor
    """(T, G, N)."""
    across: Tensor
    """(T, G, N, 10) of poses with betas."""
    diagonal: Tensor
    """(T, G, N, N) of poses."""


def _mixed(better: Tensor, new: T_, old: T_) -> T_:
    """The chains that are `better` (G,) from `new`, the rest from `old`."""
    pairs = zip(vars(new).values(), vars(old).values(), strict=True)
    return type(old)(*(torch.where(better.view(1, -1, *(1,) * (a.ndim - 2)), a, b) for a, b in pairs))


class _Batch:
    """G chains that are solved together; shorter ones end early."""

    def __init__(self, rows: ChainRows, segments: list[Segment], mean: Tensor, firm: Tensor, fixed: bool):
        self._rows, self._mean, self._firm, self._fixed = rows, mean, firm, fixed
        T, G = max(rows.law.order, *(len(segment.rows) for segment in segments)), len(segments)
        index, step = np.zeros((T, G), dtype=np.intp), np.full((T - 1, G), np.inf)
        mask = np.zeros((T, G), dtype=bool)
        for column, segment in enumerate(segments):
            count = len(segment.rows)
            index[:count, column], mask[:count, column] = segment.rows, True
            index[count:, column] = segment.rows[-1]
            step[: count - 1, column] = np.diff(rows.time_s[segment.rows])
        self._index, self._mask = torch.from_numpy(index), torch.from_numpy(mask)
        real = self._index[self._mask]
        self._targets = rows.targets.rows(real)
        self._angles = None if rows.angles is None else rows.angles[real]
        densities = MotionPrior.default().part(rows.energy.angles)
        self._links = Links(rows.law, *densities, torch.from_numpy(step))

    def solved(self, free: Tensor) -> tuple[_State, Tensor]:
        """The bodies, and the information about their betas in the rows (G, 10, 10)."""
        start, count = free[self._index].double(), self._mask.sum(0)
        betas = self._mean[None] if self._fixed else start[:1, :, :10]
        state = _State(betas, exp_so3(start[..., 10:13]), start[..., 13:])
        here = self._normal(state)
        damping = torch.full((len(count),), _DAMPING_START).double()
        going = torch.ones(len(count), dtype=torch.bool)
        information = torch.zeros_like(self._firm)
        for _ in range(MAX_ITERATIONS):
            shape, pose, said = self._step(here, damping)
            trial = state.moved(shape * going[:, None], pose * going[:, None])
            there = self._normal(trial)
            gain = (here.energy - there.energy)[0]
            better = (gain > 0) & going
            state, here = _mixed(better, trial, state), _mixed(better, there, here)
            information = torch.where(going[:, None, None], said, information)
            damping = torch.where(better, damping / 10, damping * 10).clamp_min(_DAMPING_MIN)
            going = going & ~(better & (gain < TOLERANCE * count)) & (damping < _DAMPING_MAX)
            if not bool(going.any()):
                break
        return state, information

    def _normal(self, state: _State) -> _Normal:
        """Energy and normal equations, the root's rotation in tangents of the world."""
        rows, free = self._rows, state.free()[self._mask]
        turn, scale = state.root[self._mask], torch.tensor(rows.kernel_scale)
        (T, G), N = self._mask.shape, free.shape[1] - 10
        moved, moved_gradient = self._links.at(state.root, state.others)
        diagonal = torch.eye(N).double().repeat(T, G, 1, 1)
        across, gradient = diagonal.new_zeros(T, G, N, 10), diagonal.new_zeros(T, G, N)
        away = state.betas[0] - self._mean
        pull = (self._firm @ away[..., None]).squeeze(-1)
        energy, shape = moved + (away * pull).sum(-1), diagonal.new_zeros(G, 10, 10)
        shape_gradient, place = diagonal.new_zeros(G, 10), self._mask.nonzero()
        for at in range(0, len(free), _CHUNK):
            part = slice(at, at + _CHUNK)
            held = Held(torch.zeros(10), torch.zeros(1), None if self._angles is None else self._angles[part])
            row = rows.energy.linearise(free[part].float(), self._targets.rows(part), scale, held)
            H, g, R = row.hessian.double(), row.gradient.double(), turn[part]
            H[:, 10:13] = R @ H[:, 10:13]
            H[:, :, 10:13] = H[:, :, 10:13] @ R.mT
            g[:, 10:13] = (R @ g[:, 10:13, None]).squeeze(-1)
            t, chain = place[part].unbind(1)
            diagonal[t, chain], across[t, chain], gradient[t, chain] = H[:, 10:, 10:], H[:, 10:, :10], g[:, 10:]
            shape.index_add_(0, chain, H[:, :10, :10])
            shape_gradient.index_add_(0, chain, g[:, :10])
            energy.index_add_(0, chain, row.energy(scale).double())
        torch.diagonal(diagonal, dim1=-2, dim2=-1).add_(self._links.diagonal)
        shape_gradient = shape_gradient + pull
        return _Normal(
            energy[None], shape_gradient[None], shape[None], gradient + moved_gradient, across, diagonal
        )

    def _step(self, here: _Normal, damping: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Steps of betas (G, 10) and poses (T, G, N), and the rows' information about the betas (G, 10, 10)."""
        diagonal = here.diagonal.clone()
        torch.diagonal(diagonal, dim1=-2, dim2=-1).mul_(1 + damping[:, None])
        right = torch.cat((here.gradient[..., None], here.across), -1)
        X = solve_banded(diagonal, self._links.beyond, right)
        eliminated = (here.across.mT @ X).sum(0)  # (G, 10, 11)
        said = here.shape[0] - eliminated[..., 1:]
        if self._fixed:
            return torch.zeros_like(here.shape_gradient[0]), -X[..., 0], said
        whole = said + self._firm
        whole = whole + damping[:, None, None] * torch.diag_embed(torch.diagonal(whole, dim1=-2, dim2=-1))
        shape = -torch.linalg.solve(whole, (here.shape_gradient[0] - eliminated[..., 0])[..., None])
        pose = -X[..., 0] - (X[..., 1:] @ shape).squeeze(-1)
        return shape.squeeze(-1), pose, said


def _batches(segments: list[Segment]) -> Iterator[list[int]]:
    """Places of segments that are solved together: of like length, so that little is padded."""
    batch: list[int] = []
    for place in sorted(range(len(segments)), key=lambda place: -len(segments[place].rows)):
        if batch and (len(batch) + 1) * len(segments[batch[0]].rows) > _BATCH_ROWS:
            yield batch
            batch = []
        batch.append(place)
    if batch:
        yield batch
