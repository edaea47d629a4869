"""Cameras that are left out of a reconstruction in some frames, and cameras that contradict each
other.
"""

from dataclasses import dataclass, replace

import numpy as np

from shapepose_fg.core.camera import Rig
from shapepose_fg.core.detections import DerivedFrames, DetectionSequence
from shapepose_fg.core.frame_times import FrameTimes, spans_of

Spell = tuple[int, int, int]
"""A view, the first frame of an interval, and the first frame after it."""


@dataclass(frozen=True)
class Trust:
    """Which cameras are used, in which frames of the recording; all by default."""

    left_out: tuple[Spell, ...] = ()
    """Views and intervals that are left out, because they contradict other views that agree."""
    doubted: tuple[Spell, ...] = ()
    """Views and intervals that contradict each other, without evidence which are wrong; rows that
    depend on them are not `ok`."""

    def excluded(self, frame: int) -> tuple[int, ...]:
        """The views that are left out of a frame."""
        return _there(self.left_out, frame)

    def in_doubt(self, frame: int) -> tuple[int, ...]:
        """The views that are doubted in a frame."""
        return _there(self.doubted, frame)


def _there(spells: tuple[Spell, ...], frame: int) -> tuple[int, ...]:
    return tuple(sorted({view for view, first, last in spells if first <= frame < last}))


BELIEVED = Trust()
"""All cameras are used."""


@dataclass(frozen=True)
class Trusted(DerivedFrames):
    """A recording with the information for `reconstruct` which cameras are left out or doubted."""

    trust: Trust
    """For example `cameras.check.report.check_setup(detections, rig).trust`."""


def trust_in(detections: DetectionSequence) -> Trust:
    """The `Trust` of a recording: all cameras are used unless it is `Trusted`."""
    return detections.trust if isinstance(detections, Trusted) else BELIEVED


def without_poses(rig: Rig, times: FrameTimes) -> tuple[Spell, ...]:
    """Intervals in which moving cameras have no pose: before, after and in gaps of their
    trajectories.
    """
    time_s, spells = times.of_views(len(rig)), list[Spell]()
    for view, number in enumerate(rig.carrier.tolist()):
        if number >= 0:
            missing = np.flatnonzero(~rig.trajectories[number].covers(time_s[:, view]))
            spells += [(view, span.start, span.stop) for span in spans_of(missing.tolist())]
    return tuple(spells)


def with_poses(detections: DetectionSequence, rig: Rig, times: FrameTimes) -> DetectionSequence:
    """The recording without the pictures of cameras that have no pose at the time; ValueError if a
    camera never has one.
    """
    spells, trust = without_poses(rig, times), trust_in(detections)
    for view, first, last in spells:
        if last - first == len(times):
            path = rig.trajectories[int(rig.carrier[view])]
            runs = f"{path.name} runs from {path.time_s[0]:.10g} to {path.time_s[-1]:.10g} s"
            raise ValueError(
                f"camera {rig.names[view]} has no pose at the time of any picture: {runs}; give "
                "times of its clock"
            )
    if len(spells) == 0:
        return detections
    frames = detections.frames if isinstance(detections, Trusted) else detections
    return Trusted(frames, replace(trust, left_out=(*trust.left_out, *spells)))
