"""How long a reconstruction takes: stage by stage, by the processor and by the clock, and how much memory."""

import os
import resource
import sys
import time
from dataclasses import dataclass

from shapepose_fg.core.camera import Rig
from shapepose_fg.core.detections import Detections, DetectionSequence
from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.core.skeleton import Skeleton
from shapepose_fg.pipeline.execution import Execution
from shapepose_fg.pipeline.pipeline import PipelineConfig, reconstruct


@dataclass(frozen=True)
class Spent:
    """What a run took."""

    people: Reconstruction
    """What came out."""
    cpu_ms: float
    """Milliseconds a frame of all processors, of processes that it started too."""
    wall_ms: float
    """Milliseconds a frame of the clock."""
    stages_ms: dict[str, float]
    """The clock's milliseconds a frame of each stage, without those of stages inside it."""


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


def spend(recording: DetectionSequence, rig: Rig, config: PipelineConfig, frames: int, workers: int = 1) -> Spent:
    """Reconstruct the first so many frames, and look at the clocks before and after."""
    before, start = os.times(), time.perf_counter()
    people = reconstruct(recording, rig, config, frames=range(frames), execution=Execution(workers=workers))
    wall_s, after = time.perf_counter() - start, os.times()
    stages = {name: 1e3 * seconds / frames for name, seconds in people.run["seconds"].items()}
    return Spent(people, 1e3 * (sum(after[:4]) - sum(before[:4])) / frames, 1e3 * wall_s / frames, stages)


def peak_mib() -> float:
    """The most memory that this process has had so far, MiB; it never falls."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 2**20 if sys.platform == "darwin" else peak / 2**10


def rows_mib(people: Reconstruction) -> float:
    """Memory of a result's rows and of their observations, MiB."""
    tables = [people] if people.observations is None else [people, people.observations]
    return sum(getattr(table, name).nbytes for table in tables for name in table.ROWS) / 2**20
