"""Who comes back after a longer time out of sight: tracks are joined whose ends fit in place, time and build."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from annotated_types import Interval
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from shapepose_fg.bounds import Settings
from shapepose_fg.skeleton import Skeleton

Array = NDArray[np.float64]


_BONE_SIGMA_M = 0.015
"""Error of a bone's mean length in a track: errors of detectors last, so that it does not vanish with time."""
_LEAST_ROWS = 10
"""Rows that a track needs for its build to be known."""
_BUILD = 2.0
"""Mean squared difference of bone lengths, in their standard deviations, up to which two builds are one. For
one person it is 1 in the mean; lengths of adults differ by 2 to 3 cm, which gives 3 to 5."""


@dataclass(frozen=True)
class StitchingConfig(Settings):
    """When two tracks are one person."""

    longest_gap_s: Annotated[float, Interval(ge=0, le=86400)] = 10.0
    """Nobody is recognised after a longer time. 0: tracks are never joined."""
    reach_m: Annotated[float, Interval(ge=0, le=10)] = 0.5
    """How far from where a track ended the next may begin, at once."""
    walk_mps: Annotated[float, Interval(ge=0, le=100)] = 1.5
    """And how much farther per second: people walk at 1.4 m/s."""


@dataclass(frozen=True)
class Ends:
    """Where and when G tracks begin and end, and how their people are built."""

    track: NDArray[np.intp]
    """(G,) identities."""
    time_s: Array
    """(G, 2) of the first and the last row."""
    place: Array
    """(G, 2, 3) centre of the core joints there, metres."""
    bones: Array
    """(G, B) mean length of each bone between core joints, metres; NaN where it is not known."""


@dataclass(frozen=True)
class Traces:
    """What stitching looks at, of N solved rows: small enough to be in memory for hours of footage."""

    track: NDArray[np.intp]
    """(N,) identity of each row."""
    time_s: Array
    """(N,) when it is."""
    centre: Array
    """(N, 3) centre of the core joints, metres."""
    bones: Array
    """(N, B) length of each bone between core joints, metres; NaN where unknown."""

    @classmethod
    def of(cls, track: NDArray[np.integer], time_s: Array, joints: Array, skeleton: Skeleton) -> "Traces":
        """Of solved rows with `joints` (N, J, 3)."""
        core = list(skeleton.core)
        bone = np.array([(j, p) for j, p in enumerate(skeleton.parents) if j in core and p in core])
        known = np.asarray(np.isfinite(joints[:, core]).all(axis=-1))[..., None]
        centre = np.where(known, joints[:, core], 0.0).sum(axis=1) / np.maximum(known.sum(axis=1), 1)
        length = np.linalg.norm(joints[:, bone[:, 0]] - joints[:, bone[:, 1]], axis=-1)
        return cls(track.astype(np.intp), time_s, centre, length)

    @classmethod
    def concatenate(cls, parts: Sequence["Traces"]) -> "Traces":
        """The rows of several parts, one after the other."""
        names = ("track", "time_s", "centre", "bones")
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


def stitch(traces: Traces, config: StitchingConfig, cuts_s: Sequence[float] = ()) -> dict[int, int]:
    """What each track is called after tracks are joined: of two that are one the smaller number stays.

    Each track has one before it and one after it at the most; which, is decided for all together. Nothing is
    joined across `cuts_s`.
    """
    ends = _ends(traces)
    if len(ends.track) < 2 or config.longest_gap_s == 0:
        return {track: track for track in ends.track.tolist()}
    gap_s = ends.time_s[None, :, 0] - ends.time_s[:, None, 1]
    apart = np.linalg.norm(ends.place[None, :, 0] - ends.place[:, None, 1], axis=-1)
    may = (gap_s > 0) & (gap_s <= config.longest_gap_s)
    may &= apart <= config.reach_m + config.walk_mps * np.maximum(gap_s, 0.0)
    may &= _alike(ends.bones)
    for cut in cuts_s:
        may &= ~((ends.time_s[:, None, 1] < cut) & (ends.time_s[None, :, 0] >= cut))
    cost = np.where(may, gap_s, 2 * config.longest_gap_s)
    before, after = linear_sum_assignment(cost)
    joined = dict(zip(after[may[before, after]].tolist(), before[may[before, after]].tolist(), strict=True))
    names = {}
    for place in np.argsort(ends.time_s[:, 0], kind="stable").tolist():
        earlier = joined.get(place)
        names[place] = ends.track[place] if earlier is None else names[earlier]
    return {int(ends.track[place]): int(name) for place, name in names.items()}


def _ends(traces: Traces) -> Ends:
    """Ends and builds of all tracks."""
    ids, count = np.unique(traces.track), traces.bones.shape[1]
    times, places, bones = [], [], []
    for each in ids.tolist():
        rows = np.flatnonzero(traces.track == each)
        rows = rows[np.argsort(traces.time_s[rows], kind="stable")]
        times.append(traces.time_s[rows[[0, -1]]])
        places.append(traces.centre[rows[[0, -1]]])
        enough = np.isfinite(traces.bones[rows]).sum(axis=0) >= _LEAST_ROWS
        median = np.full(count, np.nan)
        median[enough] = np.nanmedian(traces.bones[rows][:, enough], axis=0)
        bones.append(median)
    none = len(ids) == 0
    return Ends(
        ids.astype(np.intp),
        np.zeros((0, 2)) if none else np.stack(times),
        np.zeros((0, 2, 3)) if none else np.stack(places),
        np.zeros((0, count)) if none else np.stack(bones),
    )


def _alike(bones: Array) -> NDArray[np.bool_]:
    """(G, G) which builds may be one person's: enough bones known, and alike."""
    difference = bones[:, None] - bones[None]
    known = np.isfinite(difference)
    squared = np.where(known, difference, 0.0) ** 2 / (2 * _BONE_SIGMA_M**2)
    count = known.sum(axis=-1)
    mean = squared.sum(axis=-1) / np.maximum(count, 1)
    return (count >= bones.shape[1] / 2) & (mean <= _BUILD)
