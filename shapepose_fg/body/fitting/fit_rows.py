"""The way of every fit, whichever optimiser: judge, plan passes, fit them, share shapes, fit again, fill in."""

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from shapepose_fg.body.fitting.energy import BodyEnergy, Evaluated, Held, WhitenedTargets
from shapepose_fg.body.fitting.evidence import Evidence, EvidenceConfig, weigh
from shapepose_fg.body.fitting.fitter import BodyFit, FitStatus, JointTargets
from shapepose_fg.body.fitting.left_out import Passes, plan_passes
from shapepose_fg.body.fitting.posterior import JointPosterior, fill
from shapepose_fg.body.fitting.shared_shape import check_groups, pooled_betas, shape_precision, shared

Array = NDArray[np.float64]

_CHUNK = 128
"""Passes that are fitted at a time: their Hessians stay in the cache, and memory does not grow with the batch."""
_VOTERS = 24
"""Rows of a group that agree upon its shape. In a window of some seconds errors last: more tell no more."""


class Optimiser(Protocol):
    """How bodies are fitted to some targets; rows are independent."""

    def arrive(self, targets: WhitenedTargets, variance: Array, start: Tensor | None) -> tuple[Tensor, Held]:
        """Parameters (B, P) from which `again` is short, and what bodies are held by; arguments as of `first`."""
        ...

    def first(self, targets: WhitenedTargets, variance: Array, start: Tensor | None) -> tuple[Evaluated, Held]:
        """Bodies (B) from nowhere, or from `start` (B, P) where that is not NaN, and what they were held by.

        `variance` (B, J) is that of each target, infinite where it is not known in all directions, m².
        """
        ...

    def again(self, free: Tensor, targets: WhitenedTargets, held: Held) -> Evaluated:
        """Bodies from `free` (B, P) on, held by something else."""
        ...


@dataclass(frozen=True)
class RowFitter:
    """Fits bodies with one `Optimiser`, and says of each joint what is known without its own target."""

    energy: BodyEnergy
    """The energy that is minimised."""
    optimiser: Optimiser
    """How."""
    sets: NDArray[np.intp]
    """(J,) which joints are left out together (`left_out_sets`)."""
    evidence: EvidenceConfig
    """How targets are judged and weighed."""
    unfinished: float
    """Rows whose energy a Newton step would still lower by more are NOT_CONVERGED."""
    spread: Array
    """(J,) multiplies the variance of what is said of a joint without a target."""
    fallback: Optimiser | None = None
    """What fits the passes that `optimiser` left unfinished."""

    def fit(
        self,
        targets: JointTargets,
        initial: BodyFit | None,
        groups: NDArray[np.intp] | None,
        *,
        leave_out: bool = True,
    ) -> BodyFit:
        """A body for every row; see `BodyFitter.fit`. Without `leave_out` priors of joints are NaN: much
        faster.
        """
        count = len(self.sets)
        if targets.xyz.shape[1] != count:
            raise ValueError(f"targets must be the {count} keypoints of the body, got {targets.xyz.shape[1]}")
        if initial is not None and len(initial) != len(targets):
            raise ValueError(f"initial must have one row per target: {len(targets)}, got {len(initial)}")
        groups = np.arange(len(targets)) if groups is None else check_groups(groups, len(targets))
        evidence = weigh(targets, self.evidence)
        fit = BodyFit.failed(evidence.status, count)
        rows = np.flatnonzero(evidence.status == FitStatus.OK)
        if len(rows) > 0:
            start = None if initial is None else self._start(initial.rows(rows), evidence.centre[rows])
            usable = evidence.rows(rows)
            if leave_out:
                passes = plan_passes(usable, self.sets, groups[rows], self.evidence)
            else:
                passes = Passes.whole(groups[rows], count)
            voters = _evenly(groups[rows], _VOTERS)
            passes = replace(passes, votes=passes.votes & voters[passes.row])
            self._fit_passes(fit, usable, rows, passes, start)
        if not leave_out:
            fit.prior_xyz[:], fit.prior_covariance[:] = np.nan, np.nan
        return fit

    def starts(self, evidence: Evidence) -> tuple[Tensor, Held, NDArray[np.bool_]]:
        """Bodies of rows (R) with all their targets, nothing left out, each with a shape of its own.

        Returns their parameters (R, P) around `evidence.centre`, what holds them, and which (R,) are finished.
        """
        inside = torch.from_numpy(evidence.xyz - evidence.centre[:, None]).float()
        targets, found, holds = WhitenedTargets(inside, torch.from_numpy(evidence.root).float()), [], []
        for at in range(0, len(inside), _CHUNK):
            part = slice(at, at + _CHUNK)
            body, held = self.optimiser.first(targets[part], evidence.variance_m2[part], None)
            found.append(torch.cat((body.free, (body.left < self.unfinished)[:, None]), 1))
            holds.append(held.for_rows(len(body.free)))
        free, held = torch.cat(found), Held.concatenated(holds)
        free, done = free[:, :-1], free[:, -1].bool().numpy()
        unsettled = np.flatnonzero(~done)
        if self.fallback is not None and len(unsettled) > 0:
            body, _ = self.fallback.first(
                targets[torch.from_numpy(unsettled)], evidence.variance_m2[unsettled], None
            )
            free[unsettled], done[unsettled] = body.free, (body.left < self.unfinished).numpy()
            held.betas[unsettled] = body.free[:, :10]
            if held.angles is not None:
                held.angles[unsettled] = body.free[:, 13:-3]
        return free, held, done

    def _fit_passes(
        self, fit: BodyFit, evidence: Evidence, rows: NDArray[np.intp], passes: Passes, start: Tensor | None
    ) -> None:
        """Fit all passes, and fill in `fit`'s `rows` (R,) from them."""
        # Single precision is a micrometre off at 10 m from the origin: each row gets its own origin.
        inside = evidence.xyz - evidence.centre[:, None]
        together = bool(shared(passes.pool, passes.votes).any())
        free, held = self._shapes(inside, evidence, passes, start) if together else (None, Held.by_priors())
        found: list[JointPosterior] = []
        for chunk in passes.chunks(_CHUNK):
            targets = passes.targets(inside, evidence.root, chunk)
            if free is None:
                variance = passes.variance(evidence.variance_m2, chunk)
                body, _ = self.optimiser.first(targets, variance, _part(start, chunk))
            else:
                body = self.optimiser.again(free[chunk], targets, held[torch.from_numpy(chunk)])
            found.append(JointPosterior.of(body, passes.asked(chunk)))
        full = -(-len(rows) // _CHUNK)
        parts = [JointPosterior.concatenated(part) for part in (found[:full], found[full:]) if len(part) > 0]
        for part, offset in zip(parts, (0, len(rows)), strict=False):
            # Each pass by itself: what a target does to another pass must not decide which optimiser this one has.
            unsettled = np.flatnonzero(~(part.left < self.unfinished))  # NaN is unsettled
            if self.fallback is not None and len(unsettled) > 0:
                index = unsettled + offset
                targets = passes.targets(inside, evidence.root, index)
                body, _ = self.fallback.first(targets, passes.variance(evidence.variance_m2, index), None)
                part.put(unsettled, JointPosterior.of(body, passes.asked(index)))
        fill(fit, rows, passes, self.energy, parts, evidence, self.spread,
             model_sigma_m=self.evidence.model_sigma_m, unfinished=self.unfinished)  # fmt: skip

    def _shapes(
        self, inside: Array, evidence: Evidence, passes: Passes, start: Tensor | None
    ) -> tuple[Tensor, Held]:
        """Where all passes start with the shapes at which those of each pool agree: (M, P), and what holds them.

        The shapes are agreed upon by the passes that vote, each of which is fitted alone first.
        """
        bodies, holds, places, precisions, settled = [], [], [], [], []
        for chunk in passes.chunks(_CHUNK):
            targets = passes.targets(inside, evidence.root, chunk)
            variance = passes.variance(evidence.variance_m2, chunk)
            free, held = self.optimiser.arrive(targets, variance, _part(start, chunk))
            held = held.for_rows(len(free))
            voting = torch.from_numpy(np.flatnonzero(passes.votes[chunk]))
            if len(voting) > 0:
                body = self.optimiser.again(free[voting], targets[voting], held[voting])
                free[voting] = body.free
                places.append(chunk[voting.numpy()])
                precisions.append(shape_precision(body.factor))
                settled.append(body.left < self.unfinished)
            bodies.append(free)
            holds.append(held)
        free, held = torch.cat(bodies), Held.concatenated(holds)
        place = np.concatenate(places)
        precision, votes = free.new_zeros(len(free), 10, 10), np.zeros(len(free), dtype=bool)
        precision[torch.from_numpy(place)], votes[place] = torch.cat(precisions), torch.cat(settled).numpy()
        betas = pooled_betas(free[:, :10], precision, passes.pool, votes, held)
        return torch.cat((betas, free[:, 10:]), 1), held.at_shape(betas, shared(passes.pool, votes))

    def _start(self, initial: BodyFit, centre: Array) -> Tensor:
        """Free parameters (R, P) of bodies around their origins (R, 3); NaN where there is none."""
        angles = initial.body_pose.reshape(len(initial), -1)[:, self.energy.angles]
        parts = (initial.betas, initial.global_orient, angles, initial.transl - centre)
        start = np.where(initial.ok[:, None], np.concatenate(parts, axis=1), np.nan)
        return torch.from_numpy(start).float()


def _evenly(groups: NDArray[np.intp], count: int) -> NDArray[np.bool_]:
    """(R,) at most `count` rows of each group (R,), evenly spread over its rows."""
    order = np.argsort(groups, kind="stable")
    _, first, size = np.unique(groups[order], return_index=True, return_counts=True)
    rank = np.arange(len(order)) - np.repeat(first, size)
    number = rank * count // np.maximum(np.repeat(size, size), count)
    chosen = np.zeros(len(order), dtype=bool)
    chosen[order] = (rank == 0) | (np.diff(number, prepend=0) != 0)
    return chosen


def _part(start: Tensor | None, chunk: NDArray[np.intp]) -> Tensor | None:
    """The starts of a chunk: passes that leave targets out have none, an earlier body has seen them."""
    return None if start is None or chunk[0] >= len(start) else start[chunk]
