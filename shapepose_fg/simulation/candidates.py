"""Candidates of a simulated detector: temporally correlated errors, false candidates, part
affinities.

The processes are stationary and advance frame by frame from the first one. Each frame has its own
generator, seeded by seed and frame number, so that skipped frames do not change later ones.
Affinities are high within a person, and where another person's limb passes close by.
"""

from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr, ndtri

from shapepose_fg.core.arrays import Array, Index, Mask
from shapepose_fg.core.decompositions import symmetric_root
from shapepose_fg.core.rows import Rows
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.simulation.detector_statistics import JOINT_GROUP, LIMB_GROUP, DetectorStatistics


class NoiseProcess:
    """Seven standard normal processes for every view, person and joint: fast and slow AR(1), and
    white noise.
    """

    ERROR_X, ERROR_Y, CONFIDENCE, SCALE, SWAP, CAPTURE, LOST = range(7)

    def __init__(
        self, views: int, people: int, fps: float, statistics: DetectorStatistics, seed: int
    ) -> None:
        self._seed = seed
        self._shape = (7, 3, views, people, 25)
        memory = np.stack(
            [statistics.error_memory] * 2
            + [statistics.confidence_memory] * 4
            + [statistics.lost_memory]
        )
        share, seconds = memory[..., 0], memory[..., 1]
        self._keep = np.exp(-1.0 / (fps * seconds))[..., None, None, None]
        self._amplitude = np.sqrt(share)[..., None, None, None]
        self._white = np.sqrt(np.maximum(1.0 - share.sum(axis=1), 0.0))[:, None, None, None]
        correlations = (
            statistics.error_correlation,
            statistics.confidence_correlation,
            statistics.lost_correlation,
        )
        self._mix = [_root(each) for each in correlations]
        self._state: Array | None = None

    def next(self, frame: int) -> Array:
        """(7, V, P, 25) values for `frame`; must be called for every frame, in order."""
        fresh = np.random.default_rng([self._seed, frame, 0]).standard_normal(self._shape)
        fresh[:2] = fresh[:2] @ self._mix[0]
        fresh[self.CONFIDENCE] = fresh[self.CONFIDENCE] @ self._mix[1]
        fresh[self.LOST] = fresh[self.LOST] @ self._mix[2]
        new = fresh[:, :2]
        if self._state is None:
            self._state = new
        else:
            self._state = self._keep * self._state + np.sqrt(1.0 - self._keep**2) * new
        return (self._amplitude * self._state).sum(axis=1) + self._white * fresh[:, 2]


@dataclass(frozen=True)
class FalseCandidates(Rows):
    """The F false candidates of the current frame."""

    view: Index
    person: Index
    """(F,) index of the person that a false candidate moves with; -1 for none."""
    anchor: Index
    """(F,) joint relative to which a false candidate is fixed."""
    joint: Index
    """(F,) joint that a false candidate is reported as."""
    offset: Array
    """(F, 2) offset from the anchor, metres, or position as a share of the image."""
    rank: Array
    """(F,) quantile of the confidence of a false candidate."""
    stays: Array
    """(F,) probability that a false candidate persists to the next frame."""


class FalseCandidateProcess:
    """False candidates: some move with a person, some are static; some last one frame,
    some longer.
    """

    def __init__(
        self,
        views: int,
        people: int,
        fps: float,
        statistics: DetectorStatistics,
        seed: int,
        rate: float,
    ) -> None:
        self._views, self._people, self._statistics, self._seed = views, people, statistics, seed
        near, far = (
            statistics.false_near * people * views * rate,
            statistics.false_far * views * rate,
        )
        share, seconds = statistics.false_memory.T
        # The share of a group, divided by its members.
        claims = statistics.false_joints[JOINT_GROUP] / np.bincount(JOINT_GROUP)[JOINT_GROUP]
        self._claims = claims / claims.sum()
        self._stays = np.append(np.exp(-1.0 / (fps * seconds)), 0.0)
        # Expected numbers present at any time; births balance deaths.
        self._present = np.append(share, max(1.0 - share.sum(), 0.0))[:, None] * np.array(
            [near, far]
        )
        self._present_now: FalseCandidates | None = None

    def next(self, frame: int) -> FalseCandidates:
        """The false candidates of `frame`; must be called for every frame, in order."""
        rng = np.random.default_rng([self._seed, frame, 1])
        if self._present_now is None:
            self._present_now = self._born(rng, self._present)
        else:
            staying = self._present_now.rows(
                rng.random(len(self._present_now)) < self._present_now.stays
            )
            born = self._born(rng, self._present * (1.0 - self._stays)[:, None])
            self._present_now = FalseCandidates.concatenate([staying, born])
        return self._present_now

    def _born(self, rng: np.random.Generator, rate: Array) -> FalseCandidates:
        """Draw new false candidates with Poisson `rate` (3, 2): by duration, near people and
        elsewhere.
        """
        kind = np.repeat(np.arange(6), rng.poisson(rate).ravel())
        stays, far = self._stays[kind // 2], kind % 2 == 1
        count = len(kind)
        distance = self._statistics.quantile(self._statistics.false_near_m, rng.random(count))
        angle = rng.uniform(0.0, 2 * np.pi, count)
        around = distance[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        return FalseCandidates(
            view=rng.integers(0, self._views, count),
            person=np.where(far, -1, rng.integers(0, max(self._people, 1), count)),
            anchor=rng.integers(0, 25, count),
            joint=rng.choice(25, count, p=self._claims),
            offset=np.where(far[:, None], rng.random((count, 2)), around),
            rank=rng.random(count),
            stays=stays,
        )


def _root(correlation: Array) -> Array:
    """Matrix that correlates independent rows (..., 25) when multiplied from the right; rounding
    errors are tolerated.
    """
    root = symmetric_root(correlation)
    return (root / np.linalg.norm(root, axis=1, keepdims=True)).T


_A, _B = np.array(BODY_25.limbs).T


@dataclass(frozen=True)
class Candidates(Rows):
    """D candidates during generation."""

    view: Index
    joint: Index
    xy: Array
    confidence: Array
    owner: Mask
    """(D, P) people to whom a candidate belongs; none if it is false, two if two joints merged."""
    reach_px: Array
    """(D,) distance to a better candidate of the same joint below which a candidate is suppressed,
    pixels."""


def affinities(
    found: Candidates,
    true_xy: Array,
    captors: Index,
    statistics: DetectorStatistics,
    *,
    doubt: float,
    wrong: float,
    rng: np.random.Generator,
) -> tuple[Index, Array]:
    """Pairs (E, 2) of D candidates with positive affinities (E,).

    `true_xy` (V, P, 25, 2) are the true joints, `captors` (2, V, P, 25) the people in front of a
    missed joint who captured it, or did not. The affinity of a correct pair is correlated with the
    lower of its confidences; that of a wrong pair with the detour, the distance of its wrong end
    from the correct one in limb lengths. `doubt` and `wrong` are settings of `DetectorConfig`.
    """
    view, joint, owner = found.view, found.joint, found.owner
    first, second, limb = _pairs(view, joint, len(true_xy))
    right = np.any(owner[first] & owner[second], axis=1)
    affinity = np.zeros(len(first))
    a, b, group = first[right], second[right], LIMB_GROUP[limb[right]]
    lower = np.minimum(found.confidence[a], found.confidence[b])
    rank = statistics.probability(statistics.affinity_right_confidence[group], lower)
    rho = statistics.affinity_correlation
    score = rho * ndtri(np.clip(rank, 1e-3, 1 - 1e-3)) + np.sqrt(1 - rho**2) * rng.standard_normal(
        len(a)
    )
    drawn = statistics.quantile(statistics.affinity_right[group], ndtr(score))
    affinity[right] = 1.0 + doubt * (drawn - 1.0)
    a, b = first[~right], second[~right]
    detour = np.minimum(_detour(found, a, b, true_xy), _detour(found, b, a, true_xy))
    false = ~np.logical_and(owner[a].any(axis=1), owner[b].any(axis=1))
    kind = np.clip(
        np.searchsorted(statistics.detours, detour, side="right") - 1,
        0,
        len(statistics.detours) - 1,
    )
    share = np.where(
        false, statistics.affinity_nobody_share[kind], statistics.affinity_wrong_share[kind]
    )
    table = np.where(
        false[:, None], statistics.affinity_nobody[kind], statistics.affinity_wrong[kind]
    )
    listed = rng.random(len(a)) < share * wrong
    if owner.shape[1] > 0:
        p, q = owner[a].argmax(axis=1), owner[b].argmax(axis=1)
        by_q, by_p = captors[:, view[a], p, joint[b]] == q, captors[:, view[a], q, joint[a]] == p
        captured, refused = np.logical_or(by_q, by_p)
        listed = np.where(false, listed, (listed & ~refused) | captured)
    affinity[~right] = np.where(listed, statistics.quantile(table, rng.random(len(a))), 0.0)
    used = affinity > 0
    return np.stack([first, second], axis=1)[used], affinity[used]


def _pairs(view: Index, joint: Index, views: int) -> tuple[Index, Index, Index]:
    """All pairs (E,), (E,) of candidates of a view at the ends of a limb, and the limb (E,)."""
    label = view * 25 + joint
    order = np.argsort(label, kind="stable")
    count = np.bincount(label, minlength=views * 25)
    start = np.cumsum(count) - count
    most = int(count.max(initial=0))
    table = np.full((views * 25, most), -1, dtype=np.intp)
    table[label[order], np.arange(len(order)) - start[label[order]]] = order
    table = table.reshape(views, 25, most)
    both = (table[:, _A, :, None] >= 0) & (table[:, _B, None, :] >= 0)
    v, limb, i, j = np.nonzero(both)
    return table[v, _A[limb], i], table[v, _B[limb], j], limb


def _detour(found: Candidates, near: Index, far: Index, true_xy: Array) -> Array:
    """(E,) distance of each candidate `far` from the true joint, of the same kind, of the person
    who owns the candidate `near`, in limb lengths; infinite if that has no owner.
    """
    if found.owner.shape[1] == 0:
        return np.full(len(near), np.inf)
    view, owner = found.view[near], found.owner[near]
    person = owner.argmax(axis=1)
    right_end = true_xy[view, person, found.joint[far]]
    length = np.linalg.norm(right_end - true_xy[view, person, found.joint[near]], axis=-1)
    # Minimum length of a limb in the image, pixels; for limbs seen along their axis.
    detour = np.linalg.norm(found.xy[far] - right_end, axis=-1) / np.maximum(length, 8.0)
    return np.where(owner.any(axis=1), np.nan_to_num(detour, nan=np.inf), np.inf)
