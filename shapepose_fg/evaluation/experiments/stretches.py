"""Stretches of simulated scenes, and how much is measured: everything for the documents, a little for tests."""

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

STRETCHES: dict[Split, dict[str, tuple[range, ...]]] = {
    "report": {
        "salsa": (range(108, 408), range(618, 918)),
        "crossing": (range(0, 300), range(726, 1026)),
        "crowd": (range(0, 300), range(826, 1126)),
    },
    "tune": {
        "salsa": (range(0, 300), range(564, 864)),
        "crossing": (range(0, 300), range(564, 864)),
        "crowd": (range(241, 541), range(900, 1200)),
    },
}
"""Stretches of the named sequences without a cut, 300 frames each."""
QUICK_FRAMES = 4
"""Frames of a scene that a quick run takes."""


@dataclass(frozen=True)
class Stretch:
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
        segment = np.searchsorted(self.scene.cuts, truth.frame, side="right")
        return replace(truth, person=truth.person + segment * (int(truth.person.max(initial=0)) + 1))

    def reconstruct(self, config: PipelineConfig | None = None) -> Reconstruction:
        """Reconstructed at the scene's rate."""
        scene = self.scene
        times = FrameTimes.from_fps(scene.fps, len(self.span))
        return reconstruct(self.detections, scene.rig, config, times=times, cuts=scene.cuts)


@dataclass(frozen=True)
class Scale:
    """How much is measured, and on what."""

    quick: bool = False
    """A few frames of the built-in scene in place of all stretches: whether everything works, in two minutes."""
    data: Path | None = None
    """Folder with `data/`: recordings and motions. None: there are none."""
    split: Split = "report"
    """Choose on `tune`, report on `report`."""
    seeds: tuple[int, ...] = tuple(range(6101, 6106))
    """Of the sequences that are drawn anew (`who is there`)."""

    @cached_property
    def stretches(self) -> tuple[Stretch, ...]:
        """Two of each sequence; none where there is nothing to simulate them from."""
        if self.quick:
            return (Stretch("demo", range(QUICK_FRAMES)),)
        if self.mocap is None:
            return ()
        return tuple(
            Stretch(name, span, self.split, mocap=self.mocap)
            for name, spans in STRETCHES[self.split].items()
            for span in spans
        )

    def one_each(self, frames: int) -> tuple[Stretch, ...]:
        """The first so many frames of the first stretch of each sequence, for what takes long."""
        return tuple(shorter(each, frames) for each in self.stretches[::2])

    @property
    def shelf(self) -> Path | None:
        """The folder of the Shelf recording; None where there is none."""
        return self._at("shelf")

    @property
    def pose2sim_single(self) -> Path | None:
        """The folder of Pose2Sim's demo recording, and its detections."""
        return self._at("pose2sim_single")

    @property
    def mocap(self) -> Path | None:
        """The file of recorded motions."""
        folder = self._at("cmu_mocap")
        return None if folder is None else folder / "cmu_smpl24.npz"

    def _at(self, name: str) -> Path | None:
        folder = None if self.data is None else self.data / "data" / name
        return folder if folder is not None and folder.is_dir() else None


def shorter(stretch: Stretch, frames: int) -> Stretch:
    """The first so many frames of a stretch, or all that it has."""
    return replace(stretch, span=stretch.span[:frames])


@lru_cache(maxsize=8)
def _scene(stretch: Stretch) -> Scene:
    own = {"people": stretch.people, "seed": stretch.seed} if stretch.name == "demo" else {}
    whole = named_scene(
        stretch.name,
        split=stretch.split,
        cameras=stretch.cameras,
        frames=stretch.span.stop,
        mocap=stretch.mocap,
        config=stretch.made,
        fps=stretch.fps,
        **own,
    )
    scene = whole.part(stretch.span)
    return scene if stretch.bodies is None else recast(scene, people_of(stretch.bodies, scene.people))


@lru_cache(maxsize=8)
def _detections(stretch: Stretch) -> DetectionSequence:
    offsets = DETECTOR_S_OWN if stretch.own_joints else None
    return simulate(_scene(stretch), DetectorConfig(offsets=offsets), stretch.seed)
