"""Segments of simulated scenes, and how much is measured: everything for the documents, a little for tests."""

from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np

from shapepose_fg.core.detections import DetectionSequence
from shapepose_fg.core.frame_times import FrameTimes
from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.pipeline.pipeline import PipelineConfig, reconstruct
from shapepose_fg.simulation import DetectorConfig, Scene, simulate
from shapepose_fg.simulation.files import named_scene, truth_of
from shapepose_fg.simulation.foreign import DETECTOR_S_OWN, people_of, recast
from shapepose_fg.simulation.room import SequenceConfig
from shapepose_fg.simulation.sequences import Split

SEGMENTS: dict[Split, dict[str, tuple[int, int]]] = {
    "report": {"salsa": (108, 618), "crossing": (0, 726), "crowd": (0, 826)},
    "tune": {"salsa": (0, 564), "crossing": (0, 564), "crowd": (241, 900)},
}
"""Where the segments of the named sequences without a cut begin; each has 300 frames."""
RECORDINGS = ("shelf", "pose2sim_single", "cmu_mocap")
"""Folders of recordings and of recorded motions that experiments are of."""
QUICK_FRAMES = 4
"""Frames of a scene that a quick run takes."""


@dataclass(frozen=True)
class Segment:
    """Consecutive frames of a simulated scene."""

    name: str
    """`salsa`, `crossing` or `crowd`; `demo` is the built-in scene."""
    span: range
    """Which frames of it."""
    split: Split = "report"
    """Whose recorded motions."""
    cameras: int = 6
    """Views."""
    seed: int = 0
    """Of the detector's errors; of the built-in scene, too."""
    people: int = 4
    """Of the built-in scene; a sequence has its own."""
    made: SequenceConfig | None = None
    """What a sequence is made of, in place of the named one's."""
    fps: float | None = None
    """Frames a second; None: the scene's own."""
    bodies: str | None = None
    """Whose bodies: one of `simulation.foreign.PEOPLE`. None: those of the body that is fitted."""
    own_joints: bool = False
    """Whether the detector's joints lie elsewhere than the body's (`DETECTOR_S_OWN`)."""
    mocap: Path | None = field(default=None, compare=False)
    """The recorded motions; None: where SHAPEPOSE_DATA says."""

    @property
    def label(self) -> str:
        """What a table calls it."""
        return f"{self.name} {self.span.start}:{self.span.stop}"

    @property
    def scene(self) -> Scene:
        """The people, with the joints that the detector means, and the cameras."""
        scene = _scene(self)
        return scene.with_keypoint_offsets(DETECTOR_S_OWN) if self.own_joints else scene

    @property
    def detections(self) -> DetectionSequence:
        """What the simulated detector saw."""
        return _detections(self)

    @property
    def truth(self) -> Reconstruction:
        """The people as a result, in which everybody is somebody else after a cut."""
        truth = truth_of(self.scene)
        part = np.searchsorted(self.scene.cuts, truth.frame, side="right")
        return replace(truth, person=truth.person + part * (int(truth.person.max(initial=0)) + 1))

    def shorter(self, frames: int) -> "Segment":
        """Its first so many frames, or all that it has."""
        return replace(self, span=self.span[:frames])

    def reconstruct(self, config: PipelineConfig | None = None) -> Reconstruction:
        """Reconstructed at the scene's rate."""
        scene = self.scene
        times = FrameTimes.from_fps(scene.fps, len(self.span))
        return reconstruct(self.detections, scene.rig, config, times=times, cuts=scene.cuts)


@dataclass(frozen=True)
class Scale:
    """How much is measured, and on what."""

    quick: bool = False
    """A few frames of the built-in scene in place of all segments: whether everything works, in two minutes."""
    data: Path | None = None
    """Folder with the `RECORDINGS`. None: there are none."""
    split: Split = "report"
    """Choose on `tune`, report on `report`."""
    seeds: tuple[int, ...] = tuple(range(6101, 6106))
    """Of the sequences that are drawn anew (`who is there`)."""

    @cached_property
    def segments(self) -> tuple[Segment, ...]:
        """Two of each sequence; none where there is nothing to simulate them from."""
        if self.quick:
            return (Segment("demo", range(QUICK_FRAMES)),)
        every = SEGMENTS[self.split].items() if self.mocap is not None else ()
        begins = ((name, start) for name, starts in every for start in starts)
        return tuple(Segment(name, range(n, n + 300), self.split, mocap=self.mocap) for name, n in begins)

    def one_each(self, frames: int) -> tuple[Segment, ...]:
        """The first so many frames of the first segment of each sequence, for what takes long."""
        return tuple(each.shorter(frames) for each in self.segments[::2])

    def recording(self, name: str) -> Path | None:
        """The folder of one of the `RECORDINGS`; None where there is none."""
        folder = None if self.data is None else self.data / name
        return folder if folder is not None and folder.is_dir() else None

    @property
    def mocap(self) -> Path | None:
        """The file of recorded motions."""
        folder = self.recording("cmu_mocap")
        return None if folder is None else folder / "cmu_smpl24.npz"


@lru_cache(maxsize=8)
def _scene(segment: Segment) -> Scene:
    own = {"people": segment.people, "seed": segment.seed} if segment.name == "demo" else {}
    whole = named_scene(
        segment.name,
        split=segment.split,
        cameras=segment.cameras,
        frames=segment.span.stop,
        mocap=segment.mocap,
        config=segment.made,
        fps=segment.fps,
        **own,
    )
    scene = whole.part(segment.span)
    return scene if segment.bodies is None else recast(scene, people_of(segment.bodies, scene.people))


@lru_cache(maxsize=8)
def _detections(segment: Segment) -> DetectionSequence:
    offsets = DETECTOR_S_OWN if segment.own_joints else None
    return simulate(_scene(segment), DetectorConfig(offsets=offsets), segment.seed)
