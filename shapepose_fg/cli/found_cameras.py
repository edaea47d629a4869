"""What `calibrate`, `refine-calibration` and `synchronise` say alike: clocks that were found."""

import math
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

from shapepose_fg.cli.options import RESULT, frame_range, option
from shapepose_fg.cli.terminal import note, progress, show, table
from shapepose_fg.core.errors import InputError

if TYPE_CHECKING:
    from shapepose_fg.calibration.synchronisation import Synchronised
    from shapepose_fg.core.camera import Rig
    from shapepose_fg.io.detections.people import DeclaredJoints

MOST_S = 60.0
"""Cameras that were started by hand began so far apart, at most, where nobody says more."""


def report_option() -> Any:
    """A page with pictures."""
    return option(RESULT, "Page with the cameras in 3D and people over them, for the browser: FILE.html.")


def found_clocks(
    detections: Path,
    rig: "Rig",
    skeleton: "str | Path | DeclaredJoints | None",
    fps: float,
    most: float,
    frames: str | None = None,
) -> "tuple[Synchronised, int]":
    """When cameras at known poses began, up to `most` seconds apart, and how many frames the longest has."""
    from shapepose_fg.calibration.synchronisation import synchronise
    from shapepose_fg.core.storage.kept_arrays import InFolder
    from shapepose_fg.io.detections import read_detections

    with tempfile.TemporaryDirectory(prefix="shapepose-fg-") as folder:
        recording = read_detections(detections, rig, skeleton, InFolder(Path(folder)), True)
        note(*recording.notes)
        span = frame_range(frames, len(recording), recording.first)
        with progress("comparing", "pairs") as done:
            return synchronise(recording, rig, fps, span, most, progress=done), len(recording)


def check_most(most: float) -> None:
    """Refuse a largest offset that makes no sense."""
    if not 0 < most <= 600:
        raise InputError(f"--most {most:g}: must be above 0, up to 600 seconds")


def show_clocks(found: "Synchronised", rig: "Rig") -> None:
    """The offsets."""
    rows = []
    for name, offset, sigma, sure in zip(rig.names, found.offset_s, found.sigma_s, found.sure, strict=True):
        known = "-" if sigma == 0 else f"{1e3 * sigma:.1f}" if math.isfinite(sigma) else "unknown"
        rows.append((name, f"{offset:+.4f}", known, f"{sure:.1f}"))
    caption = "began: its frame 0, on the first camera's clock; stands out: the offset of all others"
    show(table(("camera", "began, s", "± ms", "stands out"), rows, caption=caption))
