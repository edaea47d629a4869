"""Body fitting over time: one shape per person, and a motion prior on the poses."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from factors import Motion
from shapepose_fg.body.fitting.chains import ChainRows, Segment, cut_segments
from shapepose_fg.body.fitting.energy import SETTLED, BodyEnergy, EnergyTargets, Held
from shapepose_fg.body.fitting.evidence import Evidence, weigh
from shapepose_fg.body.fitting.fitter import (
    BodyConfig,
    BodyFit,
    FitStatus,
    JointTargets,
    SequenceFit,
    Shapes,
    check_groups,
)
from shapepose_fg.core.arrays import Array, Index, Mask

SEGMENT_ROWS = 320
"""Maximum number of rows in a segment; longer chains are cut to bound memory."""
OVERLAP_ROWS = 16
"""Number of rows by which a segment overlaps its neighbours, on either side."""
_CHUNK = 64
"""Number of rows per batch of covariances."""


@dataclass(frozen=True)
class SequenceFitter:
    """Fits one shape per group and poses linked in time, starting from single-row fits."""

    energy: BodyEnergy
    """Energy of a row."""
    starts: Callable[[Evidence], tuple[Array, Array, Mask]]
    """Single-row fits of rows (R): parameters (R, P) relative to their centres, angles (R, A) at
    which the pose prior is centred, and a mask of the successful ones."""
    law: Motion
    """Motion model between rows."""
    config: BodyConfig

    def fit(
        self,
        targets: JointTargets,
        groups: Index,
        time_s: Array,
        shapes: Shapes | None = None,
        *,
        fixed_shapes: bool = False,
        faster: Array | None = None,
    ) -> SequenceFit:
        """See `BodyFitter.fit_sequence`."""
        groups, time_s = check_groups(groups, len(targets)), np.asarray(time_s, dtype=np.float64)
        numbers, group = np.unique(groups, return_inverse=True)
        joints = len(self.energy.model.keypoint_names)
        if targets.xyz.shape[1] != joints:
            raise ValueError(
                f"targets must be the {joints} keypoints of the body, got {targets.xyz.shape[1]}"
            )
        if time_s.shape != (len(targets),) or not np.isfinite(time_s).all():
            raise ValueError(f"time_s must be {len(targets)} finite numbers, one a row")
        if shapes is not None and len(shapes.mean) != len(numbers):
            count = f"{len(numbers)} groups, got {len(shapes.mean)}"
            raise ValueError(f"shapes must have one row for each of the {count}")
        if fixed_shapes and shapes is None:
            raise ValueError("fixed_shapes needs shapes: give them")
        faster = np.ones(targets.xyz.shape[:2]) if faster is None else faster
        if faster.shape != targets.xyz.shape[:2] or not (faster >= 1).all():
            raise ValueError(f"faster must be {targets.xyz.shape[:2]}, at least 1")
        evidence = weigh(targets, self.config.model_sigma_m)
        fit = BodyFit.failed(evidence.status, joints)
        free, origin, rows, found = self._start(evidence, group, time_s, faster)
        # Rows without a fit of their own get a body if their segment is solved; `_fill` then sets
        # their status.
        fit.status[fit.ok & ~found] = FitStatus.NOT_CONVERGED
        known = Shapes.unknown(len(numbers)) if shapes is None else shapes
        usable = np.flatnonzero(evidence.status != FitStatus.INVALID_TARGETS)
        cut = cut_segments(
            usable,
            group,
            time_s,
            gap_s=self.config.gap_s,
            length=SEGMENT_ROWS,
            overlap=OVERLAP_ROWS,
        )
        segments = [segment for segment in cut if found[segment.rows].any()]
        if len(segments) > 0:
            free, known = self._solved(rows, free, segments, known, fixed_shapes)
            done = np.sort(np.concatenate([segment.rows[segment.kept] for segment in segments]))
            for at in range(0, len(done), _CHUNK):
                part = done[at : at + _CHUNK]
                self._fill(fit, part, free[part], origin[part], rows, evidence)
        return SequenceFit(fit, numbers, known)

    def _start(
        self, evidence: Evidence, group: Index, time_s: Array, faster: Array
    ) -> tuple[Array, Array, ChainRows, Mask]:
        """Initial bodies of B rows from single-row fits; rows without one take that of the nearest
        row of the group in time.

        Returns parameters (B, P), their origins (B, 3), the same for all rows of a group, the
        problem to minimise, and a mask of rows with a fit of their own.
        """
        ok, B = np.flatnonzero(evidence.status == FitStatus.OK), len(group)
        free, angles = np.zeros((B, self.energy.num_free)), np.zeros((B, self.energy.num_angles))
        origin, found = np.zeros((B, 3)), np.zeros(B, dtype=bool)
        if len(ok) > 0:
            single, held, done = self.starts(evidence.rows(ok))
            ok, held = ok[done], held[done]
            free[ok], found[ok] = single[done], True
            for number in np.unique(group[ok]):
                mine, theirs = np.flatnonzero(group == number), ok[group[ok] == number]
                origin[mine] = middle = evidence.centre[theirs].mean(axis=0)
                free[theirs, -3:] += evidence.centre[theirs] - middle
                order = theirs[np.argsort(time_s[theirs], kind="stable")]
                nearest = order[_nearest(time_s[order], time_s[mine])]
                place = [
                    np.interp(time_s[mine], time_s[order], free[order, axis])
                    for axis in (-3, -2, -1)
                ]
                free[mine] = free[nearest]
                free[mine, -3:] = np.stack(place, axis=1)
                angles[mine] = held[np.searchsorted(ok, nearest)]
        targets = EnergyTargets(evidence.xyz - origin[:, None], evidence.information)
        rows = ChainRows(
            self.energy, self.config.kernel_scale, targets, angles, time_s, self.law, faster
        )
        return free, origin, rows, found

    def _solved(
        self, rows: ChainRows, free: Array, segments: list[Segment], known: Shapes, fixed: bool
    ) -> tuple[Array, Shapes]:
        """Solved parameters (B, P), and the posterior shapes (G)."""
        owner = np.array([segment.group for segment in segments])
        if fixed:
            return rows.solved(
                free, segments, known.mean[owner], known.information[owner], fixed=True
            )[0], known
        share = _rows_per_look(rows.time_s, segments, self.config.correlation_s, len(known.mean))
        prior = known.information * share[:, None, None]
        held, firm = known.mean[owner], prior[owner]
        free, betas, said = rows.solved(free, segments, held, firm, fixed=False)
        # Each segment's Gaussian without the prior: information S, and S times its mean; overlaps
        # count once.
        kept = np.array([segment.kept.mean() for segment in segments])[:, None, None]
        pull = kept * ((said + firm) @ betas[..., None] - firm @ held[..., None])
        total, right = prior.copy(), prior @ known.mean[..., None]
        np.add.at(total, owner, kept * said)
        np.add.at(right, owner, pull)
        mean = np.asarray(np.linalg.solve(total, right)[..., 0], dtype=np.float64)
        shapes = Shapes(mean, known.information + (total - prior) / share[:, None, None])
        several = np.bincount(owner, minlength=len(mean)) > 1
        if several.any():
            again = several[owner]
            segments = [segment for segment in segments if several[segment.group]]
            free, *_ = rows.solved(
                free, segments, mean[owner[again]], total[owner[again]], fixed=True
            )
        return free, shapes

    def _fill(
        self,
        fit: BodyFit,
        part: Index,
        body: Array,
        origin: Array,
        rows: ChainRows,
        evidence: Evidence,
    ) -> None:
        """Fill the rows `part` (R,) of `fit` with the bodies `body` (R, P) around `origin` (R,
        3).
        """
        held = Held(body[:, :10], np.full(len(part), SETTLED), rows.angles[part])
        found = self.energy.evaluate(body, rows.targets.rows(part), self.config.kernel_scale, held)
        known, _ = found.covariances()
        xyz, squared = found.xyz, found.squared.sum(-1)
        ok = np.isfinite(xyz).all(axis=(1, 2))
        with np.errstate(divide="ignore", invalid="ignore"):
            residual_m = np.sqrt(squared / evidence.total_information[part])
        fit.status[part] = np.where(ok, FitStatus.OK, FitStatus.NOT_CONVERGED)
        part, origin = part[ok], origin[ok]
        fit.put_bodies(part, self.energy.complete(body[ok]), origin)
        fit.joints[part] = xyz[ok] + origin[:, None]
        fit.covariance[part], fit.residual_m[part] = known[ok], residual_m[ok]


def _rows_per_look(
    time_s: Array, segments: list[Segment], correlation_s: float, count: int
) -> Array:
    """(G,) number of rows of each group per independent look at its shape, given the correlation
    time of errors.
    """
    rows, looks = np.zeros(count), np.zeros(count)
    for segment in segments:
        kept = time_s[segment.rows[segment.kept]]
        rows[segment.group] += len(kept)
        looks[segment.group] += np.ptp(kept) / correlation_s
    return np.maximum(rows / (1 + looks), 1.0)


def _nearest(sorted_s: Array, asked_s: Array) -> Index:
    """(M,) index of the nearest of the sorted times to each of `asked_s` (M,)."""
    after = np.clip(np.searchsorted(sorted_s, asked_s), 0, len(sorted_s) - 1)
    before = np.maximum(after - 1, 0)
    return np.where(
        np.abs(sorted_s[before] - asked_s) <= np.abs(sorted_s[after] - asked_s), before, after
    )
