"""Metrics of joints against ground truth: matching, precision, recall, MPJPE, detected people,
covariances.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.special import gammaincinv

from shapepose_fg.core.arrays import Array, Index, Real, Whole
from shapepose_fg.core.skeleton import BODY_25

MAX_DISTANCE_M = 0.5
"""Mean joint distance from which a prediction does not match a person, m."""


class People(Protocol):
    """Input of the metrics: a `Reconstruction`, or anything with its two arrays."""

    @property
    def frame(self) -> Whole:
        """(N,) frame of each row."""
        ...

    @property
    def joints(self) -> Real:
        """(N, J, 3) joints of each row, metres, NaN where unknown."""
        ...


@dataclass(frozen=True)
class PlainPeople:
    """N rows, one per person and frame, with joints only; implements `People`."""

    frame: Whole
    """(N,) frame of each row."""
    joints: Array
    """(N, J, 3) joints of each row, metres in the world, NaN where unknown."""
    person: Whole = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    """(N,) identity, or the number within the frame; empty if there are no identities."""
    joint_names: tuple[str, ...] = BODY_25.joints
    """(J,) names."""
    covariance: Array | None = None
    """(N, J, 3, 3) covariances of the joints, m²; None if unknown."""
    covered: Sequence[range] | None = None
    """Frames that were reconstructed or annotated, also those without people; None if unknown."""
    identified: bool = True
    """Whether `person` is an identity over time."""
    complete: bool = True
    """Whether everybody in view is annotated."""


@dataclass(frozen=True)
class Matches:
    """M matched predictions, and the unmatched people and predictions."""

    row: Index
    """(M,) row of the prediction."""
    frame: Index
    """(M,) index of the frame in the truth."""
    person: Index
    """(M,) index of the person in the truth."""
    duplicated: Index
    """Rows of additional predictions of people who are already matched: duplicates."""
    invented: Index
    """Rows of predictions that are near no person: false positives."""
    missed: Index
    """(K, 2) frame and person of the people without a prediction."""


def match_people(
    frame: Whole, joints: Real, truth: Real, frames: Sequence[int] | range | None = None
) -> Matches:
    """Match predictions `joints` (N, J, 3) of `frame` (N,) with `truth` (T, P, J, 3), all in
    metres.

    `frames` (T,) numbers the frames of the truth, 0 to T - 1 by default; predictions of other
    frames are left out, as are predictions and true people without any joint. The cost of a pair is
    its `mean_distance`; the assignment is optimal in each frame (Hungarian), without pairs of 0.5 m
    or more.
    """
    predicted, true = np.asarray(joints, dtype=np.float64), np.asarray(truth, dtype=np.float64)
    if true.ndim != 4 or true.shape[3] != 3:
        raise ValueError(f"truth must be (T, P, J, 3), got {true.shape}")
    if predicted.shape != (len(frame), *true.shape[2:]):
        raise ValueError(
            f"joints must be ({len(frame)}, {true.shape[2]}, 3), got {predicted.shape}"
        )
    numbers = range(len(true)) if frames is None else frames
    if len(numbers) != len(true):
        raise ValueError(
            f"frames must be {len(true)} numbers, one a frame of the truth, got {len(numbers)}"
        )
    has_joint = np.isfinite(predicted.sum(axis=2)).any(axis=1)
    is_there = np.isfinite(true.sum(axis=3)).any(axis=2)
    pairs, missed = list[tuple[int, int, int]](), list[tuple[int, int]]()
    duplicated, invented = list[int](), list[int]()
    for index, number in enumerate(numbers):
        rows, people = (
            np.flatnonzero((np.asarray(frame) == number) & has_joint),
            np.flatnonzero(is_there[index]),
        )
        cost = mean_distance(predicted[rows, None], true[index, people])
        # All pairs beyond the bound cost the same, so that distant pairs do not influence the near
        # ones.
        at_row, at_person = linear_sum_assignment(np.minimum(cost, MAX_DISTANCE_M))
        near = cost[at_row, at_person] < MAX_DISTANCE_M
        at_row, at_person = at_row[near], at_person[near]
        pairs += [
            (row, index, person)
            for row, person in zip(rows[at_row], people[at_person], strict=True)
        ]
        missed += [(index, person) for person in np.setdiff1d(people, people[at_person])]
        for left in np.setdiff1d(np.arange(len(rows)), at_row):
            (duplicated if (cost[left] < MAX_DISTANCE_M).any() else invented).append(
                int(rows[left])
            )
    row, at, person = np.array(pairs, dtype=np.intp).reshape(-1, 3).T
    twice, nowhere = (np.array(each, dtype=np.intp) for each in (duplicated, invented))
    return Matches(row, at, person, twice, nowhere, np.array(missed, dtype=np.intp).reshape(-1, 2))


def mean_distance(predicted: Array, truth: Array) -> Array:
    """Mean joint distance (...) in metres of pairs of people: `predicted` and `truth` (..., J, 3)
    broadcast.

    A joint that is missing only in the prediction counts 0.5 m; one that is missing in the truth is
    ignored. Infinite for a person without joints.
    """
    distance = np.linalg.norm(predicted - truth, axis=-1)
    known = np.isfinite(truth).all(axis=-1)
    distance = np.where(known, np.where(np.isfinite(distance), distance, MAX_DISTANCE_M), 0.0).sum(
        axis=-1
    )
    count = known.sum(axis=-1)
    return np.where(count > 0, distance / np.maximum(count, 1), np.inf)


CORRECT_M = 0.2
"""Largest distance of a correct joint from the true one, m (the protocol of Zhang et al.)."""


@dataclass(frozen=True)
class JointMetrics:
    """Result of `joint_metrics`; counts of joints and of people are over all frames."""

    joints_correct: int
    """Number of predicted joints within 0.2 m of the true joint of the matched person."""
    joints_predicted: int
    """Number of predicted joints, including those of false positives."""
    joints_true: int
    """Number of joints in the truth."""
    mpjpe_mm: float
    """Mean distance of the joints of matched people, near or far, millimetres; NaN if there are
    none."""
    people_true: int
    """Number of people in the truth."""
    people_found: int
    """Number of people who are matched with a prediction (mean joint distance under 0.5 m)."""
    people_duplicated: int
    """Number of further predictions of matched people."""
    people_invented: int
    """Number of predictions that are near no person."""

    @property
    def precision(self) -> float:
        """Share of the predicted joints that are correct; NaN if none was predicted."""
        return share(self.joints_correct, self.joints_predicted)

    @property
    def recall(self) -> float:
        """Share of the true joints that were predicted correctly; NaN if there are none."""
        return share(self.joints_correct, self.joints_true)

    @property
    def f1(self) -> float:
        """Harmonic mean of precision and recall."""
        return share(2 * self.joints_correct, self.joints_predicted + self.joints_true)

    @property
    def people_missed(self) -> int:
        """Number of people without a prediction."""
        return self.people_true - self.people_found

    @property
    def false_positives(self) -> int:
        """Number of unmatched predictions: duplicates, and people who do not exist."""
        return self.people_duplicated + self.people_invented


def joint_metrics(
    predicted: People | Sequence[Real],
    truth: Real,
    frames: Sequence[int] | range | None = None,
    *,
    correct_m: float = CORRECT_M,
) -> JointMetrics:
    """Compare predictions with the `truth` (T, P, J, 3), metres, NaN where a person or joint is
    absent.

    `predicted` is a `Reconstruction`, or one array (P_t, J, 3) for each frame; NaN joints are
    missing. `frames` (T,) are the frame numbers of the truth in a `Reconstruction`, 0 to T - 1 by
    default; other frames are not scored. People are matched by `match_people`. A predicted joint
    that the truth lacks is not counted.
    """
    truth = np.asarray(truth, dtype=np.float64)
    if isinstance(predicted, Sequence):
        if len(predicted) != len(truth):
            raise ValueError(
                f"give one array for each of the {len(truth)} frames of the truth, got "
                f"{len(predicted)}"
            )
        frame = np.repeat(np.arange(len(predicted)), [len(people) for people in predicted])
        rows = np.concatenate([np.zeros((0, *truth.shape[2:])), *predicted])
        predicted = PlainPeople(frame, rows.astype(np.float64))
    joints = np.asarray(predicted.joints, dtype=np.float64)
    matches = match_people(predicted.frame, joints, truth, frames)
    return metrics_of(matches, joints, truth, correct_m=correct_m)


def metrics_of(
    matches: Matches, joints: Array, truth: Array, *, correct_m: float = CORRECT_M
) -> JointMetrics:
    """The metrics of matched people: rows `joints` (N, J, 3), `truth` (T, P, J, 3), metres."""
    true_known = np.isfinite(truth.sum(axis=3))
    distance = np.linalg.norm(joints[matches.row] - truth[matches.frame, matches.person], axis=2)
    both = np.isfinite(distance)
    false = np.concatenate([matches.duplicated, matches.invented])
    return JointMetrics(
        joints_correct=int((distance <= correct_m).sum()),
        joints_predicted=int(both.sum() + np.isfinite(joints[false]).all(axis=2).sum()),
        joints_true=int(true_known.sum()),
        mpjpe_mm=1e3 * float(distance[both].mean()) if both.any() else float("nan"),
        people_true=int(true_known.any(axis=2).sum()),
        people_found=len(matches.row),
        people_duplicated=len(matches.duplicated),
        people_invented=len(matches.invented),
    )


@dataclass(frozen=True)
class CovarianceCalibration:
    """Consistency of covariances with the joints' errors."""

    nees: Array
    """(M,) normalised estimation error squared e^T C^-1 e of each joint: chi-squared with 3 degrees
    of freedom if the covariances are correct."""
    coverage: dict[float, float]
    """Share of the truths inside the ellipsoids of the levels 0.5, 0.9 and 0.95, by level."""
    log_score: float
    """Mean of the logarithm of the Gaussian's density, 1/m³, at the truth, each at least -50.
    Sigmas that are too large decrease it. NaN without joints."""


def covariance_calibration(errors: Real, covariances: Real) -> CovarianceCalibration:
    """Compare `errors` (..., 3), metres, with their `covariances` (..., 3, 3), m².

    Pairs with NaN are left out. ValueError for a covariance that is not positive definite.
    """
    error = np.asarray(errors, dtype=np.float64).reshape(-1, 3)
    covariance = np.asarray(covariances, dtype=np.float64).reshape(-1, 3, 3)
    if len(error) != len(covariance):
        raise ValueError(
            f"each error needs one covariance, got {len(error)} errors and {len(covariance)} "
            "covariances"
        )
    finite = np.isfinite(error).all(axis=1) & np.isfinite(covariance).all(axis=(1, 2))
    error, covariance = error[finite], covariance[finite]
    try:
        root = np.linalg.cholesky(covariance)
    except np.linalg.LinAlgError:
        raise ValueError(
            "covariances must be positive definite, or NaN where they are unknown"
        ) from None
    nees = np.sum(np.linalg.solve(root, error[..., None])[..., 0] ** 2, axis=1)
    # `2 gammaincinv(1.5, level)` is the quantile of chi-squared with 3 degrees of freedom.
    # Probabilities for which `covariance_calibration` computes the coverage of the
    # ellipsoids.
    inside = {
        level: share((nees <= 2 * gammaincinv(1.5, level)).sum(), len(nees))
        for level in (0.5, 0.9, 0.95)
    }
    density = -0.5 * (nees + 3 * np.log(2 * np.pi)) - np.log(
        np.diagonal(root, axis1=1, axis2=2)
    ).sum(axis=1)
    # Minimum log score of a joint in the mean, reached at an error of ten sigma, so that a
    # single exchanged limb does not dominate the mean.
    score = float(np.maximum(density, -50.0).mean()) if len(nees) > 0 else float("nan")
    return CovarianceCalibration(nees, inside, score)


def share(part: float, whole: float) -> float:
    """`part` / `whole`; NaN where `whole` is 0."""
    return float(part / whole) if whole > 0 else float("nan")


def known_mean(values: Array) -> float:
    """Mean of the finite values; NaN if there are none."""
    known = values[np.isfinite(values)]
    return float(known.mean()) if len(known) > 0 else float("nan")
