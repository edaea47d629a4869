"""Which pictures of several cameras belong to one moment: the nearest, at most half a frame away."""

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from shapepose_fg.core.arrays import Array, Index
from shapepose_fg.core.errors import InputError
from shapepose_fg.io.footage.footage import Footage
from shapepose_fg.io.footage.places import per_camera
from shapepose_fg.io.validation import is_number

_SAME_RATE = 0.01
"""Rates that differ by less than this share are the same."""
_MISFIT_S = 1e-4
"""Cameras whose pictures of one moment are no farther apart than this are synchronised."""


@dataclass(frozen=True)
class CameraClock:
    """When one camera took its frames."""

    name: str
    """The camera."""
    time: Array
    """(N,) times of its frames on the common clock, rising; seconds, or frames where there is no clock."""
    period: float
    """From one frame to the next, in the same unit."""


@dataclass(frozen=True)
class Lockstep:
    """The moments of a recording, and each camera's picture of each."""

    picture: Index
    """(T, V) place of each camera's frame; -1 where it has none within half a frame."""
    time_s: Array | None
    """(T, V) when those frames were taken, seconds; the moment where there is none. None without a clock."""
    notes: tuple[str, ...]
    """What was left out, and how far pictures of one moment are apart."""

    def __len__(self) -> int:
        return len(self.picture)

    @property
    def synchronised(self) -> bool:
        """Whether all cameras took each moment's pictures at one time."""
        return self.time_s is None or bool(np.ptp(self.time_s, axis=1).max(initial=0.0) <= _MISFIT_S)


def clocks_of(
    footage: Sequence[Footage], fps: Sequence[str], start: Sequence[str], cameras: Sequence[str]
) -> tuple[list[CameraClock], bool]:
    """When each camera took its frames, and whether in seconds: without any rate frames are counted.

    `fps` and `start` are options, as `per_camera` reads them.
    """
    rates = [typed_rate(text) for text in per_camera("--fps", fps, cameras, one_for_all=True)]
    starts = per_camera("--start", start, cameras)
    timed = [rate is not None or each.time_s is not None for rate, each in zip(rates, footage, strict=True)]
    has_clock = any(timed)
    if has_clock and not all(timed):
        name = cameras[timed.index(False)]
        raise InputError(f"camera {name}: pictures do not say when they were taken; give --fps {name}=RATE")
    # Pictures of one number belong together: all are counted from the first number that any camera has.
    first = min((each.number[0] for each in footage if each.time_s is None), default=0)
    clocks = []
    for name, each, rate, text in zip(cameras, footage, rates, starts, strict=True):
        number = each.number - (first if each.time_s is None else 0)
        if rate is not None:
            taken, period = number / rate, 1 / rate
        elif each.time_s is not None:
            taken = each.time_s
            period = float(np.median(np.diff(taken))) if len(taken) > 1 else 1 / 30
        else:
            taken, period = number.astype(np.float64), 1.0
        clocks.append(CameraClock(name, taken + typed_start(text, period, has_clock), period))
    return clocks, has_clock


def typed_rate(text: str | None) -> float | None:
    """Frames a second."""
    if text is None:
        return None
    if not is_number(text) or not 0.01 <= float(text) <= 1e5:
        raise InputError(f"--fps {text}: must be a number of frames a second, such as 25")
    return float(text)


def typed_start(text: str | None, period: float, has_clock: bool) -> float:
    """When a camera's first frame was taken, in seconds, or in frames where there is no clock."""
    if text is None:
        return 0.0
    match = re.fullmatch(r"([-+]?(?:\d+\.?\d*|\.\d+))\s*([sf])", text.strip())
    if match is None:
        raise InputError(f"--start {text}: must be seconds such as 0.2s, or the camera's own frames such as 12f")
    if match[2] == "s" and not has_clock:
        raise InputError(f"--start {text}: nothing says how many frames a second there are; give --fps, or 12f")
    return float(match[1]) * (1.0 if match[2] == "s" else period)


def align(clocks: Sequence[CameraClock], has_clock: bool) -> Lockstep:
    """The moments that all cameras saw.

    They are those of the slowest camera (of several the one with most frames), from where the last camera starts
    to where the first one ends. InputError where there are none.
    """
    first = max(each.time[0] - each.period / 2 for each in clocks)
    last = min(each.time[-1] + each.period / 2 for each in clocks)
    slowest = max(each.period for each in clocks)
    inside = [((each.time >= first) & (each.time <= last)).sum() for each in clocks]
    slow = [v for v, each in enumerate(clocks) if each.period >= slowest * (1 - _SAME_RATE)]
    master = max(slow, key=lambda v: (inside[v], -v))
    moment = clocks[master].time
    moment = moment[(moment >= first) & (moment <= last)]
    if len(moment) == 0:
        late = max(clocks, key=lambda each: each.time[0])
        early, unit = min(clocks, key=lambda each: each.time[-1]), " s" if has_clock else ""
        raise InputError(
            f"camera {early.name} ends at {early.time[-1]:.6g}{unit} and camera {late.name} starts at"
            f" {late.time[0]:.6g}{unit}: they have no moment in common; check --start"
        )
    nearest = [_nearest(each, moment) for each in clocks]
    picture = np.column_stack([place for place, _ in nearest])
    notes = list[str]()
    for each, (place, off) in zip(clocks, nearest, strict=True):
        missing, misfit = np.flatnonzero(place < 0), 1e3 * off[place >= 0]
        if left_out := _left_out(each, place, slowest):
            what = "frames that another camera has no picture for were left out"
            notes.append(f"camera {each.name}: {what}, {left_out}")
        if len(missing) > 0:
            notes.append(
                f"camera {each.name}: no picture within half a frame of {len(missing)} of {len(moment)} moments"
                f" (the first is frame {missing[0]}); it sees no people there"
            )
        if has_clock and misfit.max(initial=0.0) > 1e3 * _MISFIT_S:
            notes.append(
                f"camera {each.name}: pictures are up to {misfit.max():.1f} ms from the moment they stand"
                f" for ({misfit.mean():.1f} ms in the mean)"
            )
    time_s = None
    if has_clock:
        taken = [np.where(picture[:, v] >= 0, each.time[picture[:, v]], moment) for v, each in enumerate(clocks)]
        time_s = np.column_stack(taken)
    return Lockstep(picture, time_s, tuple(notes))


def _nearest(clock: CameraClock, moment: Array) -> tuple[Index, Array]:
    """(T,) place of the frame nearest to each moment, -1 where it is more than half a frame away; and how far."""
    after = np.clip(np.searchsorted(clock.time, moment), 0, len(clock.time) - 1)
    before = np.maximum(after - 1, 0)
    nearer = np.abs(clock.time[before] - moment) <= np.abs(clock.time[after] - moment)
    place = np.where(nearer, before, after)
    off = np.abs(clock.time[place] - moment)
    # Times in files are rounded to a microsecond or so.
    return np.where(off <= clock.period / 2 * (1 + 1e-3) + 1e-9, place, -1), off


def _left_out(clock: CameraClock, place: Index, moment: float) -> str:
    """How many frames a camera took before and after the moments, which follow each other after `moment`."""
    used = place[place >= 0]
    ends = [(int(used[0]), "start"), (int(len(clock.time) - 1 - used[-1]), "end")] if len(used) > 0 else []
    # A faster camera always has frames between the moments.
    return " and ".join(f"{n} at the {end}" for n, end in ends if n > 0 and n * clock.period >= 0.99 * moment)
