"""Whether an identity stays with its person: IDF1, switches, false tracks."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from shapepose_fg.evaluation.matching import MAX_DISTANCE_M, Matches, mean_distance

UNMATCHED = np.iinfo(np.int64).min
"""Stands for no identity: any other number may be one."""


@dataclass(frozen=True)
class IdentityMetrics:
    """What `identity_metrics` found, over all frames."""

    true_positives: int
    """IDTP: rows that are the person whom their identity is assigned to for the whole recording."""
    rows: int
    """Rows of the scored frames that have a joint."""
    people_true: int
    """People in frames in which they have a joint."""
    switches: int
    """Times that a person is matched with another identity than the last time."""
    tracks: int
    """Identities."""
    false_tracks: int
    """Identities at most half of whose rows are matched with a person."""
    longest_false_positive: int
    """The most rows of one identity that are matched with no person."""

    @property
    def idf1(self) -> float:
        """2 IDTP / (rows + true people); NaN where there is neither (Ristani et al., 2016)."""
        return _share(2 * self.true_positives, self.rows + self.people_true)


def identity_metrics(
    matches: Matches,
    index: NDArray[np.integer],
    identity: NDArray[np.integer],
    joints: NDArray[np.float64],
    truth: NDArray[np.float64],
) -> IdentityMetrics:
    """Compare the identities of rows with those of the truth (T, P, J, 3), NaN where a person is absent.

    Row n has `identity` (N,), `joints` (N, J, 3) in metres and belongs to frame `index` (N,) of the truth, -1
    for a frame that is not scored. For IDF1 every identity is one person for good, and every person one identity,
    so that as many rows as possible are nearer than 0.5 m to theirs (Ristani et al., "Performance
    Measures and a Data Set for Multi-Target, Multi-Camera Tracking", 2016). Switches go by `matches`, which are
    made frame by frame.
    """
    scored = np.flatnonzero((index >= 0) & np.isfinite(joints.sum(axis=2)).any(axis=1))
    present = np.isfinite(truth.sum(axis=3)).any(axis=2)
    names, number = np.unique(identity[scored], return_inverse=True)
    pairs = np.stack([index[scored], number], axis=1)
    if len(np.unique(pairs, axis=0)) < len(pairs):
        raise ValueError("an identity has two rows in one frame: give each person one row a frame")
    together = np.zeros((len(names), truth.shape[1]), dtype=np.int64)
    for person in range(truth.shape[1]):
        near = mean_distance(joints[scored], truth[index[scored], person]) < MAX_DISTANCE_M
        together[:, person] = np.bincount(number[near], minlength=len(names))
    best = linear_sum_assignment(together, maximize=True)
    matched = np.bincount(number[np.isin(scored, matches.row)], minlength=len(names))
    length = np.bincount(number, minlength=len(names))
    by_frame = np.full(truth.shape[:2], UNMATCHED)
    by_frame[matches.frame, matches.person] = identity[matches.row]
    return IdentityMetrics(
        true_positives=int(together[best].sum()),
        rows=len(scored),
        people_true=int(present.sum()),
        switches=sum(int((np.diff(column[column != UNMATCHED]) != 0).sum()) for column in by_frame.T),
        tracks=len(names),
        false_tracks=int((2 * matched <= length).sum()),
        longest_false_positive=int((length - matched).max(initial=0)),
    )


def _share(part: float, whole: float) -> float:
    return float(part / whole) if whole > 0 else float("nan")
