"""Bodies over time: one shape per person, and poses that move as people do."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from shapepose_fg.body.fitting.chain_solver import ChainRows, ChainShapes
from shapepose_fg.body.fitting.chains import Segment, cut_segments
from shapepose_fg.body.fitting.energy import SETTLED, BodyEnergy, Held, WhitenedTargets, factored
from shapepose_fg.body.fitting.evidence import Evidence, weigh
from shapepose_fg.body.fitting.fitter import BodyFit, FitStatus, JointTargets, SequenceFit, Shapes
from shapepose_fg.body.fitting.posterior import joint_covariance
from shapepose_fg.body.fitting.priors import MotionPrior
from shapepose_fg.body.fitting.settings import BodyConfig
from shapepose_fg.body.fitting.shared_shape import check_groups

Array = NDArray[np.float64]

SEGMENT_ROWS = 320
"""Longer chains are cut, so that memory does not grow with them."""
OVERLAP_ROWS = 16
"""Rows that a cut-off segment has of its neighbours, on either side."""
_CHUNK = 128
"""Rows whose covariances are computed at a time."""


@dataclass(frozen=True)
class SequenceFitter:
    """Fits one shape per group and poses linked in time, from bodies that were found row by row."""

    energy: BodyEnergy
    """Of a row."""
    starts: Callable[[Evidence], tuple[Tensor, Held, NDArray[np.bool_]]]
    """Bodies of rows (R) by themselves: parameters (R, P) around their centres, what holds them, which are
    good."""
    motion: MotionPrior
    """How fast they move."""
    config: BodyConfig

    def fit(
        self,
        targets: JointTargets,
        groups: NDArray[np.intp],
        time_s: Array,
        shapes: Shapes | None = None,
        *,
        fixed_shapes: bool = False,
    ) -> SequenceFit:
        """See `BodyFitter.fit_sequence`."""
        groups, time_s = check_groups(groups, len(targets)), np.asarray(time_s, dtype=np.float64)
        numbers, group = np.unique(groups, return_inverse=True)
        joints = len(self.energy.model.keypoint_names)
        _check(targets, time_s, shapes, len(numbers), joints, fixed_shapes)
        evidence = weigh(targets, self.config.model_sigma_m)
        fit = BodyFit.failed(evidence.status, joints)
        start = self._start(evidence, group, time_s, len(numbers))
        # Whoever is in a segment that is fitted gets a body all the same, and `_fill` says so.
        fit.status[fit.ok & ~start.found] = FitStatus.NOT_CONVERGED
        known = Shapes.unknown(len(numbers)) if shapes is None else shapes
        usable = np.flatnonzero(evidence.status != FitStatus.INVALID_TARGETS)
        cut = cut_segments(
            usable, group, time_s, gap_s=self.config.gap_s, length=SEGMENT_ROWS, overlap=OVERLAP_ROWS
        )
        segments = [segment for segment in cut if start.found[segment.rows].any()]
        if len(segments) == 0:
            return SequenceFit(fit, numbers, known)
        free, known = self._solved(start, segments, known, fixed_shapes)
        done = np.concatenate([segment.rows[segment.kept] for segment in segments])
        self._fill(fit, np.sort(done), start, free, evidence)
        return SequenceFit(fit, numbers, known)

    def _start(self, evidence: Evidence, group: NDArray[np.intp], time_s: Array, count: int) -> "_Start":
        """Bodies row by row; one that has none starts as the nearest in time of its group, at a place between."""
        ok = np.flatnonzero(evidence.status == FitStatus.OK)
        B, A = len(group), self.energy.num_angles
        free, angles, found = torch.zeros(B, 16 + A), None, np.zeros(B, dtype=bool)
        origin = np.zeros((count, 3))
        if len(ok) > 0:
            single, held, done = self.starts(evidence.rows(ok))
            ok, chosen = ok[done], torch.from_numpy(np.flatnonzero(done))
            free[ok], found[ok] = single[chosen], True
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
                    row = np.searchsorted(ok, nearest)  # of `single`
                    angles[mine] = held.angles[chosen[row]]
        xyz = torch.from_numpy(evidence.xyz - origin[group][:, None]).float()
        targets = WhitenedTargets(xyz, torch.from_numpy(evidence.root).float())
        rows = ChainRows(self.energy, self.motion, self.config.kernel_scale, targets, angles, time_s)
        return _Start(free, rows, found, origin[group])

    def _solved(
        self, start: "_Start", segments: list[Segment], known: Shapes, fixed: bool
    ) -> tuple[Tensor, Shapes]:
        """Parameters (B, P), and the shapes (G) given everything."""
        owner = np.array([segment.group for segment in segments])

        def held_at(mean: Array, information: Array, owner: NDArray[np.intp] = owner) -> ChainShapes:
            return ChainShapes(torch.from_numpy(mean[owner]), torch.from_numpy(information[owner]))

        if fixed:
            held = held_at(known.mean, known.information)
            return start.rows.solved(start.free, segments, held, fixed=True)[0], known
        share = _rows_per_look(start.rows.time_s, segments, self.config.correlation_s, len(known.mean))
        prior = known.information * share[:, None, None]
        held = held_at(known.mean, prior)
        free, found = start.rows.solved(start.free, segments, held, fixed=False)
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
            held = held_at(mean, total, np.array([segment.group for segment in again]))
            free, _ = start.rows.solved(free, again, held, fixed=True)
        return free, shapes

    def _fill(
        self, fit: BodyFit, rows: NDArray[np.intp], start: "_Start", free: Tensor, evidence: Evidence
    ) -> None:
        """Fill `fit`'s `rows` (R,) with the bodies `free` (B, P)."""
        energy, scale, angles = self.energy, torch.tensor(self.config.kernel_scale), start.rows.angles
        for at in range(0, len(rows), _CHUNK):
            part = rows[at : at + _CHUNK]
            index = torch.from_numpy(part)
            body = free[index]
            held = Held(body[:, :10], torch.tensor([SETTLED]), None if angles is None else angles[index])
            found = energy.evaluate(body, start.rows.targets[index], scale, held)
            by_joint = found.jacobian.unflatten(1, (-1, 3)).double()
            known = joint_covariance(factored(found.here.hessian.double()), by_joint)
            whole, origin = energy.complete(body), start.origin[part]
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
    """(B, P) parameters around `origin`."""
    rows: ChainRows
    """(B) what is minimised."""
    found: NDArray[np.bool_]
    """(B,) which have a body of their own."""
    origin: Array
    """(B, 3) one for all rows of a group, metres."""


def _rows_per_look(time_s: Array, segments: list[Segment], correlation_s: float, count: int) -> Array:
    """(G,) how many rows of a group tell of its shape as one: those within the time that errors are correlated."""
    rows, looks = np.zeros(count), np.zeros(count)
    for segment in segments:
        kept = time_s[segment.rows[segment.kept]]
        rows[segment.group] += len(kept)
        looks[segment.group] += np.ptp(kept) / correlation_s
    return np.maximum(rows / (1 + looks), 1.0)


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
