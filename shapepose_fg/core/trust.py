"""Which cameras a recording is reconstructed without, and which contradict each other."""

from dataclasses import dataclass

from shapepose_fg.core.detections import DerivedFrames, DetectionSequence

Spell = tuple[int, int, int]
"""A view, the first frame of which something is said, and the one after the last."""


@dataclass(frozen=True)
class Trust:
    """What is believed of each camera, in frames of the recording; everything by default."""

    left_out: tuple[Spell, ...] = ()
    """Cameras that are taken for dark: they contradict others who agree."""
    doubted: tuple[Spell, ...] = ()
    """Cameras of which some are wrong, and nothing says which: rows that need them are not `ok`."""

    def dark(self, frame: int) -> tuple[int, ...]:
        """The views that are left out of a frame."""
        return _there(self.left_out, frame)

    def in_doubt(self, frame: int) -> tuple[int, ...]:
        """The views that are doubted in a frame."""
        return _there(self.doubted, frame)


def _there(spells: tuple[Spell, ...], frame: int) -> tuple[int, ...]:
    return tuple(sorted({view for view, first, last in spells if first <= frame < last}))


BELIEVED = Trust()
"""Every camera is believed."""


@dataclass(frozen=True)
class Trusted(DerivedFrames):
    """A recording for `reconstruct`, with what is believed of its cameras."""

    trust: Trust
    """`setup_check.report.check_setup(detections, rig).trust`, for example."""


def trust_in(detections: DetectionSequence) -> Trust:
    """What is believed of a recording's cameras: all, unless it is `Trusted`."""
    return detections.trust if isinstance(detections, Trusted) else BELIEVED
