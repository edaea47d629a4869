"""Synchronised frame sets: groups of pictures of several cameras at the same time, at most half a
frame apart.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from shapepose_fg.core.arrays import Array, Index
from shapepose_fg.core.errors import InputError

_SAME_RATE = 0.01
"""Relative difference below which two frame rates are the same."""
AT_ONCE_S = 1e-3
"""Largest spread of the times of a frame set, s, up to which cameras count as synchronised: a hand
at 5 m/s moves by 5 mm."""


@dataclass(frozen=True)
class CameraClock:
    """The times of one camera's frames."""

    name: str
    """The camera's name."""
    time: Array
    """(N,) increasing times of the camera's frames on the common clock; seconds, or frames if there
    is no clock."""
    period: float
    """Time from one frame to the next, in the same unit."""


@dataclass(frozen=True)
class FrameSets:
    """The synchronised frame sets of a recording: one picture of each camera per set."""

    picture: Index
    """(T, V) index of each camera's picture; -1 if the camera has none within half a frame."""
    time_s: Array | None
    """(T, V) times of the pictures of each set, seconds; for a missing picture, the time of the
    set, or NaN if start times are unknown. None without a clock."""
    notes: tuple[str, ...]
    """Notes on pictures that were left out, and on the time differences within a set."""

    def __len__(self) -> int:
        return len(self.picture)

    @property
    def synchronised(self) -> bool:
        """Whether all cameras took the pictures of a set at the same time."""
        return self.time_s is None or bool(
            np.ptp(self.time_s, axis=1).max(initial=0.0) <= AT_ONCE_S
        )


def align(clocks: Sequence[CameraClock], has_clock: bool, cure: str = "check --start") -> FrameSets:
    """Group the pictures of all cameras into synchronised frame sets.

    The sets have the times of the slowest camera (among equally slow ones, of that with most
    frames), from the start of the last camera to the end of the first one. A picture belongs to one
    set only. InputError, ending with the `cure`, if there are no sets.
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
            f"camera {early.name} ends at {early.time[-1]:.6g}{unit} and camera {late.name} "
            f"starts at {late.time[0]:.6g}{unit}: they have no time in common; {cure}"
        )
    nearest = [_nearest(each, moment) for each in clocks]
    picture = np.column_stack([place for place, _ in nearest])
    notes = list[str]()
    for each, (place, off) in zip(clocks, nearest, strict=True):
        missing, misfit, found = np.flatnonzero(place < 0), 1e3 * off[place >= 0], list[str]()
        if left_out := _left_out(each, place, slowest):
            found.append(f"frames without a picture of every camera are left out, {left_out}")
        if len(missing) > 0:
            found.append(
                f"{len(missing)} of {len(moment)} synchronised frames have no picture within half "
                f"a frame (the first is frame {missing[0]}) and are read as frames without people"
            )
        if has_clock and misfit.max(initial=0.0) > 1e2 * AT_ONCE_S:
            found.append(
                f"pictures are up to {misfit.max():.1f} ms from the time of their synchronised "
                f"frame ({misfit.mean():.1f} ms on average)"
            )
        if found:
            notes.append(f"camera {each.name}: {'; '.join(found)}")
    time_s = None
    if has_clock:
        taken = [
            np.where(picture[:, v] >= 0, each.time[picture[:, v]], moment)
            for v, each in enumerate(clocks)
        ]
        time_s = np.column_stack(taken)
    return FrameSets(picture, time_s, tuple(notes))


def own_frames(clocks: Sequence[CameraClock], has_clock: bool) -> FrameSets:
    """Group pictures by number, counted from each camera's own first picture, because start times
    are unknown.

    Frame t of a camera is the picture nearest to t periods of the slowest camera after its own
    first picture. Only pictures between these are left out.
    """
    slowest = max(each.period for each in clocks)
    places = []
    for each in clocks:
        place = np.arange(len(each.time))
        if each.period < slowest * (1 - _SAME_RATE):
            grid = np.arange(each.time[0], each.time[-1] + each.period / 2, slowest)
            place = _nearest(each, grid)[0]
        places.append(place)
    count = max(map(len, places))
    picture = np.column_stack(
        [np.pad(place, (0, count - len(place)), constant_values=-1) for place in places]
    )
    time_s = None
    if has_clock:
        taken = [
            np.where(own >= 0, each.time[own], np.nan)
            for own, each in zip(picture.T, clocks, strict=True)
        ]
        time_s = np.column_stack(taken)
    least = min(map(len, places))
    notes = (
        f"cameras have {least} to {count} frames; all frames are processed, with each camera's "
        "own numbers. Give start times with --start, or estimate them with `calibrate --times`, "
        "or with `synchronise` if the poses are known",
    )
    return FrameSets(picture, time_s, notes if least < count else ())


def _nearest(clock: CameraClock, moment: Array) -> tuple[Index, Array]:
    """(T,) index of the frame nearest to each time, -1 if it is more than half a frame away; and
    the distance in time.
    """
    after = np.clip(np.searchsorted(clock.time, moment), 0, len(clock.time) - 1)
    before = np.maximum(after - 1, 0)
    nearer = np.abs(clock.time[before] - moment) <= np.abs(clock.time[after] - moment)
    place = np.where(nearer, before, after)
    off = np.abs(clock.time[place] - moment)
    # Times in files are rounded to about a microsecond.
    place = np.where(off <= clock.period / 2 * (1 + 1e-3) + 1e-9, place, -1)
    # With drifting rates, a picture may be half a frame from two sets: the nearer one gets it.
    twice = np.flatnonzero((place[1:] == place[:-1]) & (place[1:] >= 0))
    place[np.where(off[twice] <= off[twice + 1], twice + 1, twice)] = -1
    return place, off


def _left_out(clock: CameraClock, place: Index, moment: float) -> str:
    """Text about the frames that a camera took before and after the sets, which are `moment`
    apart.
    """
    used = place[place >= 0]
    ends = (
        [(int(used[0]), "start"), (int(len(clock.time) - 1 - used[-1]), "end")]
        if len(used) > 0
        else []
    )
    # A faster camera always has frames between the sets.
    return " and ".join(
        f"{n} at the {end}" for n, end in ends if n > 0 and n * clock.period >= 0.99 * moment
    )
