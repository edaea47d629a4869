"""Part affinities between simulated candidates: high inside a person, and where another's limb passes close by."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, ndtri

from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.simulation.detector_statistics import LIMB_GROUP, DetectorStatistics
from shapepose_fg.simulation.memory import Table

Array = NDArray[np.float64]

_A, _B = np.array(BODY_25.limbs).T
_LEAST_LENGTH_PX = 8.0
"""Limbs that are seen from their end count as long as this."""


@dataclass(frozen=True)
class Candidates(Table):
    """Candidates while they are made: D of them."""

    view: NDArray[np.intp]
    joint: NDArray[np.intp]
    xy: Array
    confidence: Array
    owner: NDArray[np.bool_]
    """(D, P) whose joint a candidate is; none's where it is false, two people's where two are one."""
    reach_px: Array
    """(D,) nearer than this to a better candidate of the same joint it is not seen as one of its own."""


def affinities(
    found: Candidates,
    true_xy: Array,
    captors: NDArray[np.intp],
    statistics: DetectorStatistics,
    *,
    doubt: float,
    wrong: float,
    rng: np.random.Generator,
) -> tuple[NDArray[np.intp], Array]:
    """Pairs (E, 2) of D candidates and their affinities (E,), those above 0.

    `true_xy` (V, P, 25, 2) is where joints truly are, `captors` (2, V, P, 25) who stands before a missed joint and
    has, or has not, captured it. A right pair's affinity goes with the lower of its confidences. A wrong pair's
    goes with the detour: the distance of its wrong end from the right one, in limb lengths. `doubt` and `wrong`
    are the knobs of `DetectorConfig`.
    """
    view, joint, owner = found.view, found.joint, found.owner
    first, second, limb = _pairs(view, joint, len(true_xy))
    right = np.any(owner[first] & owner[second], axis=1)
    affinity = np.zeros(len(first))
    a, b, group = first[right], second[right], LIMB_GROUP[limb[right]]
    lower = np.minimum(found.confidence[a], found.confidence[b])
    rank = statistics.probability(statistics.affinity_right_confidence[group], lower)
    rho = statistics.affinity_correlation
    score = rho * ndtri(np.clip(rank, 1e-3, 1 - 1e-3)) + np.sqrt(1 - rho**2) * rng.standard_normal(len(a))
    drawn = statistics.quantile(statistics.affinity_right[group], ndtr(score))
    affinity[right] = 1.0 + doubt * (drawn - 1.0)
    a, b = first[~right], second[~right]
    detour = np.minimum(_detour(found, a, b, true_xy), _detour(found, b, a, true_xy))
    false = ~np.logical_and(owner[a].any(axis=1), owner[b].any(axis=1))
    kind = np.clip(np.searchsorted(statistics.detours, detour, side="right") - 1, 0, len(statistics.detours) - 1)
    share = np.where(false, statistics.affinity_nobody_share[kind], statistics.affinity_wrong_share[kind])
    table = np.where(false[:, None], statistics.affinity_nobody[kind], statistics.affinity_wrong[kind])
    listed = rng.random(len(a)) < share * wrong
    if owner.shape[1] > 0:
        p, q = owner[a].argmax(axis=1), owner[b].argmax(axis=1)
        by_q, by_p = captors[:, view[a], p, joint[b]] == q, captors[:, view[a], q, joint[a]] == p
        captured, refused = np.logical_or(by_q, by_p)
        listed = np.where(false, listed, (listed & ~refused) | captured)
    affinity[~right] = np.where(listed, statistics.quantile(table, rng.random(len(a))), 0.0)
    used = affinity > 0
    return np.stack([first, second], axis=1)[used], affinity[used]


def _pairs(
    view: NDArray[np.intp], joint: NDArray[np.intp], views: int
) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp]]:
    """All pairs (E,), (E,) of candidates of one view that a limb joins, and the limb (E,)."""
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


def _detour(found: Candidates, near: NDArray[np.intp], far: NDArray[np.intp], true_xy: Array) -> Array:
    """(E,) how far candidates `far` are from that joint of those who own `near`, in limb lengths, or inf."""
    if found.owner.shape[1] == 0:
        return np.full(len(near), np.inf)
    view, owner = found.view[near], found.owner[near]
    person = owner.argmax(axis=1)
    right_end = true_xy[view, person, found.joint[far]]
    length = np.linalg.norm(right_end - true_xy[view, person, found.joint[near]], axis=-1)
    detour = np.linalg.norm(found.xy[far] - right_end, axis=-1) / np.maximum(length, _LEAST_LENGTH_PX)
    return np.where(owner.any(axis=1), np.nan_to_num(detour, nan=np.inf), np.inf)
