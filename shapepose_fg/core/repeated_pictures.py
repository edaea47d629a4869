"""Detects pictures that a camera delivers again because it has stopped, or to replace dropped
frames.
"""

from dataclasses import dataclass, field

import numpy as np

from shapepose_fg.core.arrays import Mask
from shapepose_fg.core.detections import DerivedFrames, Detections
from shapepose_fg.core.trust import Trust, trust_in

_LEAST = 4
"""Minimum number of equal detections of two pictures: a few may be of something that does not
move."""


@dataclass(frozen=True)
class WithoutRepeats(DerivedFrames):
    """A recording without the detections of repeated pictures: these are from an earlier time and
    would contradict the other cameras.

    A detector returns equal values, to the last digit, only for equal pictures. If all cameras with
    detections repeat themselves, the scene may be static, as in a simulation; then nothing is left
    out.
    """

    views: int
    """V, the number of cameras."""
    _read: dict[int, tuple[Detections, Mask]] = field(
        default_factory=dict, init=False, repr=False, compare=False
    )
    """The most recently read frames, by number: all detections, and which views (V,) repeat their
    picture."""

    @property
    def trust(self) -> Trust:
        """Cameras that are left out for other reasons, and in which frames."""
        return trust_in(self.frames)

    def __getitem__(self, frame: int, /) -> Detections:
        every, repeated = self._frame(frame)
        excluded = repeated.copy()
        excluded[list(self.trust.excluded(frame))] = True
        return every.only(~excluded[every.view]) if excluded.any() else every

    def repeated(self, frame: int) -> tuple[int, ...]:
        """The views with detections in `frame` that repeat those of the frame before."""
        return tuple(np.flatnonzero(self._frame(frame)[1]).tolist())

    def _frame(self, frame: int) -> tuple[Detections, Mask]:
        """All detections of a frame, and which views (V,) repeat their picture."""
        if frame not in self._read:
            now, repeated = self.frames[frame], np.zeros(self.views, dtype=bool)
            if frame > self.first:
                last = self._read.get(frame - 1)
                before = self.frames[frame - 1] if last is None else last[0]
                repeated = repeated_views(before, now, self.views)
            self._read.clear()
            self._read[frame] = now, repeated
        return self._read[frame]


def repeated_views(before: Detections, now: Detections, views: int) -> Mask:
    """(V,) the views with detections equal to those of the frame before, if other views have new
    ones.
    """
    count, count_before = (np.bincount(each.view, minlength=views) for each in (now, before))
    equal_counts = (count == count_before) & (count >= _LEAST)
    sums = (np.bincount(each.view, each.confidence, views) for each in (now, before))
    equal_counts &= np.equal(*sums)  # equal pictures have equal sums, different ones hardly ever
    if not equal_counts.any():
        return equal_counts
    one, other = (each.only(equal_counts[each.view]) for each in (before, now))
    one, other = (each.rows(np.argsort(each.view, kind="stable")) for each in (one, other))
    same = (
        (one.joint == other.joint)
        & (one.xy == other.xy).all(axis=1)
        & (one.confidence == other.confidence)
    )
    equal_counts[other.view[~same]] = False
    return equal_counts & bool((count[~equal_counts] > 0).any())
