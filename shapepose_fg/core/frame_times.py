"""Times of the frames of a recording, and its cuts."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from itertools import pairwise
from typing import Any

import numpy as np

from shapepose_fg.core.arrays import Array

LEAST_FPS, MOST_FPS = 1e-3, 1e6
"""Lowest and highest accepted frame rate, Hz."""
ASSUMED_FPS = 30.0
"""Frame rate that is assumed if none is given, Hz."""


def exact_rate(rate: float, within: float) -> float:
    """The usual frame rate of cameras within `within` of `rate`, Hz; `rate` itself if there is
    none.

    The candidates are the nearest integer, 1000 / 1001 of an integer (NTSC), or a fraction with a
    denominator of up to 10.
    """
    whole, ntsc = Fraction(round(rate)), Fraction(1000 * round(1.001 * rate), 1001)
    nearest = min(whole, ntsc, key=lambda each: abs(each - Fraction(rate)))
    usual = (nearest, Fraction(rate).limit_denominator(10))
    return next(
        (float(each) for each in usual if each > 0 and abs(float(each) - rate) <= within), rate
    )


def typed_rate(fps: float) -> float:
    """The exact rate for a rate given with a few digits, Hz: 29.97 becomes 30000 / 1001."""
    return exact_rate(fps, 2e-6 * fps)


def rate_of(time_s: Array) -> float:
    """Frame rate, Hz, of frames at increasing times (T,), T at least 2; exact if times are rounded,
    or jitter.

    A step of twice the median counts as one dropped frame, and so on. The rate is fitted by a line;
    its uncertainty follows from the deviations of the times from this line. If these exceed a
    quarter of a step, the median step gives the rate.
    """
    time_s = time_s - time_s[0]
    steps, lasts = np.diff(time_s), float(time_s[-1])
    step = float(np.median(steps))
    number = np.append(0, np.cumsum(np.maximum(np.rint(steps / step), 1)))
    slope, start = (float(each) for each in np.polyfit(number, time_s, 1))
    off = float(np.abs(time_s - start - slope * number).max())
    if off > step / 4:
        slope, off, lasts = step, 0.0, step
    return exact_rate(1 / slope, min(2 * (off + 1e-6) / lasts, 0.01) / slope)


LEAST_STEP_S = 1e-5
"""Shortest time between two frames, s: over shorter times the motion model is numerically
singular."""


@dataclass(frozen=True)
class FrameTimes:
    """The times of T frames; frames are numbered from 0 in the file, as in
    `Reconstruction.frame`.
    """

    time_s: Array
    """(T,) seconds; or (T, V), a column for each camera, if they are not synchronised."""
    source: str = "given"
    """Source of the times: "assumed", "fps", "given", or the name of a file."""

    def __post_init__(self) -> None:
        """Check that times are finite and increasing; ValueError naming the first frame that does
        not.
        """
        time_s = np.asarray(self.time_s, dtype=np.float64)
        if time_s.ndim not in (1, 2):
            raise ValueError(f"time_s must be (T,) or (T, V), got {time_s.shape}")
        object.__setattr__(self, "time_s", time_s)
        columns = time_s if time_s.ndim == 2 else time_s[:, None]
        finite = np.isfinite(columns).all(axis=1)
        if not finite.all():
            raise ValueError(f"time_s must be finite, but is not at frame {np.argmin(finite)}")
        rising = np.append(True, (np.diff(columns, axis=0) > LEAST_STEP_S).all(axis=1))
        if not rising.all():
            raise ValueError(
                f"time_s must increase by more than {LEAST_STEP_S:g} s from frame to frame, but "
                f"does not at frame {np.argmin(rising)}"
            )

    def __len__(self) -> int:
        return len(self.time_s)

    @classmethod
    def from_fps(cls, fps: float, frames: int) -> "FrameTimes":
        """`frames` frames at `fps` frames a second, frame 0 at 0 s (`typed_rate`)."""
        if not LEAST_FPS <= fps <= MOST_FPS:
            bounds = f"{LEAST_FPS:g} to {MOST_FPS:g}"
            raise ValueError(f"fps must be {bounds} Hz, got {fps}")
        return cls(np.arange(frames) / typed_rate(fps), source="fps")

    @classmethod
    def assumed(cls, frames: int) -> "FrameTimes":
        """Times of `frames` frames at 30 Hz, for recordings without a known rate; run.json marks it
        as assumed.
        """
        return cls(np.arange(frames) / ASSUMED_FPS, source="assumed")

    @property
    def frame_s(self) -> Array:
        """(T,) the time of each frame: the mean over its cameras, if each has its own."""
        return self.time_s if self.time_s.ndim == 1 else self.time_s.mean(axis=1)

    def of_views(self, views: int) -> Array:
        """(T, V) the time of each frame in each of `views` cameras."""
        return (
            self.time_s if self.time_s.ndim == 2 else np.repeat(self.time_s[:, None], views, axis=1)
        )

    def check(self, frames: int, views: int) -> None:
        """Raise ValueError if the shape is not that of a recording of `frames` frames and `views`
        cameras.
        """
        if len(self) != frames:
            raise ValueError(f"times are needed for each of the {frames} frames, got {len(self)}")
        if self.time_s.ndim == 2 and self.time_s.shape[1] != views:
            raise ValueError(
                f"times need a column for each of the {views} cameras, got {self.time_s.shape[1]}"
            )

    def as_dict(self) -> dict[str, Any]:
        """The entry of run.json about times: their source, and the rate."""
        rate = rate_of(self.frame_s) if len(self) > 1 else None
        return {"source": self.source, "fps": rate, "per_camera": self.time_s.ndim == 2}


def rate_words(run: Mapping[str, Any]) -> str:
    """The rate in a result's `run` in words, and whether it was assumed; empty if unknown."""
    entry = run.get("time") or {}
    if entry.get("fps") is None:
        return ""
    assumed = " (assumed; reconstruct --fps sets it)" if entry.get("source") == "assumed" else ""
    return f", {entry['fps']:.6g} Hz{assumed}"


def check_cuts(cuts: Sequence[int], frames: int) -> tuple[int, ...]:
    """`cuts` if they are increasing frame numbers from 1 to `frames` - 1; ValueError otherwise.

    A cut is the number of the first frame after it. No track or motion continues over a cut.
    """
    numbers = np.asarray(cuts)
    whole = numbers.ndim == 1 and (numbers.size == 0 or numbers.dtype.kind in "iu")
    if not whole or (np.diff(numbers) <= 0).any() or ((numbers < 1) | (numbers >= frames)).any():
        raise ValueError(
            f"cuts must be increasing frame numbers between 1 and {frames - 1}, got {list(cuts)}"
        )
    return tuple(int(cut) for cut in numbers)


def segments(frames: range, cuts: Sequence[int]) -> list[range]:
    """Split `frames` at the cuts; cuts outside of them are ignored."""
    inside = [cut for cut in cuts if frames.start < cut < frames.stop]
    edges = [frames.start, *inside, frames.stop]
    return [range(start, stop) for start, stop in pairwise(edges) if stop > start]


def spans_of(frames: Iterable[int]) -> list[range]:
    """Group frame numbers into ranges of consecutive ones."""
    ordered = sorted(set(frames))
    edges = [
        0,
        *(at for at in range(1, len(ordered)) if ordered[at] != ordered[at - 1] + 1),
        len(ordered),
    ]
    return [range(ordered[a], ordered[b - 1] + 1) for a, b in pairwise(edges) if b > a]
