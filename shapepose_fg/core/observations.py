"""Detections assigned to people: the output of stage I and of the tracker, and the input of stage
II.
"""

from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np

from shapepose_fg.core.arrays import Array, Index, Mask, pair_keys
from shapepose_fg.core.detections import Detections
from shapepose_fg.core.storage.schema import Column, Table

_LATER: Any = None
"""Default of a column that is not given."""


@dataclass(frozen=True)
class Observations(Table):
    """The 2D observations of N rows: a row is one person (track) in one frame."""

    xy: Annotated[Array, Column("N J V 2", unit="px")]
    """(N, J, V, 2) detections of joint j in view v, undistorted pixels; 0 if there is none."""
    confidence: Annotated[Array, Column("N J V")]
    """(N, J, V) w_ij of Eq. 1, the detector's score; 0 if there is no detection."""
    initial: Annotated[Array, Column("N J 3", unit="m")]
    """(N, J, 3) X_0: initial joints from stage I or from a track, metres; NaN if unknown."""
    track: Annotated[Index, Column("N", np.intp)] = _LATER
    """(N,) number of the track; 0 to N - 1 by default."""
    frame: Annotated[Index, Column("N", np.intp, missing=0)] = _LATER
    """(N,) frame of the row; 0 by default."""
    time_s: Annotated[Array, Column("N V", unit="s", missing=0.0)] = _LATER
    """(N, V) exposure time of each view (of the middle row of its picture), seconds; equal within a
    row if cameras are synchronised. 0 by default."""
    candidate: Annotated[Index, Column("N J V", np.intp, missing=-1)] = _LATER
    """(N, J, V) index of the observation among the detections of the row's frame; -1 for none, or
    if unknown."""
    probability: Annotated[Array, Column("N J V", missing=1.0)] = _LATER
    """(N, J, V) probability that the observation belongs to this person; 1 by default."""
    mirrored: Annotated[Array, Column("N J V", missing=0.0)] = _LATER
    """(N, J, V) probability that the observation belongs to the other side of the body; 0 by
    default."""
    evidence: Annotated[Array, Column("N", missing=np.nan)] = _LATER
    """(N,) evidence for the existence of the person: `own_evidence` of
    `tracking/track_selection.py`, or a probability for frame-by-frame results; NaN by default."""

    def __post_init__(self) -> None:
        if self.track is None:
            object.__setattr__(self, "track", np.arange(len(self.xy)))
        super().__post_init__()

    @classmethod
    def of(
        cls, candidate: Index, detections: Detections, initial: Array, **others: Any
    ) -> "Observations":
        """Make observations from the detections `candidate` (N, J, V) of one frame, -1 for none;
        `others` are further columns.
        """
        seen = candidate >= 0
        xy, confidence, mirrored = (
            np.zeros((*seen.shape, 2)),
            np.zeros(seen.shape),
            np.zeros(seen.shape),
        )
        xy[seen], confidence[seen] = (
            detections.xy[candidate[seen]],
            detections.confidence[candidate[seen]],
        )
        mirrored[seen] = detections.mirrored[candidate[seen]]
        return cls(xy, confidence, initial, candidate=candidate, mirrored=mirrored, **others)

    @property
    def seen(self) -> Mask:
        """(N, J, V) whether there is an observation."""
        return self.confidence > 0


def rows_in(before: Observations, now: Observations) -> Index:
    """(N,) indices, among the rows of `before`, of the rows of `now`: a subset of the same people,
    in any order.
    """
    was, key = pair_keys(*((each.frame, each.track) for each in (before, now)))
    order = np.argsort(was, kind="stable")
    return order[np.searchsorted(was[order], key)]


def window_rows(observations: Observations) -> list[Index]:
    """Rows of each window, i.e. track, with ascending frames. Raises ValueError if a track has two
    rows in a frame.
    """
    order = np.lexsort((observations.frame, observations.track))
    track, frame = observations.track[order], observations.frame[order]
    if np.any((np.diff(track) == 0) & (np.diff(frame) == 0)):
        raise ValueError(
            "a track may have only one row per frame: give each person another track number"
        )
    return np.split(order, np.flatnonzero(np.diff(track)) + 1) if len(order) else []
