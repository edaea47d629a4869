"""Likelihood of small changes of cameras, marginalised over persistent biases of the detector.

A detector may have persistent errors: per joint, per person and joint, or a shift or scaling of
whole people in a view. Such biases, and the joints' positions, are unknowns with Gaussian priors.
They are eliminated from the linearised residuals (Schur complements), which leaves the information
about the cameras and the marginal likelihood of the residuals, for each of several sizes of biases.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from shapepose_fg.cameras.check.evidence import SetupHypothesis
from shapepose_fg.cameras.parameters import TURN, Q, by_parameters, placing, seen_by
from shapepose_fg.cameras.sightings import median_over
from shapepose_fg.cameras.triangulation import Structure, observed, triangulate
from shapepose_fg.core.arrays import Array, Index
from shapepose_fg.core.camera import Views

LEVELS = (0.005, 0.01, 0.02, 0.04, 0.08)
"""Standard deviations of a persistent bias of a person's joint in a view, as shares of the person's
size. On four recordings real detectors have 0.0025 to 0.02 (scripts/measure_biases.py)."""
COMMON = (0.1, 1.0, 10.0)
"""Standard deviation of the bias common to all people, relative to that of one person. In one of
the views it may have the largest of these ratios, and 1 in the others."""
SHIFT, LARGER = 1.0, 3.0
"""Standard deviations of the shift of a whole person, and of the relative scaling, over that of a
joint; real ones are 0.3 to 3."""
_INDEPENDENT = 0.1
"""Share of independent detections: errors of a person's joints, and of consecutive frames, are
correlated."""


@dataclass(frozen=True)
class BiasMarginal:
    """Log-likelihood of residuals r = J theta for one size of biases: log + g' theta - theta' H
    theta / 2.
    """

    H: Array
    """(C, C) information about cameras' parameters and individual people's biases
    (`BiasedResiduals`)."""
    g: Array
    """(C,) information vector."""
    log: float
    """Log-likelihood at theta = 0, up to a constant common to all sizes of biases."""


@dataclass(frozen=True)
class BiasedResiduals:
    """Detections of N people in single frames, J joints, V cameras; P identities, K parts of a
    recording.
    """

    xy: Array
    """(N, J, V, 2) undistorted pixels; 0 where there is none."""
    weight: Array
    """(N, J, V) robust weight of each detection, 1 / pixels^2; 0 where there is none."""
    size_px: Array
    """(N, V) the person's size in each picture, pixels."""
    points: Array
    """(N, J, 3) joints, triangulated by the cameras with which people were associated."""
    person: Index
    """(N,) identity of each person, 0 to P - 1."""
    part: Index
    """(N,) part of the recording, 0 to K - 1; cameras may have another rotation in each."""

    @classmethod
    def of(
        cls, seen: tuple[Array, Array, Array], views: Views, person: Index, part: Index
    ) -> "BiasedResiduals":
        """Build residuals from the arrays of `observed`. Robust weights use each residual's
        deviation from its median over the person's frames.
        """
        structure, residual = _with_biases(seen, views, person)
        used = np.isfinite(residual[..., 0])
        used &= used.sum(axis=-1, keepdims=True) >= 2
        weight = _INDEPENDENT * np.where(used, structure.weight, 0.0)
        points = np.where(used.any(axis=-1)[..., None], structure.points, 0.0)
        size = np.nan_to_num(structure.size_px, nan=1.0)
        return cls(np.nan_to_num(seen[0]), weight, size, points, person, part)

    @property
    def parts(self) -> int:
        """Number of parts, K."""
        return _count(self.part)

    def camera(self, view: int, which: list[int], share: Array | float = 1.0) -> Array:
        """(C, n) changes of all columns if one of the parameters `which` of a camera changes
        (`parameters.PARAMETERS`); `share` (K,) scales a rotation in each part of the recording.
        """
        V, K = self.size_px.shape[1], self.parts
        directions = np.zeros((V, Q - 3 + 3 * K, Q))
        for axis in TURN:
            directions[view, Q - 3 + axis :: 3, axis] = share
        directions[view, np.arange(Q - 3), np.arange(3, Q)] = 1.0
        every = directions.reshape(-1, Q)[:, which]
        return np.concatenate([every, np.zeros((3 * V * _count(self.person), len(which)))])

    def of_person(self, person: int, view: int) -> Array:
        """(C, 3) directions of a person's shift right and down, as shares of the size, and of the
        scaling, in a view.
        """
        V, P = self.size_px.shape[1], _count(self.person)
        directions = np.zeros((P, 3 * V, 3))
        directions[person, [2 * view, 2 * view + 1, 2 * V + view], [0, 1, 2]] = 1.0
        cameras = np.zeros((V * (Q - 3 + 3 * self.parts), 3))
        return np.concatenate([cameras, directions.reshape(-1, 3)])

    def marginals(
        self,
        views: Views,
        levels: Sequence[float] = LEVELS,
        shift: float = SHIFT,
        larger: float = LARGER,
        common: Sequence[float | Array] | None = None,
    ) -> list[BiasMarginal]:
        """Marginal likelihoods around the cameras `views` for each size of biases: `levels`, each
        with all ratios `common`, of all views or of each (V,), by default those of `COMMON`.
        """
        information = self._information(views)
        if common is None:
            common = [*COMMON, *np.where(np.eye(len(views)) > 0, COMMON[-1], 1.0)]
        return [
            each
            for n in levels
            for each in self._marginals(information, n, shift * n, larger * n, common)
        ]

    def _rows(self, views: Views) -> Array:
        """(N, J, 2 V, n) derivatives of residuals by cameras, the joint's bias and the scaling, and
        the residuals.

        All are weighted, with the joint's position eliminated.
        """
        N, J, V = self.weight.shape
        points, root = self.points, np.sqrt(self.weight)[..., None, None]
        for _ in range(3):
            projected, at, by_point = seen_by(points, views)
            r = (self.xy - projected)[..., None] * root
            A = (by_point @ views.cTw[:, :, :3] * root).reshape(N, J, 2 * V, 3)
            inverse = placing(A)
            points = points + (inverse @ r.reshape(N, J, 2 * V, 1))[..., 0]
        seen = self.weight[..., None] > 0
        middle = np.where(seen, self.xy, 0.0).sum(axis=1) / np.maximum(seen.sum(axis=1), 1)
        rows, bias = np.zeros((N, J, V, 2, V * (Q + 3) + 1)), V * Q
        of_cameras = by_parameters(projected, at, by_point, views)
        for v in range(V):
            rows[:, :, v, :, v * Q : v * Q + Q] = of_cameras[:, :, v]
            rows[:, :, v, :, bias + 2 * v : bias + 2 * v + 2] = (
                np.eye(2) * self.size_px[:, None, v, None, None]
            )
            rows[:, :, v, :, bias + 2 * V + v] = self.xy[:, :, v] - middle[:, None, v]
        rows[..., -1:] = self.xy[..., None] - projected[..., None]
        rows = (rows * root).reshape(N, J, 2 * V, -1)
        return rows - A @ (inverse @ rows)

    def _information(self, views: Views) -> Array:
        """(P, J, n, n) normal matrices of the rows of each person's joint, with a rotation per
        part.
        """
        rows, V, J, K = self._rows(views), len(views), self.weight.shape[1], self.parts
        found = np.zeros((_count(self.person), J, *[V * (Q - 3 + 3 * K) + 3 * V + 1] * 2))
        for person, part in sorted({*zip(self.person.tolist(), self.part.tolist(), strict=True)}):
            selected = (
                rows[(self.person == person) & (self.part == part)]
                .swapaxes(0, 1)
                .reshape(J, -1, rows.shape[-1])
            )
            turn, rest = Q - 3 + 3 * part + np.arange(3), np.arange(Q - 3)
            cameras = (
                np.arange(V)[:, None] * (Q - 3 + 3 * K) + np.concatenate([turn, rest])
            ).ravel()
            at = np.concatenate([cameras, V * (Q - 3 + 3 * K) + np.arange(3 * V + 1)])
            found[person][:, at[:, None], at] += selected.swapaxes(1, 2) @ selected
        return found

    def _marginals(
        self,
        information: Array,
        level: float,
        shift: float,
        larger: float,
        ratios: Sequence[float | Array],
    ) -> list[BiasMarginal]:
        """Marginals for each of the common biases' `ratios`, with biases of these standard
        deviations.
        """
        P, J, _, V = *information.shape[:3], self.size_px.shape[1]
        C = V * (Q - 3 + 3 * self.parts)
        own, people = slice(C, C + 2 * V), slice(C, C + 3 * V * P)
        # The joints' common biases, and what they have in common with cameras, people's shifts and
        # scalings, and the residual. A joint's bias is the sum of the person's own, the shift of
        # the whole person, and the common bias.
        whole, log = np.zeros((people.stop + 1, people.stop + 1)), 0.0
        common, across = np.zeros((J, 2 * V, 2 * V)), np.zeros((J, 2 * V, len(whole)))
        for person in range(P):
            of_own = information[person][:, own]
            known = of_own[:, :, own] + np.eye(2 * V) / level**2
            left = information[person] - of_own.mT @ (np.linalg.inv(known) @ of_own)
            log -= 0.5 * float(np.linalg.slogdet(known * level**2)[1].sum())
            columns = np.arange(C + 3 * V * person, C + 3 * V * (person + 1))
            at = np.concatenate([np.arange(C), columns, [people.stop]])
            common += left[:, own, own]
            across[:, :, at] += left[:, own]
            whole[at[:, None], at] += left.sum(axis=0)
        prior, found = np.tile(np.repeat([shift**-2, larger**-2], [2 * V, V]), P), []
        for ratio in ratios:
            size = level * np.repeat(np.broadcast_to(ratio, V), 2)
            known = common + np.diag(size**-2)
            solved = np.linalg.inv(known) @ across
            rest = whole - across.reshape(-1, len(whole)).T @ solved.reshape(-1, len(whole))
            shared = rest[people, people] + np.diag(prior)
            rest -= rest[:, people] @ np.linalg.solve(shared, rest[people])
            spread = np.linalg.slogdet(known * size[:, None] * size)[1].sum()
            spread += np.linalg.slogdet(shared / prior)[1]
            likely = log - 0.5 * float(spread + rest[-1, -1])
            found.append(BiasMarginal(rest[:-1, :-1], rest[:-1, -1], likely))
        return found


def _with_biases(
    seen: tuple[Array, Array, Array], views: Views, person: Index
) -> tuple[Structure, Array]:
    """Joints triangulated from the arrays of `observed`, corrected for persistent biases; and the
    residuals (N, J, V, 2) of the uncorrected detections, as shares of the size, NaN if not used.

    A bias is the median residual over the frames of a person, joint and view.
    """
    xy, confidence, size = seen
    scale, lasting = np.nan_to_num(size, nan=1.0)[:, None, :, None], np.zeros_like(xy)
    for _ in range(4):
        structure = triangulate(xy - lasting, confidence, size, views, 4)
        used = (structure.weight > 0) & np.isfinite(structure.miss_px) & (structure.depth > 0)
        residual = (xy - seen_by(structure.points, views)[0]) / scale
        residual[~used] = np.nan
        for each in range(_count(person)):
            rows = person == each
            lasting[rows] = median_over(residual[rows]) * scale[rows]
    return structure, residual


def without_biases(setup: SetupHypothesis) -> SetupHypothesis:
    """The set-up without the persistent bias of each joint in each view that people have in common.

    Such a bias along the motion of a person looks like an offset in time.
    """
    groups = setup.groups()
    if len(groups) == 0:
        return setup
    seen = observed(groups, setup.sightings)
    common = median_over(_with_biases(seen, setup.views, np.zeros(len(groups), np.intp))[1])
    every = setup.evidence.sightings
    xy = every.xy - every.size_px[:, None, None] * common.swapaxes(0, 1)[every.view]
    return replace(setup, evidence=replace(setup.evidence, sightings=replace(every, xy=xy)))


def _count(number: Index) -> int:
    return int(number.max(initial=-1)) + 1
