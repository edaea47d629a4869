"""Poses of chains of rows and one shape for each chain: Levenberg-Marquardt with the motion prior, batched."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from shapepose_fg.body.fitting.chains import Motion, Segment, solve_banded
from shapepose_fg.body.fitting.energy import BodyEnergy, Held, WhitenedTargets
from shapepose_fg.body.fitting.priors import MotionPrior
from shapepose_fg.body.model.rotation import exp_so3, log_so3

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
    """The energy of G chains and its normal equations, but for the couplings of rows, which are `Motion`'s."""

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
    if bool(better.all()):
        return new
    pairs = ((name, value, getattr(new, name)) for name, value in vars(old).items())
    return replace(old, **{n: torch.where(better.view(1, -1, *(1,) * (a.ndim - 2)), b, a) for n, a, b in pairs})


class _Batch:
    """G chains that are solved together; shorter ones end early."""

    def __init__(self, rows: ChainRows, segments: list[Segment], mean: Tensor, firm: Tensor, fixed: bool):
        self._rows, self._mean, self._firm, self._fixed = rows, mean, firm, fixed
        T, G = max(2, *(len(segment.rows) for segment in segments)), len(segments)
        index, step = np.zeros((T, G), dtype=np.intp), np.full((T - 1, G), np.inf)
        mask = np.zeros((T, G), dtype=bool)
        for column, segment in enumerate(segments):
            count = len(segment.rows)
            index[:count, column], mask[:count, column] = segment.rows, True
            index[count:, column] = segment.rows[-1]
            step[: count - 1, column] = np.diff(rows.time_s[segment.rows])
        self._index, self._mask = torch.from_numpy(index), torch.from_numpy(mask)
        real = self._index[self._mask]
        self._targets = rows.targets[real]
        self._angles = None if rows.angles is None else rows.angles[real]
        self._motion = Motion(*MotionPrior.default().part(rows.energy.angles), torch.from_numpy(step))

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
        moved, moved_gradient = self._motion.at(state.root, state.others)
        diagonal = torch.eye(N).double().repeat(T, G, 1, 1)
        across, gradient = diagonal.new_zeros(T, G, N, 10), diagonal.new_zeros(T, G, N)
        away = state.betas[0] - self._mean
        pull = (self._firm @ away[..., None]).squeeze(-1)
        energy, shape = moved + (away * pull).sum(-1), diagonal.new_zeros(G, 10, 10)
        shape_gradient, place = diagonal.new_zeros(G, 10), self._mask.nonzero()
        for at in range(0, len(free), _CHUNK):
            part = slice(at, at + _CHUNK)
            held = Held(torch.zeros(10), torch.zeros(1), None if self._angles is None else self._angles[part])
            row = rows.energy.linearise(free[part].float(), self._targets[part], scale, held)
            H, g, R = row.hessian.double(), row.gradient.double(), turn[part]
            H[:, 10:13] = R @ H[:, 10:13]
            H[:, :, 10:13] = H[:, :, 10:13] @ R.mT
            g[:, 10:13] = (R @ g[:, 10:13, None]).squeeze(-1)
            t, chain = place[part].unbind(1)
            diagonal[t, chain], across[t, chain], gradient[t, chain] = H[:, 10:, 10:], H[:, 10:, :10], g[:, 10:]
            shape.index_add_(0, chain, H[:, :10, :10])
            shape_gradient.index_add_(0, chain, g[:, :10])
            energy.index_add_(0, chain, row.energy(scale).double())
        torch.diagonal(diagonal, dim1=-2, dim2=-1).add_(self._motion.diagonal)
        shape_gradient = shape_gradient + pull
        return _Normal(
            energy[None], shape_gradient[None], shape[None], gradient + moved_gradient, across, diagonal
        )

    def _step(self, here: _Normal, damping: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Steps of betas (G, 10) and poses (T, G, N), and the rows' information about the betas (G, 10, 10)."""
        diagonal = here.diagonal.clone()
        torch.diagonal(diagonal, dim1=-2, dim2=-1).mul_(1 + damping[:, None])
        right = torch.cat((here.gradient[..., None], here.across), -1)
        X = solve_banded(diagonal, self._motion.next_one, self._motion.next_two, right)
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
