"""What several commands take: their common options, and what is given as text, a range of frames or a size."""

import re
from typing import Annotated

import typer

from shapepose_fg.core.errors import InputError

FramesOption = Annotated[str | None, typer.Option(metavar="A:B", help="Frames A to B-1; either may be left out.")]
UpOption = Annotated[str | None, typer.Option(metavar="AXIS", help="World axis that points up: x -x y -y z -z.")]
ResultUpOption = Annotated[
    str | None, typer.Option(metavar="AXIS", help="Axis that points up, where cameras.json is not there.")
]
UnitOption = Annotated[str | None, typer.Option(metavar="UNIT", help="Unit of the calibration: m, cm or mm.")]
ImageSizeOption = Annotated[
    str | None, typer.Option(metavar="WxH", help="Size of the calibrated pictures, where the file has none.")
]
SkeletonOption = Annotated[
    str | None, typer.Option(metavar="NAME", help="The detector's skeleton, or a TOML file that describes it.")
]


def image_size_of(text: str | None) -> tuple[int, int] | None:
    """Width and height of `WxH`."""
    if text is None:
        return None
    match = re.fullmatch(r"\s*(\d{1,9})\s*[x×,]\s*(\d{1,9})\s*", text)
    if match is None:
        raise InputError(f"--image-size {text}: must be WIDTHxHEIGHT in pixels, such as 1920x1080")
    return int(match[1]), int(match[2])


def check_fps(fps: float | None) -> None:
    """Refuse frames a second that make no sense."""
    if fps is not None and not 0.01 <= fps <= 1e5:
        raise InputError(f"--fps {fps:g}: must be a number of frames a second, such as 25")


def result_frames(text: str | None) -> range | None:
    """Frames that `A:B` selects of a saved result, whose last is not known yet; None where all are."""
    if text is None:
        return None
    match = _ends(text)
    start, stop = int(match[1] or 0), int(match[2] or 10**18)
    if not start < stop:
        raise InputError(f"--frames {text}: must be A:B with A below B, such as 0:100")
    return range(start, stop)


def refuse_no_range(text: str | None) -> None:
    """Refuse what is not of the form `A:B`, whatever the recording."""
    if text is not None:
        _ends(text)


def frame_range(text: str | None, count: int) -> range:
    """Frames that `A:B` selects of a recording of `count` frames: half-open, either end optional."""
    if text is None:
        return range(count)
    match = _ends(text)
    start, stop = int(match[1] or 0), int(match[2] or count)
    if not start < stop <= count:
        raise InputError(
            f"--frames {text}: not in the recording, which has {count} frames; give A:B with 0 <= A < B <= {count}"
        )
    return range(start, stop)


def _ends(text: str) -> re.Match[str]:
    """Both ends of `A:B`, as text."""
    match = re.fullmatch(r"(\d{0,18}):(\d{0,18})", text.strip())
    if match is None:
        raise InputError(f"--frames {text}: must be A:B, two frame numbers with a colon between, such as 0:100")
    return match


def check_workers(workers: int | None) -> None:
    """Refuse a number of processes that makes no sense."""
    if workers is not None and not 1 <= workers <= 64:
        raise InputError(f"--workers {workers}: must be 1 to 64; leave it out for as many as pay")
