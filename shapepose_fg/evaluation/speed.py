"""How long a reconstruction takes: stage by stage, by the processor and by the clock, and how much memory."""

import os
import sys
import time
from dataclasses import dataclass

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


@dataclass(frozen=True)
class Spent:
    """What a run took."""

    frames: int
    """Frames of it."""
    cpu_s: float
    """Seconds of all processors, of processes that it started too."""
    wall_s: float
    """Seconds of the clock."""
    people: Reconstruction
    """What came out."""

    def ms(self, stage: str) -> float:
        """The clock's milliseconds a frame of a stage."""
        return 1e3 * self.people.run["seconds"].get(stage, 0.0) / self.frames

    @property
    def cpu_ms(self) -> float:
        """The processor's milliseconds a frame."""
        return 1e3 * self.cpu_s / self.frames

    @property
    def wall_ms(self) -> float:
        """The clock's milliseconds a frame."""
        return 1e3 * self.wall_s / self.frames


@dataclass(frozen=True)
class BackAndForth:
    """A long recording made of a short one, played forwards and backwards in turn, so that no person jumps."""

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
    recording: DetectionSequence, rig: Rig, config: PipelineConfig, frames: range, workers: int = 1
) -> Spent:
    """Reconstruct, and look at the clocks before and after."""
    before, start = os.times(), time.perf_counter()
    people = reconstruct(recording, rig, config, frames=frames, execution=Execution(workers=workers))
    wall_s, after = time.perf_counter() - start, os.times()
    return Spent(len(frames), sum(after[:4]) - sum(before[:4]), wall_s, people)


def peak_mib() -> float:
    """The most memory that this process has had so far, MiB; it never falls."""
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 2**20 if sys.platform == "darwin" else peak / 2**10


def rows_mib(people: Reconstruction) -> float:
    """Memory of a result's rows and of their observations, MiB."""
    tables = [people] if people.observations is None else [people, people.observations]
    return sum(getattr(table, name).nbytes for table in tables for name in table.ROWS) / 2**20
