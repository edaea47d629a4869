"""Options that commands on a saved result share."""

import re
from pathlib import Path

from shapepose_fg.errors import InputError


def results_folder(results: Path) -> Path:
    """The folder of a result, which may be given as its people.npz too."""
    return results.parent if results.name == "people.npz" else results


def checked_fps(fps: float | None) -> float | None:
    """Frames a second that make sense."""
    if fps is not None and not 0.01 <= fps <= 1e5:
        raise InputError(f"--fps {fps:g}: must be a number of frames a second, such as 25")
    return fps


def frame_range(text: str | None) -> range | None:
    """Frames that `A:B` selects: half-open, either end optional."""
    if text is None:
        return None
    match = re.fullmatch(r"(\d{0,12}):(\d{0,12})", text.strip())
    if match is None or (match[2] and int(match[1] or 0) >= int(match[2])):
        raise InputError(f"--frames {text}: must be A:B, two frame numbers with a colon between, such as 0:100")
    return range(int(match[1] or 0), int(match[2] or 10**12))
