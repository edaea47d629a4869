"""How long a reconstruction takes: stage by stage, by the processor and by the clock, and how much memory."""

import cProfile
import os
import pstats
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.body.fitting.baseline import LevenbergMarquardtFitter
from shapepose_fg.body.fitting.body_sequence import SequenceFit, Shapes
from shapepose_fg.body.fitting.fitter import BodyFit, JointTargets
from shapepose_fg.body.fitting.fitters import make_fitter
from shapepose_fg.body.fitting.learned import LearnedFitter
from shapepose_fg.body.model.body_model import BodyModel
from shapepose_fg.body.model.keypoint_offsets import KeypointOffsets
from shapepose_fg.core.camera import Rig
from shapepose_fg.core.detections import Detections, DetectionSequence
from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.core.skeleton import Skeleton
from shapepose_fg.pipeline.execution import Execution
from shapepose_fg.pipeline.pipeline import PipelineConfig, reconstruct

STAGES = (
    "read",
    "offsets",
    "triangulate",
    "vote",
    "propose",
    "associate",
    "follow",
    "associate again",
    "solve",
    "bodies over time",
)
"""Of `Reconstruction.run["seconds"]`; a stage's time is without that of stages inside it."""
PARTS = {
    "graphs built": ("estimator.py", "_windows"),
    "graphs solved": ("alternation.py", "_solve"),
    "covariances": ("state_covariances.py", "state_covariances"),
    "gates and weights": ("linearisation.py", "linearise"),
}
"""Parts of stage II beside the body fits, and the function whose time is taken for each."""


@dataclass(frozen=True)
class Spent:
    """What a run took."""

    frames: int
    """Frames of it."""
    cpu_s: float
    """Seconds of all processors, of processes that it started too."""
    wall_s: float
    """Seconds of the clock."""
    seconds: dict[str, float]
    """Seconds of the clock by `STAGES`; `bodies` is the part of `solve` in which bodies are fitted."""
    people: Reconstruction
    """What came out."""

    def ms(self, stage: str) -> float:
        """Milliseconds a frame of a stage."""
        return 1e3 * self.seconds.get(stage, 0.0) / self.frames

    @property
    def cpu_ms(self) -> float:
        """The processor's milliseconds a frame."""
        return 1e3 * self.cpu_s / self.frames

    @property
    def wall_ms(self) -> float:
        """The clock's milliseconds a frame."""
        return 1e3 * self.wall_s / self.frames


@dataclass(frozen=True)
class TimedFitter:
    """A body fitter that adds up the time it takes."""

    fitter: "LearnedFitter | LevenbergMarquardtFitter"
    """Does the work."""
    clock: list[float] = field(default_factory=lambda: [0.0])
    """Seconds so far, those of fitters made from this one too."""

    @property
    def model(self) -> BodyModel:
        """The body that is fitted."""
        return self.fitter.model

    def with_keypoint_offsets(self, offsets: KeypointOffsets) -> "TimedFitter":
        """The same with the detector's offsets, on the same clock."""
        return TimedFitter(self.fitter.with_keypoint_offsets(offsets), self.clock)

    def fit(
        self, targets: JointTargets, initial: BodyFit | None = None, groups: NDArray[np.intp] | None = None
    ) -> BodyFit:
        """Fit, and look at the clock before and after."""
        start = time.perf_counter()
        result = self.fitter.fit(targets, initial, groups)
        self.clock[0] += time.perf_counter() - start
        return result

    def fit_whole(self, targets: JointTargets, initial: BodyFit | None = None) -> BodyFit:
        """The wrapped fitter's, off the clock: drafts are a stage of their own."""
        return self.fitter.fit_whole(targets, initial)

    def fit_sequence(
        self,
        targets: JointTargets,
        groups: NDArray[np.intp],
        time_s: NDArray[np.float64],
        shapes: Shapes | None = None,
        *,
        fixed_shapes: bool = False,
    ) -> SequenceFit:
        """The wrapped fitter's, off the clock: bodies over time are a stage of their own."""
        return self.fitter.fit_sequence(targets, groups, time_s, shapes, fixed_shapes=fixed_shapes)


@dataclass(frozen=True)
class BackAndForth:
    """A long recording made of a short one, played forwards and backwards in turn: nobody jumps."""

    sequence: DetectionSequence
    """The short recording."""
    frames: int
    """Frames of the long one."""

    @property
    def skeleton(self) -> Skeleton:
        """The detector's joints."""
        return self.sequence.skeleton

    def __len__(self) -> int:
        return self.frames

    def __getitem__(self, frame: int, /) -> Detections:
        count = len(self.sequence)
        turn, place = divmod(frame, count)
        return self.sequence[place if turn % 2 == 0 else count - 1 - place]


def spend(
    recording: DetectionSequence,
    rig: Rig,
    config: PipelineConfig,
    frames: range,
    workers: int = 1,
    chunk_frames: int | None = None,
) -> Spent:
    """Reconstruct, and look at the clocks before and after; loading the body counts for nothing.

    With several `workers` the fitter's own time is not known: it passes in other processes.
    """
    fitter = TimedFitter(make_fitter(config.body, BodyModel.default().with_keypoints(recording.skeleton.joints)))
    before, start = os.times(), time.perf_counter()
    execution = Execution(workers=workers, chunk_frames=chunk_frames)
    people = reconstruct(recording, rig, config, frames=frames, fitter=fitter, execution=execution)
    wall_s, after = time.perf_counter() - start, os.times()
    seconds = dict(people.run["seconds"])
    return Spent(
        len(frames), sum(after[:4]) - sum(before[:4]), wall_s, seconds | {"bodies": fitter.clock[0]}, people
    )


def stage_two(recording: DetectionSequence, rig: Rig, config: PipelineConfig, frames: range) -> dict[str, float]:
    """Shares of stage II without the body fits, from a pass under Python's profiler.

    The profiler slows Python down and leaves GTSAM and torch as they are: shares of a few per cent are rough.
    """
    fitter = TimedFitter(make_fitter(config.body))
    profile = cProfile.Profile()
    profile.runcall(reconstruct, recording, rig, config, frames=frames, fitter=fitter)
    spent: dict[tuple[str, str], float] = {}
    for (file, _, function), row in vars(pstats.Stats(profile))["stats"].items():
        key = Path(file).name, function
        spent[key] = max(spent.get(key, 0.0), row[3])
    here = Path(__file__).name
    # Drafts are stage II, too: gates and weights are theirs as well.
    whole = sum(spent["estimator.py", name] for name in ("estimate", "draft"))
    whole -= sum(spent.get((here, name), 0.0) for name in ("fit", "fit_whole"))
    shares = {part: spent.get(where, 0.0) / whole for part, where in PARTS.items()}
    return shares | {"the rest": 1.0 - sum(shares.values())}


def peak_mib() -> float:
    """The most memory that this process has had so far, MiB; it never falls."""
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 2**20 if sys.platform == "darwin" else peak / 2**10


def rows_mib(people: Reconstruction) -> float:
    """Memory of a result's rows and of their observations, MiB."""
    tables = [people] if people.observations is None else [people, people.observations]
    return sum(getattr(table, name).nbytes for table in tables for name in table.ROWS) / 2**20
