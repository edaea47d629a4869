"""How much an experiment measures: everything, for the documents, or a little, for the tests."""

from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from pathlib import Path

from shapepose_fg.core.detections import DetectionSequence
from shapepose_fg.core.frame_times import FrameTimes
from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.estimation.estimator import ExtraFactors
from shapepose_fg.pipeline.pipeline import PipelineConfig, reconstruct
from shapepose_fg.simulation import Scene, simulate
from shapepose_fg.simulation.files import cut, cuts_of, named_scene
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

QUICK_FRAMES = 6
"""Frames of the scene that a quick run takes."""


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
    mocap: Path | None = field(default=None, compare=False)
    """The recorded motions; None: where SHAPEPOSE_DATA says."""

    @property
    def label(self) -> str:
        """What a table calls it."""
        return f"{self.name} {self.span.start}:{self.span.stop}"

    @property
    def scene(self) -> Scene:
        """The people and cameras."""
        return _scene(self)

    @property
    def detections(self) -> DetectionSequence:
        """What the simulated detector saw."""
        return _detections(self)

    def reconstruct(
        self,
        config: PipelineConfig | None = None,
        frames: range | None = None,
        extra_factors: ExtraFactors | None = None,
    ) -> Reconstruction:
        """Reconstructed at the scene's rate; only `frames` of the stretch, if given."""
        scene = self.scene
        return reconstruct(
            self.detections,
            scene.rig,
            config,
            frames=frames,
            times=FrameTimes.from_fps(scene.fps, len(self.span)),
            cuts=cuts_of(scene),
            extra_factors=extra_factors,
        )


@dataclass(frozen=True)
class Scale:
    """How much is measured, and on what."""

    quick: bool = False
    """A few frames of the built-in scene in place of all stretches: whether everything works, in two minutes."""
    data: Path | None = None
    """Folder with `data/`: recordings and motions. None: there are none."""
    split: Split = "report"
    """Choose on `tune`, report on `report`."""

    @cached_property
    def stretches(self) -> tuple[Stretch, ...]:
        """The stretches; one each of the sequences in `one_each`."""
        if self.quick:
            return (Stretch("demo", range(QUICK_FRAMES)),)
        return tuple(
            Stretch(name, span, self.split, mocap=self.mocap)
            for name, spans in STRETCHES[self.split].items()
            for span in spans
        )

    @property
    def one_each(self) -> tuple[Stretch, ...]:
        """The first stretch of each sequence, for what takes long."""
        return self.stretches if self.quick else self.stretches[::2]

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
        if self.data is None or not (self.data / "data" / name).is_dir():
            return None
        return self.data / "data" / name

    @property
    def has_scenes(self) -> bool:
        """Whether there is anything to simulate stretches from."""
        return self.quick or self.mocap is not None


def shorter(stretch: Stretch, frames: int) -> Stretch:
    """The first so many frames of a stretch, or all that it has."""
    return replace(stretch, span=stretch.span[:frames])


@lru_cache(maxsize=2)
def _scene(stretch: Stretch) -> Scene:
    if stretch.name == "demo":
        whole = named_scene(
            "demo",
            cameras=stretch.cameras,
            people=stretch.people,
            frames=stretch.span.stop,
            seed=stretch.seed,
            fps=stretch.fps,
        )
        return cut(whole, stretch.span)
    whole = named_scene(
        stretch.name,
        split=stretch.split,
        cameras=stretch.cameras,
        frames=stretch.span.stop,
        mocap=stretch.mocap,
        config=stretch.made,
        fps=stretch.fps,
    )
    return cut(whole, stretch.span)


@lru_cache(maxsize=2)
def _detections(stretch: Stretch) -> DetectionSequence:
    return simulate(stretch.scene, seed=stretch.seed)
