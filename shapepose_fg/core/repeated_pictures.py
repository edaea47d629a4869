"""Detects pictures that a camera delivers twice because it has stopped, or fills dropped frames."""

from dataclasses import dataclass, field

import numpy as np

from shapepose_fg.core.arrays import Mask
from shapepose_fg.core.detections import DerivedFrames, Detections
from shapepose_fg.core.trust import Trust, trust_in

_LEAST = 4
"""Minimum number of detections that two pictures have in common: a few may be of something that stands still."""


@dataclass(frozen=True)
class WithoutRepeats(DerivedFrames):
    """A recording without the detections of repeated pictures, which are of another time and would contradict
    others.

    A detector gives the same numbers, to the last digit, for the same picture only. Where all cameras that see
    anything repeat themselves, everything may stand still, as in a simulated scene: nothing is left out.
    """

    views: int
    """V, the number of cameras."""
    _read: dict[int, tuple[Detections, Mask]] = field(default_factory=dict, init=False, repr=False, compare=False)
    """The frames that were read last, by number: all detections, and which views (V,) repeat themselves."""

    @property
    def trust(self) -> Trust:
        """The cameras that are left out for other reasons, and when."""
        return trust_in(self.frames)

    def __getitem__(self, frame: int, /) -> Detections:
        every, repeated = self._frame(frame)
        gone = repeated.copy()
        gone[list(self.trust.dark(frame))] = True
        return every.only(~gone[every.view]) if gone.any() else every

    def repeated(self, frame: int) -> tuple[int, ...]:
        """The views whose detections in a frame repeat those of the frame before."""
        return tuple(np.flatnonzero(self._frame(frame)[1]).tolist())

    def _frame(self, frame: int) -> tuple[Detections, Mask]:
        """All detections of a frame, and which views (V,) repeat themselves."""
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
    """(V,) the views whose detections are those of the frame before, while other views have new ones."""
    there, was = (np.bincount(each.view, minlength=views) for each in (now, before))
    alike = (there == was) & (there >= _LEAST)
    if not alike.any():
        return alike
    one, other = (each.only(alike[each.view]) for each in (before, now))
    one, other = (each.rows(np.argsort(each.view, kind="stable")) for each in (one, other))
    same = (one.joint == other.joint) & (one.xy == other.xy).all(axis=1) & (one.confidence == other.confidence)
    alike[other.view[~same]] = False
    return alike & bool((there[~alike] > 0).any())
