"""Who is who: predicted people matched with true ones, frame by frame, so that the joint errors are least."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

MAX_DISTANCE_M = 0.5
"""Metres. A prediction this far from a person, in the mean over joints, is not that person."""


class People(Protocol):
    """What is scored: a `Reconstruction`, or anything with its two arrays."""

    @property
    def frame(self) -> NDArray[np.integer]:
        """(N,) frame of each row."""
        ...

    @property
    def joints(self) -> NDArray[np.floating]:
        """(N, J, 3) joints of each row, metres, NaN where unknown."""
        ...


@dataclass(frozen=True)
class Matches:
    """M predictions that are people, and the people and predictions that are left over."""

    row: NDArray[np.intp]
    """(M,) row of the prediction."""
    frame: NDArray[np.intp]
    """(M,) index of the frame in the truth."""
    person: NDArray[np.intp]
    """(M,) index of the person in the truth."""
    duplicated: NDArray[np.intp]
    """Rows of predictions near a person who is matched with another prediction."""
    invented: NDArray[np.intp]
    """Rows of predictions that are near no person."""
    missed: NDArray[np.intp]
    """(K, 2) frame and person of the people who are matched with no prediction."""


def match_people(
    frame: NDArray[np.integer],
    joints: NDArray[np.floating],
    truth: NDArray[np.floating],
    frames: Sequence[int] | range | None = None,
    *,
    max_distance_m: float = MAX_DISTANCE_M,
) -> Matches:
    """Match predictions `joints` (N, J, 3) of `frame` (N,) with `truth` (T, P, J, 3), all in metres.

    `frames` (T,) numbers the frames of the truth, 0 to T - 1 by default; predictions of other frames are left
    out, as are predictions and true people without any joint. The cost of a pair is its mean joint distance
    over the joints that the truth knows, a joint missing (NaN) in the prediction counting `max_distance_m`;
    the assignment is the best one of each frame (Hungarian), pairs of `max_distance_m` or more are none.
    """
    predicted, true = np.asarray(joints, dtype=np.float64), np.asarray(truth, dtype=np.float64)
    if true.ndim != 4 or true.shape[3] != 3:
        raise ValueError(f"truth must be (T, P, J, 3), got {true.shape}")
    if predicted.shape != (len(frame), *true.shape[2:]):
        raise ValueError(f"joints must be ({len(frame)}, {true.shape[2]}, 3), got {predicted.shape}")
    numbers = range(len(true)) if frames is None else frames
    if len(numbers) != len(true):
        raise ValueError(f"frames must number the {len(true)} frames of the truth, got {len(numbers)}")
    has_joint = np.isfinite(predicted.sum(axis=2)).any(axis=1)
    parts = [
        _match_frame(
            index, np.flatnonzero((np.asarray(frame) == number) & has_joint), predicted, true, max_distance_m
        )
        for index, number in enumerate(numbers)
    ]
    pairs, duplicated, invented, missed = (
        np.concatenate([part[i] for part in parts]) if parts else empty for i, empty in enumerate(_NOTHING)
    )
    return Matches(pairs[:, 0], pairs[:, 1], pairs[:, 2], duplicated, invented, missed)


def mean_distance(
    predicted: NDArray[np.float64], truth: NDArray[np.float64], missing_m: float = MAX_DISTANCE_M
) -> NDArray[np.float64]:
    """Mean joint distance (N, P) in metres between N predictions (N, J, 3) and P people (P, J, 3).

    A joint that only the prediction lacks counts `missing_m`, one that the truth lacks counts nothing; infinite
    for a person without joints.
    """
    return pair_distance(predicted[:, None], truth[None], missing_m)


def pair_distance(
    predicted: NDArray[np.float64], truth: NDArray[np.float64], missing_m: float = MAX_DISTANCE_M
) -> NDArray[np.float64]:
    """The `mean_distance` (...) of pairs that are named: `predicted` and `truth` (..., J, 3) broadcast."""
    distance = np.linalg.norm(predicted - truth, axis=-1)
    known = np.isfinite(truth).all(axis=-1)
    distance = np.where(known, np.where(np.isfinite(distance), distance, missing_m), 0.0).sum(axis=-1)
    count = known.sum(axis=-1)
    return np.where(count > 0, distance / np.maximum(count, 1), np.inf)


_NOTHING = (
    np.zeros((0, 3), dtype=np.intp),
    np.zeros(0, dtype=np.intp),
    np.zeros(0, dtype=np.intp),
    np.zeros((0, 2), dtype=np.intp),
)
"""Pairs, duplicated, invented and missed of no frames."""


def _match_frame(
    index: int,
    rows: NDArray[np.intp],
    predicted: NDArray[np.float64],
    truth: NDArray[np.float64],
    max_distance_m: float,
) -> tuple[NDArray[np.intp], ...]:
    """Pairs (row, frame, person), duplicated rows, invented rows, missed (frame, person) of one frame."""
    people = np.flatnonzero(np.isfinite(truth[index].sum(axis=2)).any(axis=1))
    cost = mean_distance(predicted[rows], truth[index, people], max_distance_m)
    # Beyond the bound all pairs are equally none: a far one must not decide about the near ones.
    at_row, at_person = linear_sum_assignment(np.minimum(cost, max_distance_m))
    near = cost[at_row, at_person] < max_distance_m
    at_row, at_person = at_row[near], at_person[near]
    left = np.setdiff1d(np.arange(len(rows)), at_row)
    duplicate = (cost[left] < max_distance_m).any(axis=1)
    missing = np.setdiff1d(people, people[at_person])
    return (
        np.stack([rows[at_row], np.full(len(at_row), index), people[at_person]], axis=1),
        rows[left[duplicate]],
        rows[left[~duplicate]],
        np.stack([np.full(len(missing), index), missing], axis=1),
    )
