"""Detections assigned to people: the output of stage I and of the tracker, and the input of stage II."""

from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np

from shapepose_fg.core.arrays import Array, Index, Mask
from shapepose_fg.core.detections import Detections
from shapepose_fg.core.storage.schema import Column, Table

_LATER: Any = None
"""Default of a column that is not given."""


@dataclass(frozen=True)
class Observations(Table):
    """The 2D observations of N rows: a row is one person (track) in one frame."""

    xy: Annotated[Array, Column("N J V 2", unit="px")]
    """(N, J, V, 2) detections of joint j in view v, undistorted pixels; 0 where there is none."""
    confidence: Annotated[Array, Column("N J V")]
    """(N, J, V) w_ij of Eq. 1, the detector's score; 0 where there is no detection."""
    initial: Annotated[Array, Column("N J 3", unit="m")]
    """(N, J, 3) X_0: initial joints from stage I, or from a track, metres; NaN where unknown."""
    track: Annotated[Index, Column("N", np.intp)] = _LATER
    """(N,) number of the track; 0 to N - 1 where it is not given."""
    frame: Annotated[Index, Column("N", np.intp, missing=0)] = _LATER
    """(N,) frame of the row; 0 where it is not given."""
    time_s: Annotated[Array, Column("N V", unit="s", missing=0.0)] = _LATER
    """(N, V) when each view was exposed, seconds, the middle of its picture: equal in a row if
    cameras are synchronised. 0 by default."""
    candidate: Annotated[Index, Column("N J V", np.intp, missing=-1)] = _LATER
    """(N, J, V) index of the observation among the detections of the row's frame; -1 for none, or where not
    given."""
    probability: Annotated[Array, Column("N J V", missing=1.0)] = _LATER
    """(N, J, V) probability that the observation is this person's; 1 where it is not given."""
    mirrored: Annotated[Array, Column("N J V", missing=0.0)] = _LATER
    """(N, J, V) probability that the observation belongs to the other side of the body; 0 where it is not
    given."""
    evidence: Annotated[Array, Column("N", missing=np.nan)] = _LATER
    """(N,) evidence for the existence of the person: over time that of `tracking/presence.py`, `own_evidence`;
    frame by frame a probability; NaN where it is not given."""

    def __post_init__(self) -> None:
        if self.track is None:
            object.__setattr__(self, "track", np.arange(len(self.xy)))
        super().__post_init__()

    @classmethod
    def of(cls, candidate: Index, detections: Detections, initial: Array, **others: Any) -> "Observations":
        """The detections `candidate` (N, J, V) of one frame, -1 for none, as observations; with other columns."""
        seen = candidate >= 0
        xy, confidence, mirrored = np.zeros((*seen.shape, 2)), np.zeros(seen.shape), np.zeros(seen.shape)
        xy[seen], confidence[seen] = detections.xy[candidate[seen]], detections.confidence[candidate[seen]]
        mirrored[seen] = detections.mirrored[candidate[seen]]
        return cls(xy, confidence, initial, candidate=candidate, mirrored=mirrored, **others)

    @property
    def seen(self) -> Mask:
        """(N, J, V) whether there is an observation."""
        return self.confidence > 0


def rows_in(before: Observations, now: Observations) -> Index:
    """(N,) indices of the rows of `now` among those `before`: the same people, fewer or in another order."""
    most = 1 + max(before.track.max(initial=0), now.track.max(initial=0))
    was, key = (each.frame * most + each.track for each in (before, now))
    order = np.argsort(was, kind="stable")
    return order[np.searchsorted(was[order], key)]
