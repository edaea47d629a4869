"""Pictures that a camera gives twice: it has stopped, or fills dropped frames with the picture before."""

from dataclasses import dataclass, field

import numpy as np

from shapepose_fg.core.arrays import Mask
from shapepose_fg.core.detections import Detections, DetectionSequence
from shapepose_fg.core.skeleton import Skeleton
from shapepose_fg.core.trust import Trust, trust_in

_LEAST = 4
"""Detections that two pictures must have in common: the odd one may be of something that stands still."""


@dataclass(frozen=True)
class WithoutRepeats:
    """A recording without the detections of pictures that say nothing new: of another time, they contradict.

    A detector finds the same again, to the last digit, in the same picture only. Where all cameras that see
    anything repeat themselves, everything may stand still, as in a made-up scene: nothing is left out.
    """

    frames: DetectionSequence
    """The recording as it is."""
    views: int
    """V, its cameras."""
    _before: dict[int, Detections] = field(default_factory=dict, init=False, repr=False, compare=False)
    """The frame that was read last, by its number."""

    @property
    def skeleton(self) -> Skeleton:
        """The detector's joints."""
        return self.frames.skeleton

    @property
    def trust(self) -> Trust:
        """Which cameras are left out besides, and when."""
        return trust_in(self.frames)

    @property
    def first(self) -> int:
        """The first frame that the recording says anything of."""
        return getattr(self.frames, "first", 0)

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, frame: int, /) -> Detections:
        every = self.frames[frame]
        gone = self._repeated(frame, every)
        gone[list(self.trust.dark(frame))] = True
        return every.only(~gone[every.view]) if gone.any() else every

    def repeated(self, frame: int) -> tuple[int, ...]:
        """The views that show in a frame what they showed in the frame before."""
        return tuple(np.flatnonzero(self._repeated(frame, self.frames[frame])).tolist())

    def _repeated(self, frame: int, now: Detections) -> Mask:
        if frame <= self.first:
            return np.zeros(self.views, dtype=bool)
        before = self._before[frame - 1] if frame - 1 in self._before else self.frames[frame - 1]
        self._before.clear()
        self._before.update({frame - 1: before, frame: now})
        return repeated_views(before, now, self.views)


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
