"""Simulated scenes reconstructed and scored against the truth: segments, and the tables of people
over time.
"""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache, partial
from pathlib import Path

import numpy as np

from shapepose_fg.core.detections import DetectionSequence
from shapepose_fg.core.frame_times import FrameTimes
from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.evaluation.experiments.experiment import Case, Experiment, Figures, columns
from shapepose_fg.evaluation.tracking import score_tracks
from shapepose_fg.pipeline.pipeline import PipelineConfig, reconstruct
from shapepose_fg.simulation import Scene, simulate
from shapepose_fg.simulation.files import named_scene, truth_of
from shapepose_fg.simulation.mocap import Mocap
from shapepose_fg.simulation.sequences import SEQUENCES, SequenceConfig, Split
from shapepose_fg.simulation.training.motions import split_of

SEGMENTS: dict[Split, dict[str, tuple[int, int]]] = {
    "report": {"salsa": (108, 618), "crossing": (0, 726), "crowd": (0, 826)},
    "tune": {"salsa": (0, 564), "crossing": (0, 564), "crowd": (241, 900)},
}
"""First frames of the segments of the named sequences; each segment has 300 frames without a
cut."""
RECORDINGS = ("shelf", "cmu_mocap")
"""Folders of the recordings and of the recorded motions for experiments."""
QUICK_FRAMES = 4
"""Number of frames of a scene in a quick run."""


@dataclass(frozen=True)
class Segment:
    """Consecutive frames of a simulated scene."""

    name: str
    """`salsa`, `crossing` or `crowd`; `demo` is the built-in scene."""
    span: range
    """Frames of the scene."""
    split: Split = "report"
    """Split of the recorded motions."""
    cameras: int = 6
    """Number of views."""
    seed: int = 0
    """Seed of the detector's errors, and of the built-in scene."""
    people: int = 4
    """Number of people in the built-in scene; a sequence has its own."""
    made: SequenceConfig | None = None
    """Configuration of a sequence, instead of the named one's."""
    fps: float | None = None
    """Frame rate, Hz; None: the scene's own."""
    mocap: Path | None = field(default=None, compare=False)
    """The file of recorded motions; None: that of SHAPEPOSE_DATA."""

    @property
    def label(self) -> str:
        """Name of the segment in tables."""
        return f"{self.name} {self.span.start}:{self.span.stop}"

    @property
    def scene(self) -> Scene:
        """The people and the cameras."""
        return _scene(self)

    @property
    def detections(self) -> DetectionSequence:
        """Detections of the simulated detector."""
        return _detections(self)

    @property
    def truth(self) -> Reconstruction:
        """The people as a result, in which identities change at a cut."""
        truth = truth_of(self.scene)
        part = np.searchsorted(self.scene.cuts, truth.frame, side="right")
        return replace(truth, person=truth.person + part * (int(truth.person.max(initial=0)) + 1))

    def reconstruct(self, config: PipelineConfig | None = None) -> Reconstruction:
        """Reconstruct at the scene's rate."""
        scene = self.scene
        times = FrameTimes.from_fps(scene.fps, len(self.span))
        return reconstruct(self.detections, scene.rig, config, times=times, cuts=scene.cuts)


@dataclass(frozen=True)
class Scale:
    """Size of the measurement, and its data."""

    quick: bool = False
    """A few frames of the built-in scene instead of all segments: a test of all steps, in two
    minutes."""
    data: Path | None = None
    """Folder with the `RECORDINGS`. None: there are none."""
    split: Split = "report"
    """Split of the recorded motions: choose on `tune`, report on `report`."""
    seeds: tuple[int, ...] = tuple(range(6101, 6106))
    """Seeds of the random sequences of `who is there`."""

    @cached_property
    def segments(self) -> tuple[Segment, ...]:
        """Two segments of each sequence; none without recorded motions."""
        if self.quick:
            return (Segment("demo", range(QUICK_FRAMES)),)
        every = SEGMENTS[self.split].items() if self.mocap is not None else ()
        begins = ((name, start) for name, starts in every for start in starts)
        return tuple(
            Segment(name, range(n, n + 300), self.split, mocap=self.mocap) for name, n in begins
        )

    def recording(self, name: str) -> Path | None:
        """The folder of one of the `RECORDINGS`; None if it is missing."""
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
    return whole.part(segment.span)


@lru_cache(maxsize=8)
def _detections(segment: Segment) -> DetectionSequence:
    return simulate(_scene(segment), seed=segment.seed)


OVER_TIME = PipelineConfig()
FRAME_BY_FRAME = replace(OVER_TIME, temporal=False)
MODES = {"over time": OVER_TIME, "frame by frame": FRAME_BY_FRAME}

COLUMNS = columns(
    ("F1", "f1"), ("recall", "recall"), ("IDF1", "idf1"), ("MPJPE", "mpjpe_mm"),
    ("accel", "acceleration_error"), ("FP", "false_positives", 0), ("missed", "people_missed", 0),
    ("switches", "switches", 0), ("wrist", "fast_wrist_error_mm"), ("body", "body_mpjpe_mm"),
    ("b accel", "body_acceleration_error"), ("50 %", "seen_inside_50"), ("95 %", "seen_inside_95"),
    ("u", "joints_unseen", 0), ("u 50 %", "unseen_inside_50"), ("u 95 %", "unseen_inside_95"),
    ("v", "velocity_error", 2), ("v 95 %", "velocity_inside_95"), ("ms", "cpu_ms", 0),
)  # fmt: skip
"""Columns of the tables: lengths in mm, accelerations in m/s², velocities in m/s, `u`: joints that
no view has seen for ten frames; ms: processor time per frame. Means over segments."""
CLASSES = {"seen": "2 views", "one_view": "1", "no_view": "0", "unseen": "0 for ten frames"}
THERE_COLUMNS = columns(
    ("F1, mean", "f1", 2), ("least", "f1", 2, "least"), ("IDF1, mean", "idf1", 2),
    ("least", "idf1", 2, "least"), ("missed", "people_missed", 0, "sum"),
    ("of", "people", 0, "sum"), ("FP", "false_positives", 0, "sum"),
    ("longest", "longest_false_positive", 0, "most"), ("ms", "cpu_ms", 0),
) + tuple(
    column
    for name, words in CLASSES.items()
    for column in columns(
        (f"{words}: inside 50 %", f"{name}_inside_50", 0), ("95 %", f"{name}_inside_95", 0),
        ("log score", f"{name}_log_score", 2), ("joints", f"joints_{name}", 0, "sum"),
    )
)  # fmt: skip
HELD_BACK_SEED, HELD_BACK = 1001, {"salsa": 0, "crossing": 108, "crowd": 0}
"""First of 300 frames without a cut, for each sequence."""
SECONDS, RATES, CAMERAS = 4.0, (10, 15, 20, 30, 60), (2, 3, 4, 6)
"""Duration, s, frame rates, Hz, and numbers of cameras of the recordings of `who is there`."""


def measure(segment: Segment, config: PipelineConfig) -> Figures:
    """`TrackingScore.as_dict` of a segment, the number of people over all frames, and `cpu_ms` a
    frame.
    """
    detections = segment.detections
    began = time.process_time()
    people = segment.reconstruct(config)
    cpu_ms = 1e3 * (time.process_time() - began) / len(detections)
    found = score_tracks(people, segment.truth, segment.scene.fps, identities=config.temporal)
    return found.as_dict() | {"cpu_ms": cpu_ms, "people": found.joints.people_true}


def case(name: str, segment: Segment, config: PipelineConfig = OVER_TIME) -> Case:
    """A case that reconstructs and scores a segment."""
    return Case(name, partial(measure, segment, config))


def with_mean(cases: Sequence[Case], label: str = "**mean**") -> dict[str, list[Case]]:
    """A row for each case, and one for the mean of all."""
    return {case.name: [case] for case in cases} | {label: list(cases)}


def in_time(scale: Scale) -> Experiment:
    """All segments, with `temporal = true`."""
    return Experiment(
        "time", with_mean([case(each.label, each) for each in scale.segments]), COLUMNS
    )


def held_back(scale: Scale) -> Experiment:
    """Held-out people, in sequences that were created after all settings had been chosen.

    The dancers are the same recordings as in the reported segments, which are not used for
    training. People who stand and walk around them are test subjects only. Positions, bodies,
    cameras and the detector's errors are from new random draws.
    """
    rows = dict[str, list[Case]]()
    segments = () if scale.mocap is None or scale.quick else held_back_segments(scale.mocap)
    for name, config in MODES.items():
        cases = [case(f"{each.label} {name}", each, config) for each in segments]
        rows |= with_mean(cases, f"**mean, {name}**")
    return Experiment("held back", rows, COLUMNS)


def held_back_segments(mocap: Path) -> list[Segment]:
    """The segments of `held_back`, from the recorded motions in a file."""
    learnt_from = frozenset(
        subject for subject in Mocap.load(mocap).subjects if split_of(subject) != "test"
    )
    made = {
        name: replace(SEQUENCES[name], seed=HELD_BACK_SEED, without=learnt_from)
        for name in HELD_BACK
    }
    return [
        Segment(name, range(start, start + 300), seed=HELD_BACK_SEED, made=made[name], mocap=mocap)
        for name, start in HELD_BACK.items()
    ]


def who_is_there(scale: Scale) -> Experiment:
    """Crowds of eight people and crossings of seven with 2 to 8 cameras, at 10 to 60 frames a
    second; and two people.

    A row for each kind of recording, over its seeds, and for each number of cameras. Eight cameras,
    two people and single frames are measured at 30 frames a second only: single frames are
    independent of the rate.
    """
    rows, of_cameras = dict[str, list[Case]](), dict[str, list[Case]]()
    for (name, cameras, rate), drawn in _crowds(scale).items():
        for mode, config in MODES.items():
            if not config.temporal and rate != 30:
                continue
            kind = f"{cameras} cameras {rate} Hz" + ("" if config.temporal else f", {mode}")
            cases = [
                case(f"{name} {seed} {kind}", segment, config) for seed, segment in drawn.items()
            ]
            rows[f"{name}, {kind}"] = cases
            if config.temporal:
                of_cameras.setdefault(f"**all, {cameras} cameras**", []).extend(cases)
    return Experiment("who is there", rows | of_cameras, THERE_COLUMNS)


def _crowds(scale: Scale) -> Mapping[tuple[str, int, int], Mapping[int, Segment]]:
    """Recordings by name, cameras and frames a second, and by seed."""
    seeds = scale.seeds[:1] if scale.quick else scale.seeds
    made = {
        (name, seed): replace(SEQUENCES[name], seed=seed)
        for name in ("crowd", "crossing")
        for seed in seeds
    }
    kinds = [*((cameras, rate) for cameras in CAMERAS for rate in RATES), (8, 30)]
    found: dict[tuple[str, int, int], dict[int, Segment]] = {}
    for (name, seed), config in made.items() if not scale.quick and scale.mocap is not None else ():
        for cameras, rate in kinds:
            span = range(round(SECONDS * rate))
            drawn = Segment(
                name, span, scale.split, cameras, seed, made=config, fps=rate, mocap=scale.mocap
            )
            found.setdefault((name, cameras, rate), {})[seed] = drawn
    frames = range(QUICK_FRAMES if scale.quick else round(SECONDS * 30))
    two = Segment("demo", frames, cameras=2, people=2, fps=30)
    return found | {("two people", 2, 30): {seed: replace(two, seed=seed) for seed in seeds}}
