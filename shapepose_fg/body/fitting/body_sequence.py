"""Bodies over time: one shape per person, and poses that move as people do."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
import torch
from annotated_types import Interval
from numpy.typing import NDArray
from torch import Tensor

from shapepose_fg.body.fitting.chain_solver import ChainRows, ChainShapes, ChainSolver
from shapepose_fg.body.fitting.chains import Segment, cut_segments
from shapepose_fg.body.fitting.energy import SETTLED, Held, WhitenedTargets, factored
from shapepose_fg.body.fitting.evidence import Evidence, weigh
from shapepose_fg.body.fitting.fit_rows import RowFitter
from shapepose_fg.body.fitting.fitter import BodyFit, FitStatus, JointTargets
from shapepose_fg.body.fitting.motion_prior import MotionPrior
from shapepose_fg.body.fitting.posterior import joint_covariance
from shapepose_fg.body.fitting.shared_shape import check_groups
from shapepose_fg.core.bounds import Factor, Repeats, Seconds, Settings

Array = NDArray[np.float64]

_CHUNK = 128
"""Rows whose covariances are computed at a time."""


@dataclass(frozen=True)
class SequenceConfig(Settings):
    """How bodies are fitted over time."""

    gap_s: Seconds = 1.0
    """Rows of a person that are farther apart are not linked."""
    lasting_s: Annotated[float, Interval(gt=0, le=3600)] = 1.5
    """How long errors of targets last, seconds: rows within that time tell of the shape as one. On real detections
    of a static camera they are correlated by 0.83 after 0.04 s, 0.63 after 0.2 s and 0.40 after 1 s."""
    max_iterations: Repeats = 8
    """Steps of Levenberg-Marquardt, refused ones included."""
    tolerance: Factor = 0.05
    """A chain is done when a step lowers its energy by less than this a row, in squared standard deviations."""
    segment_rows: Annotated[int, Interval(ge=1, le=100000)] = 320
    """Longer chains are cut, so that memory does not grow with them."""
    overlap_rows: Annotated[int, Interval(ge=0, le=10000)] = 16
    """Rows that a cut-off segment has of its neighbours, on either side."""


@dataclass(frozen=True)
class Shapes:
    """What is known of the shapes of G people: a Gaussian over the betas of each."""

    mean: Array
    """(G, 10) in standard deviations over adults."""
    information: Array
    """(G, 10, 10) inverse covariances. Those of somebody unknown are the identity around 0."""

    def __post_init__(self) -> None:
        if self.mean.ndim != 2 or self.mean.shape[1] != 10 or self.information.shape != (*self.mean.shape, 10):
            shapes = f"{self.mean.shape} and {self.information.shape}"
            raise ValueError(f"mean and information must be (G, 10) and (G, 10, 10), got {shapes}")


@dataclass(frozen=True)
class SequenceFit:
    """Bodies of B rows, and what is known of their shapes."""

    fit: BodyFit
    """The bodies. `covariance` is what a row's own targets say at the shape of its group: errors that last are not
    averaged out. `prior_xyz` and `prior_covariance` are NaN: they are `fit`'s."""
    groups: NDArray[np.intp]
    """(G,) the groups, in order."""
    shapes: Shapes
    """(G) their shapes given everything, what was known before included: the prior of their next recording."""


@dataclass(frozen=True)
class SequenceFitter:
    """Fits one shape per group and poses linked in time, from the bodies that `rows` finds row by row."""

    rows: RowFitter
    """Where the rows start, and what holds them."""
    motion: MotionPrior
    """How fast they move."""
    kernel_scale: float
    """Of the robust kernel, see `BodyEnergy`."""
    config: SequenceConfig

    def fit(
        self,
        targets: JointTargets,
        groups: NDArray[np.intp],
        time_s: Array,
        shapes: Shapes | None = None,
        *,
        fixed_shapes: bool = False,
    ) -> SequenceFit:
        """See `LearnedFitter.fit_sequence`."""
        groups, time_s = check_groups(groups, len(targets)), np.asarray(time_s, dtype=np.float64)
        numbers, group = np.unique(groups, return_inverse=True)
        _check(targets, time_s, shapes, len(numbers), len(self.rows.sets), fixed_shapes)
        evidence = weigh(targets, self.rows.evidence)
        fit = BodyFit.failed(evidence.status, targets.xyz.shape[1])
        start = self._start(evidence, group, time_s, len(numbers))
        # Whoever is in a segment that is fitted gets a body all the same, and `_fill` says so.
        fit.status[fit.ok & ~start.found] = FitStatus.NOT_CONVERGED
        known = _unknown(len(numbers)) if shapes is None else shapes
        usable = np.flatnonzero(evidence.status != FitStatus.INVALID_TARGETS)
        config = self.config
        segments = [
            segment
            for segment in cut_segments(usable, group, time_s, gap_s=config.gap_s, length=config.segment_rows,
                                        overlap=config.overlap_rows)
            if start.found[segment.rows].any()
        ]  # fmt: skip
        if len(segments) == 0:
            return SequenceFit(fit, numbers, known)
        free, known = self._solved(start, segments, known, fixed_shapes)
        done = np.concatenate([segment.rows[segment.kept] for segment in segments])
        self._fill(fit, np.sort(done), start, free, evidence)
        return SequenceFit(fit, numbers, known)

    def _start(self, evidence: Evidence, group: NDArray[np.intp], time_s: Array, count: int) -> "_Start":
        """Bodies row by row; one that has none starts as the nearest in time of its group, at a place between."""
        ok = np.flatnonzero(evidence.status == FitStatus.OK)
        B, A = len(group), self.rows.energy.num_angles
        free, angles, found = torch.zeros(B, 16 + A), None, np.zeros(B, dtype=bool)
        origin = np.zeros((count, 3))
        if len(ok) > 0:
            alone, held, done = self.rows.starts(evidence.rows(ok))
            ok, chosen = ok[done], torch.from_numpy(np.flatnonzero(done))
            free[ok], found[ok] = alone[chosen], True
            angles = None if held.angles is None else torch.zeros(B, A)
            for number in np.unique(group[ok]):
                mine, theirs = np.flatnonzero(group == number), ok[group[ok] == number]
                origin[number] = evidence.centre[theirs].mean(axis=0)
                free[theirs, -3:] += torch.from_numpy(evidence.centre[theirs] - origin[number]).float()
                order = theirs[np.argsort(time_s[theirs])]
                nearest = order[_nearest(time_s[order], time_s[mine])]
                place = [
                    np.interp(time_s[mine], time_s[order], free[order, axis].numpy()) for axis in (-3, -2, -1)
                ]
                free[mine] = free[nearest]
                free[mine, -3:] = torch.from_numpy(np.stack(place, axis=1)).float()
                if angles is not None and held.angles is not None:
                    row = np.searchsorted(ok, nearest)  # of `alone`
                    angles[mine] = held.angles[chosen[row]]
        xyz = torch.from_numpy(evidence.xyz - origin[group][:, None]).float()
        targets = WhitenedTargets(xyz, torch.from_numpy(evidence.root).float())
        return _Start(free, ChainRows(targets, angles, time_s), found, group, origin)

    def _solved(
        self, start: "_Start", segments: list[Segment], known: Shapes, fixed: bool
    ) -> tuple[Tensor, Shapes]:
        """Parameters (B, P), and the shapes (G) given everything."""
        config = self.config
        solver = ChainSolver(
            self.rows.energy, self.motion, self.kernel_scale, config.max_iterations, config.tolerance
        )
        owner = np.array([segment.group for segment in segments])
        if fixed:
            held = ChainShapes(*(torch.from_numpy(part[owner]) for part in (known.mean, known.information)))
            return solver.solve(start.free, start.rows, segments, held, fixed=True)[0], known
        share = start.rows_per_look(segments, config.lasting_s, len(known.mean))
        prior = known.information * share[:, None, None]
        held = ChainShapes(torch.from_numpy(known.mean[owner]), torch.from_numpy(prior[owner]))
        free, found = solver.solve(start.free, start.rows, segments, held, fixed=False)
        # Each segment's Gaussian without the prior: information S, and S times its mean. Overlaps count once.
        kept = np.array([segment.kept.mean() for segment in segments])[:, None, None]
        S = kept * found.information.numpy()
        pull = kept * ((found.information + held.information) @ found.betas[..., None]
                       - held.information @ held.betas[..., None]).numpy()  # fmt: skip
        total, right = prior.copy(), prior @ known.mean[..., None]
        np.add.at(total, owner, S)
        np.add.at(right, owner, pull)
        mean = np.asarray(np.linalg.solve(total, right)[..., 0], dtype=np.float64)
        shapes = Shapes(mean, known.information + (total - prior) / share[:, None, None])
        several = np.bincount(owner, minlength=len(mean)) > 1
        if several.any():
            again = [segment for segment in segments if several[segment.group]]
            place = np.array([segment.group for segment in again])
            held = ChainShapes(torch.from_numpy(mean[place]), torch.from_numpy(total[place]))
            free, _ = solver.solve(free, start.rows, again, held, fixed=True)
        return free, shapes

    def _fill(
        self, fit: BodyFit, rows: NDArray[np.intp], start: "_Start", free: Tensor, evidence: Evidence
    ) -> None:
        """Fill `fit`'s `rows` (R,) with the bodies `free` (B, P)."""
        energy, scale = self.rows.energy, torch.tensor(self.kernel_scale)
        for at in range(0, len(rows), _CHUNK):
            part = rows[at : at + _CHUNK]
            index, targets = torch.from_numpy(part), start.rows.targets
            body, seen = free[index], targets[index]
            angles = None if start.rows.angles is None else start.rows.angles[index]
            found = energy.evaluate(body, seen, scale, Held(body[:, :10], torch.tensor([SETTLED]), angles))
            known = joint_covariance(
                factored(found.here.hessian.double()), found.jacobian.unflatten(1, (-1, 3)).double()
            )
            whole, origin = energy.complete(body), start.origin[start.group[part]]
            information = np.square(evidence.root[part]).sum(axis=(1, 2, 3)) / 3
            ok = found.xyz.isfinite().all(-1).all(-1).numpy()
            fit.status[part] = np.where(ok, FitStatus.OK, FitStatus.NOT_CONVERGED)
            with np.errstate(divide="ignore", invalid="ignore"):
                residual_m = np.sqrt(found.here.squared.double().sum(-1).numpy() / information)
            part, origin = part[ok], origin[ok]
            for name in ("betas", "global_orient", "body_pose"):
                getattr(fit, name)[part] = getattr(whole, name).double().numpy()[ok]
            fit.transl[part] = whole.transl.double().numpy()[ok] + origin
            fit.joints[part] = found.xyz.double().numpy()[ok] + origin[:, None]
            fit.covariance[part], fit.residual_m[part] = known.numpy()[ok], residual_m[ok]


@dataclass(frozen=True)
class _Start:
    """Where B rows start."""

    free: Tensor
    """(B, P) parameters around the origin of each group."""
    rows: ChainRows
    """(B) their targets."""
    found: NDArray[np.bool_]
    """(B,) which have a body of their own."""
    group: NDArray[np.intp]
    """(B,) whose."""
    origin: Array
    """(G, 3) of each group, metres."""

    def rows_per_look(self, segments: list[Segment], lasting_s: float, count: int) -> Array:
        """(G,) how many rows of a group tell of its shape as one: those within the time that errors last."""
        rows, looks = np.zeros(count), np.zeros(count)
        for segment in segments:
            time_s = self.rows.time_s[segment.rows[segment.kept]]
            rows[segment.group] += len(time_s)
            looks[segment.group] += np.ptp(time_s) / lasting_s
        return np.maximum(rows / (1 + looks), 1.0)


def _unknown(count: int) -> Shapes:
    """Shapes of people who were never seen: adults."""
    return Shapes(np.zeros((count, 10)), np.tile(np.eye(10), (count, 1, 1)))


def _nearest(sorted_s: Array, asked_s: Array) -> NDArray[np.intp]:
    """(M,) index of the nearest of some sorted times to each that is asked for."""
    after = np.clip(np.searchsorted(sorted_s, asked_s), 0, len(sorted_s) - 1)
    before = np.maximum(after - 1, 0)
    return np.where(np.abs(sorted_s[before] - asked_s) <= np.abs(sorted_s[after] - asked_s), before, after)


def _check(
    targets: JointTargets, time_s: Array, shapes: Shapes | None, people: int, joints: int, fixed: bool
) -> None:
    if targets.xyz.shape[1] != joints:
        raise ValueError(f"targets must be the {joints} keypoints of the body, got {targets.xyz.shape[1]}")
    if time_s.shape != (len(targets),) or not np.isfinite(time_s).all():
        raise ValueError(f"time_s must be {len(targets)} finite numbers, one a row")
    if shapes is not None and len(shapes.mean) != people:
        raise ValueError(f"shapes must have one row for each of the {people} groups, got {len(shapes.mean)}")
    if fixed and shapes is None:
        raise ValueError("fixed_shapes needs the shapes: give them")
