"""Options and output shared by `calibrate`, `refine-calibration` and `synchronise`: estimated time
offsets.
"""

import math
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from annotated_types import Interval

from shapepose_fg.cli.options import RESULT, frame_range, option
from shapepose_fg.cli.terminal import note, note_of_reading, progress, show, table
from shapepose_fg.core.errors import InputError

if TYPE_CHECKING:
    from shapepose_fg.cameras.synchronise import Synchronised
    from shapepose_fg.core.arrays import Array
    from shapepose_fg.core.camera import Rig
    from shapepose_fg.io.detections.people import DeclaredJoints

MOST_S = 60.0
"""Default maximum offset between cameras that were started by hand, s."""
Most = Annotated[float, Interval(gt=0, le=600)]
"""The largest offset between cameras, s."""


def report_option() -> Any:
    """The option for an HTML report with drawings."""
    return option(RESULT, "Page for the browser with cameras and people in 3D: FILE.html.")


def write_page(report: Path | None, **content: Any) -> None:
    """Write the page of cameras and people to `report`, if given; `content` as for `CameraPage`."""
    if report is not None:
        from shapepose_fg.viz.report.cameras import CameraPage

        CameraPage(**content).write(report)
        note(f"{report}: cameras and people in 3D, to open in a browser")


def found_clocks(
    detections: Path,
    rig: "Rig",
    skeleton: "str | Path | DeclaredJoints | None",
    fps: float | None,
    most: float,
    frames: str | None = None,
) -> "tuple[Synchronised, Array]":
    """Offsets of cameras with known poses, up to `most` seconds apart, and (T, V) times of the
    frames, seconds on a common clock; NaN for missing frames.

    Their rate is `fps`, by default that of times.csv beside the detections; InputError if there is
    none.
    """
    from shapepose_fg.cameras.synchronise import synchronise
    from shapepose_fg.core.frame_times import rate_of
    from shapepose_fg.io.recording import own_times, read_recording

    with tempfile.TemporaryDirectory(prefix="shapepose-fg-") as folder:
        recording, times = read_recording(
            detections, rig, skeleton, Path(folder), fps, own_frames=True
        )
        note_of_reading(*recording.notes)
        if times is None or len(times) < 2:
            raise InputError("--fps: missing; give the frame rate of the cameras")
        span = frame_range(frames, len(recording), recording.first)
        own_s = from_zero(own_times(recording, times, len(rig)))
        with progress("comparing", "pairs") as done:
            found = synchronise(
                recording,
                rig,
                fps or rate_of(times.frame_s),
                span,
                most,
                progress=done,
                time_s=own_s,
            )
        return found, found.of_views(own_s)


def from_zero(time_s: "Array") -> "Array":
    """(T, V) times of each camera's frames from 0 on, NaN for missing frames."""
    return time_s - np.nanmin(time_s, axis=0)


def show_clocks(found: "Synchronised", rig: "Rig") -> None:
    """Print the offsets."""
    rows = []
    for name, offset, sigma, prominence in zip(
        rig.names, found.offset_s, found.sigma_s, found.prominence, strict=True
    ):
        known = "-" if sigma == 0 else f"{1e3 * sigma:.1f}" if math.isfinite(sigma) else "unknown"
        rows.append((name, f"{offset:+.4f}", known, f"{prominence:.1f}"))
    caption = (
        "start: time of the camera's frame 0 on the first camera's clock; distinct: how clearly "
        "the best offset differs from all others"
    )
    show(table(("camera", "start, s", "± ms", "distinct"), rows, caption=caption))
