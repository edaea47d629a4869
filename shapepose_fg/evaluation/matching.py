"""Who is who: predicted people matched with true ones, frame by frame, so that the joint errors are least."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from shapepose_fg.core.skeleton import BODY_25

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
class PlainPeople:
    """N rows, one per person and frame, of which nothing but joints is known; implements `People`."""

    frame: NDArray[np.int64]
    """(N,) frame of each row."""
    joints: NDArray[np.float64]
    """(N, J, 3) joints of each row, metres in the world, NaN where unknown."""
    person: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    """(N,) identity, or the number within the frame; empty where there is none."""
    joint_names: tuple[str, ...] = BODY_25.joints
    """(J,) names."""


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
) -> Matches:
    """Match predictions `joints` (N, J, 3) of `frame` (N,) with `truth` (T, P, J, 3), all in metres.

    `frames` (T,) numbers the frames of the truth, 0 to T - 1 by default; predictions of other frames are left
    out, as are predictions and true people without any joint. The cost of a pair is its `mean_distance`; the
    assignment is the best one of each frame (Hungarian), pairs of 0.5 m or more are none.
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
    is_there = np.isfinite(true.sum(axis=3)).any(axis=2)
    pairs, missed = list[tuple[int, int, int]](), list[tuple[int, int]]()
    duplicated, invented = list[int](), list[int]()
    for index, number in enumerate(numbers):
        rows, people = np.flatnonzero((np.asarray(frame) == number) & has_joint), np.flatnonzero(is_there[index])
        cost = mean_distance(predicted[rows, None], true[index, people])
        # Beyond the bound all pairs are equally none: a far one must not decide about the near ones.
        at_row, at_person = linear_sum_assignment(np.minimum(cost, MAX_DISTANCE_M))
        near = cost[at_row, at_person] < MAX_DISTANCE_M
        at_row, at_person = at_row[near], at_person[near]
        pairs += [(row, index, who) for row, who in zip(rows[at_row], people[at_person], strict=True)]
        missed += [(index, who) for who in np.setdiff1d(people, people[at_person])]
        for left in np.setdiff1d(np.arange(len(rows)), at_row):
            (duplicated if (cost[left] < MAX_DISTANCE_M).any() else invented).append(int(rows[left]))
    row, at, who = np.array(pairs, dtype=np.intp).reshape(-1, 3).T
    twice, nowhere = (np.array(each, dtype=np.intp) for each in (duplicated, invented))
    return Matches(row, at, who, twice, nowhere, np.array(missed, dtype=np.intp).reshape(-1, 2))


def mean_distance(predicted: NDArray[np.float64], truth: NDArray[np.float64]) -> NDArray[np.float64]:
    """Mean joint distance (...) in metres of pairs of people: `predicted` and `truth` (..., J, 3) broadcast.

    A joint that only the prediction lacks counts 0.5 m, one that the truth lacks counts nothing; infinite for a
    person without joints.
    """
    distance = np.linalg.norm(predicted - truth, axis=-1)
    known = np.isfinite(truth).all(axis=-1)
    distance = np.where(known, np.where(np.isfinite(distance), distance, MAX_DISTANCE_M), 0.0).sum(axis=-1)
    count = known.sum(axis=-1)
    return np.where(count > 0, distance / np.maximum(count, 1), np.inf)
