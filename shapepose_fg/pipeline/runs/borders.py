"""Who is who on both sides of a border between chunks, whose people were followed apart."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from shapepose_fg.core.observations import Observations
from shapepose_fg.core.storage.schema import Column, Table
from shapepose_fg.pipeline.windows import Span

_SAME = 0.5
"""Of two tracks the lesser one's detections that the other has too, from which on they are one person."""
_NEAR_M = 0.3
"""Or both are out of sight, and their joints so near to each other in the mean."""


@dataclass(frozen=True)
class Border(Table):
    """Who is where in the frames on both sides of a border: N rows."""

    frame: Annotated[NDArray[np.intp], Column("N", np.intp)]
    """(N,) frame of each row."""
    track: Annotated[NDArray[np.intp], Column("N", np.intp)]
    """(N,) whose it is, as one of the chunks has it."""
    candidate: Annotated[NDArray[np.intp], Column("N J V", np.intp)]
    """(N, J, V) its detections; -1 for none."""
    place: Annotated[NDArray[np.float64], Column("N J 3", unit="m")]
    """(N, J, 3) where its joints were expected, metres; NaN where nothing was."""

    @classmethod
    def of(cls, span: Span) -> "Border":
        """The rows of a window, and of the frames that it overlaps."""
        rows = Observations.concatenate([rows for _, rows in span.decided])
        return cls(rows.frame, rows.track, rows.candidate, rows.initial)


def same_people(before: Border, after: Border) -> dict[int, int]:
    """For tracks of `after` who they are among those of `before`, as far as they are there.

    By the detections that both chunks gave to them in the frames that both know; people out of sight by where they
    were expected. One to one.
    """
    shared = np.intersect1d(before.frame, after.frame)
    before, after = (each.rows(np.isin(each.frame, shared)) for each in (before, after))
    old, new = np.unique(before.track), np.unique(after.track)
    alike = np.zeros((len(old), len(new)))
    for i, a in enumerate(old):
        mine = before.rows(before.track == a)
        alike[i] = [_alike(mine, after.rows(after.track == b)) for b in new]
    rows, columns = linear_sum_assignment(-alike)
    return {int(new[k]): int(old[i]) for i, k in zip(rows, columns, strict=True) if alike[i, k] > 0}


def _alike(a: Border, b: Border) -> float:
    """0 for two people; up to 1 for one out of sight, and up to 2 by how many detections both tracks have."""
    _, first, second = np.intersect1d(a.frame, b.frame, return_indices=True)
    if len(first) == 0:
        return 0.0
    mine, theirs = a.candidate[first], b.candidate[second]
    count = min(int((mine >= 0).sum()), int((theirs >= 0).sum()))
    if count > 0:
        share = int(((mine == theirs) & (mine >= 0)).sum()) / count
        return 1.0 + share if share >= _SAME else 0.0
    apart = np.linalg.norm(a.place[first] - b.place[second], axis=-1)
    apart = apart[np.isfinite(apart)]
    return 1.0 - float(apart.mean()) / _NEAR_M if len(apart) > 0 and apart.mean() < _NEAR_M else 0.0
