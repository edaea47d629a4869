"""What is to be reconstructed."""

import inspect
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import wraps
from typing import ParamSpec, TypeVar

from shapepose_fg.body.fitting.fitter import BodyFitter
from shapepose_fg.body.shapes import SubjectShapes
from shapepose_fg.core.camera import Rig
from shapepose_fg.core.detections import DetectionSequence
from shapepose_fg.core.frame_times import FrameTimes, check_cuts
from shapepose_fg.estimation.estimator import ExtraFactors
from shapepose_fg.pipeline.config import PipelineConfig

P = ParamSpec("P")
R = TypeVar("R")


@dataclass(frozen=True)
class Task:
    """What is to be reconstructed: the arguments of `reconstruct`, which describes them."""

    detections: DetectionSequence
    rig: Rig
    config: PipelineConfig = field(default_factory=PipelineConfig)
    frames: range | None = None
    times: FrameTimes | None = None
    cuts: Sequence[int] = ()
    shapes: SubjectShapes | None = None
    fitter: BodyFitter | None = None
    extra_factors: ExtraFactors | None = None

    def whole(self) -> tuple[range, FrameTimes, list[int]]:
        """Frames, times and cuts, those that are not given filled in; ValueError where they do not fit."""
        count = len(self.detections)
        frames = range(count) if self.frames is None else self.frames
        if frames.step != 1 or not 0 <= frames.start <= frames.stop <= count:
            raise ValueError(f"frames must be a range of step 1 within 0:{count}, got {frames}")
        times = FrameTimes.assumed(count) if self.times is None else self.times
        times.check(count, len(self.rig))
        return frames, times, list(check_cuts(self.cuts, count))


def moved_into_execution(function: Callable[P, R]) -> Callable[P, R]:
    """`function`, which names `Execution` where it is given an argument that went there."""
    moved = {"workers", "cluster", "chunk_frames", "progress"} - inspect.signature(function).parameters.keys()

    @wraps(function)
    def called(*arguments: P.args, **options: P.kwargs) -> R:
        for name in moved & options.keys():
            raise TypeError(f"{name} is a part of what runs it now: give execution=Execution({name}=...)")
        return function(*arguments, **options)

    return called
