"""When the frames of a recording were taken, as commands are told, and the line that goes on from there."""

import shlex
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from shapepose_fg.cli.options import TIME, check_fps, frame_range, frames_option, option
from shapepose_fg.core.errors import InputError

if TYPE_CHECKING:
    from shapepose_fg.core.camera import Rig
    from shapepose_fg.core.frame_times import FrameTimes


@dataclass(frozen=True, kw_only=True)
class RateOptions:
    """When frames were taken, and which are used."""

    fps: float | None = option(TIME, "Frames a second; 30 where nothing says it.")
    timestamps: Path | None = option(TIME, "Time of every frame, seconds; times.csv beside the detections.")
    frames: str | None = frames_option()

    def span(self, count: int, first: int = 0) -> range:
        """The frames that are used, of a recording of `count` frames that begins at `first`."""
        return frame_range(self.frames, count, first)

    def times(self, detections: Path, rig: "Rig", count: int) -> "FrameTimes":
        """Of a recording of `count` frames."""
        from shapepose_fg.core.frame_times import FrameTimes
        from shapepose_fg.io.timestamps import read_timestamps

        if self.fps is not None and self.timestamps is not None:
            raise InputError("--fps and --timestamps: both say when frames were taken; give one of them")
        check_fps(self.fps)
        beside = detections / "times.csv"
        file = self.timestamps or (beside if self.fps is None and beside.is_file() else None)
        if file is not None:
            return read_timestamps(file, rig, count)
        return FrameTimes.assumed(count) if self.fps is None else FrameTimes.from_fps(self.fps, count)


def next_command(
    cameras: Path,
    detections: Path,
    skeleton: str | None,
    rate: RateOptions,
    said: Mapping[str, object] | None = None,
    output: str | Path = "results",
) -> str:
    """How to reconstruct, as a line to copy; `said` are options that the file of the cameras needs beside it."""
    options: dict[str, object] = {"--calibration": cameras, "--detections": detections, "--skeleton": skeleton}
    options |= said or {}
    options |= {"--fps": rate.fps, "--timestamps": rate.timestamps, "--frames": rate.frames, "--output": output}
    words = [word for name, value in options.items() if value is not None for word in (name, str(value))]
    return f"next: {shlex.join(['shapepose-fg', 'reconstruct', *words])}"
