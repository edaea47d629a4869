"""Multi-object tracking metrics from similarities: CLEAR MOT, IDF1 and HOTA.

- CLEAR MOT: Bernardin and Stiefelhagen, "Evaluating Multiple Object Tracking Performance", 2008.
- IDF1: Ristani et al., "Performance Measures and a Data Set for Multi-Target, Multi-Camera
  Tracking", 2016.
- HOTA: Luiten et al., "HOTA: A Higher Order Metric for Evaluating Multi-Object Tracking", 2021.

Ties and thresholds are treated as in the package `trackeval`, which gives the same numbers.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment

from shapepose_fg.core.arrays import Array, Index, Whole
from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.evaluation.metrics import MAX_DISTANCE_M, mean_distance, share

ALPHAS = np.arange(0.05, 0.99, 0.05)
"""(19,) similarity thresholds over which HOTA is averaged."""
MATCHED = 0.5
"""Least similarity of a match in MOTA and IDF1."""
_EPSILON = np.finfo(np.float64).eps


class TrackFrame(NamedTuple):
    """One frame: identities of the M true and N predicted people, and how similar they are."""

    true: Whole
    """(M,) identities of the true people, each once."""
    predicted: Whole
    """(N,) identities of the predictions, each once."""
    similarity: Array
    """(M, N) similarities, 0 to 1."""

    @classmethod
    def of(cls, truth: Reconstruction, people: Reconstruction) -> "TrackFrame":
        """The people of one frame: similarity 1 - d / 1 m with the distance d of `mean_distance`,
        so that `MATCHED` is 0.5 m.
        """
        distance = mean_distance(people.joints, truth.joints[:, None])
        similarity = np.maximum(0, 1 - distance / (2 * MAX_DISTANCE_M))
        return cls(truth.person, people.person, similarity)


@dataclass(frozen=True)
class TrackMetrics:
    """Result of `track_metrics`; shares are NaN if there is nothing to measure."""

    mota: float
    """1 - (false positives + misses + switches) / true people (CLEAR MOT); may be negative."""
    idf1: float
    """2 IDTP / (predictions + true people)."""
    hota: float
    """Mean over `ALPHAS` of sqrt(DetA AssA)."""
    det_a: float
    """Detection accuracy: TP / (TP + FN + FP), mean over `ALPHAS`."""
    ass_a: float
    """Association accuracy: mean over TP of TPA / (TPA + FNA + FPA), mean over `ALPHAS`."""
    loc_a: float
    """Localisation accuracy: mean similarity of TP, mean over `ALPHAS`."""
    true: int
    """Number of true people over all frames."""
    predicted: int
    """Number of predictions over all frames."""
    misses: int
    """Number of true people without a match (CLEAR MOT)."""
    false_positives: int
    """Number of predictions without a match (CLEAR MOT)."""
    switches: int
    """Number of matches with another identity than the person's last match (CLEAR MOT)."""


def track_metrics(frames: Iterable[TrackFrame]) -> TrackMetrics:
    """Compute the metrics of a recording; ValueError for an identity twice in one frame."""
    given = list(frames)
    none = np.zeros(0, dtype=np.int64)
    names = [
        np.unique(np.concatenate([none, *(frame[side] for frame in given)])) for side in (0, 1)
    ]
    every = list[tuple[Index, Index, Array]]()
    for frame in given:
        for ids in (frame.true, frame.predicted):
            if len(np.unique(ids)) < len(ids):
                raise ValueError("an identity occurs twice in one frame; give each person one row")
        true, predicted = (np.searchsorted(names[side], frame[side]) for side in (0, 1))
        every.append((true, predicted, frame.similarity.reshape(len(true), len(predicted))))
    counts = [
        np.bincount(np.concatenate([none, *(each[side] for each in every)]), minlength=len(known))
        for side, known in enumerate(names)
    ]
    total, given_rows = int(counts[0].sum()), int(counts[1].sum())
    together = np.zeros((len(names[0]), len(names[1])), dtype=np.int64)
    for true, predicted, similarity in every:
        together[np.ix_(true, predicted)] += similarity >= MATCHED
    identity_tp = int(together[linear_sum_assignment(together, maximize=True)].sum())
    matched, switches = _clear(every, len(names[0]))
    lost, false = total - matched, given_rows - matched
    hota, det_a, ass_a, loc_a = _hota(every, counts[0], counts[1])
    mota = 1 - (lost + false + switches) / total if total > 0 else float("nan")
    idf1 = share(2 * identity_tp, total + given_rows)
    return TrackMetrics(
        mota, idf1, hota, det_a, ass_a, loc_a, total, given_rows, lost, false, switches
    )


def _clear(every: list[tuple[Index, Index, Array]], people: int) -> tuple[int, int]:
    """Numbers of matches and of switches.

    A pair that was matched in the previous frame stays matched while its similarity is at least
    `MATCHED`; among the others the total similarity is maximal.
    """
    last, previous = np.full(people, -1), np.full(people, -1)
    matched = switches = 0
    for true, predicted, similarity in every:
        if similarity.size == 0:
            continue
        score = 1000.0 * (predicted == previous[true][:, None]) + similarity
        score[similarity < MATCHED - _EPSILON] = 0
        row, column = linear_sum_assignment(score, maximize=True)
        hit = score[row, column] > 0
        true_id, predicted_id = true[row[hit]], predicted[column[hit]]
        switches += int(((last[true_id] >= 0) & (last[true_id] != predicted_id)).sum())
        matched += len(true_id)
        previous[:] = -1
        last[true_id] = previous[true_id] = predicted_id
    return matched, switches


def _hota(
    every: list[tuple[Index, Index, Array]], true_count: Whole, predicted_count: Whole
) -> tuple[float, float, float, float]:
    """HOTA, DetA, AssA and LocA; `true_count` (P,) and `predicted_count` (Q,) are the numbers of
    frames of each identity.
    """
    if len(true_count) == 0 or len(predicted_count) == 0:
        empty = float("nan") if len(true_count) == len(predicted_count) else 0.0
        return empty, empty, empty, float("nan")
    both = true_count[:, None] + predicted_count
    overlap = np.zeros(both.shape)
    for true, predicted, similarity in every:
        whole = similarity.sum(axis=0) + similarity.sum(axis=1, keepdims=True) - similarity
        overlap[np.ix_(true, predicted)] += similarity / np.where(whole > _EPSILON, whole, np.inf)
    alignment = overlap / (both - overlap)
    hits, similar = np.zeros((len(ALPHAS), *both.shape)), np.zeros(len(ALPHAS))
    for true, predicted, similarity in every:
        score = alignment[np.ix_(true, predicted)] * similarity
        row, column = linear_sum_assignment(score, maximize=True)
        value = similarity[row, column]
        hit = value >= ALPHAS[:, None] - _EPSILON
        hits[:, true[row], predicted[column]] += hit
        similar += (hit * value).sum(axis=1)
    found = hits.sum(axis=(1, 2))
    det_a = found / (true_count.sum() + predicted_count.sum() - found)
    ass_a = (hits**2 / (both - hits)).sum(axis=(1, 2)) / np.maximum(found, 1)
    loc_a = np.where(found > 0, similar / np.maximum(found, 1), 1)
    hota = np.sqrt(det_a * ass_a)
    return float(hota.mean()), float(det_a.mean()), float(ass_a.mean()), float(loc_a.mean())
