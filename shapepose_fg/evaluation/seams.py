"""What chunks change: joints at their seams and away from them, and whether anybody loses the identity there."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from shapepose_fg.core.reconstruction import Reconstruction

_FAR_M = 1.0
"""Two rows of a frame that lie farther apart in the mean are two people."""


@dataclass(frozen=True)
class Seams:
    """A result in chunks against the same recording uncut."""

    seams: int
    """How many there are."""
    at_seams_mm: float
    """The largest difference of a joint within one overlap of a seam, millimetres; NaN where nobody is there."""
    away_mm: float
    """The same in all other frames."""
    crossings: int
    """How often somebody is there before and after a seam, under one identity in the uncut result."""
    lost: int
    """How many of these have two identities in chunks, or are not there at all."""
    unmatched: int
    """Rows of either result that the other has not."""


def compare_seams(whole: Reconstruction, cut: Reconstruction, borders: Sequence[int], overlap: int) -> Seams:
    """Compare a result `cut` into chunks, whose first frames are `borders`, with the `whole` one.

    `overlap` is how many frames windows overlap. Rows of a frame belong together by where their joints are.
    """
    first, second = _pairs(whole, cut)
    apart = np.linalg.norm(whole.joints[first] - cut.joints[second], axis=-1)
    largest = np.nanmax(apart, axis=1, initial=0.0, where=np.isfinite(apart))
    frame = whole.frame[first]
    near = np.zeros(len(frame), dtype=bool)
    for border in borders:
        near |= (frame >= border - overlap) & (frame < border + overlap)
    name = {
        (int(t), int(p)): int(cut.person[k]) for t, p, k in zip(frame, whole.person[first], second, strict=True)
    }
    crossings = lost = 0
    for border in borders:
        before, after = (set(whole.person[whole.frame == t].tolist()) for t in (border - 1, border))
        for person in before & after:
            names = name.get((border - 1, person)), name.get((border, person))
            crossings += 1
            lost += names[0] is None or names[0] != names[1]
    return Seams(
        seams=len(borders),
        at_seams_mm=_largest_mm(largest[near]),
        away_mm=_largest_mm(largest[~near]),
        crossings=crossings,
        lost=lost,
        unmatched=len(whole) + len(cut) - 2 * len(first),
    )


def _pairs(one: Reconstruction, other: Reconstruction) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Rows of both that are of one person in one frame."""
    pairs: list[NDArray[np.intp]] = []
    for t in np.intersect1d(one.frame, other.frame).tolist():
        mine, theirs = np.flatnonzero(one.frame == t), np.flatnonzero(other.frame == t)
        apart = np.linalg.norm(one.joints[mine][:, None] - other.joints[theirs][None], axis=-1)
        known = np.isfinite(apart)
        mean = np.where(known, apart, 0.0).sum(axis=-1) / np.maximum(known.sum(axis=-1), 1)
        mean[~known.any(axis=-1)] = _FAR_M
        rows, columns = linear_sum_assignment(np.minimum(mean, _FAR_M))
        near = mean[rows, columns] < _FAR_M
        pairs.append(np.column_stack([mine[rows], theirs[columns]])[near])
    found = np.concatenate([np.zeros((0, 2), dtype=np.intp), *pairs])
    return found[:, 0], found[:, 1]


def _largest_mm(apart_m: NDArray[np.float64]) -> float:
    return 1e3 * float(apart_m.max()) if len(apart_m) > 0 else float("nan")
