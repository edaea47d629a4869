"""Who comes back after a longer time out of sight: tracks are joined whose ends fit in place, time and build."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from annotated_types import Interval

from shapepose_fg.core.arrays import Array, Index
from shapepose_fg.core.bounds import Settings
from shapepose_fg.core.rows import Rows
from shapepose_fg.core.skeleton import Skeleton

_BONE_SIGMA_M = 0.015
"""Error of a bone's mean length in a track: errors of detectors last, so that it does not vanish with time."""
_PLACE_SIGMA_M = 0.05
"""Error of the centre of somebody's core joints, metres, at the least."""
LEAST_ROWS = 10
"""Rows that a track needs for its build to be known."""
_BUILD = 2.0
"""Mean squared difference of bone lengths, in their standard deviations, up to which two builds are one. For
one person it is 1 in the mean; lengths of adults differ by 2 to 3 cm, which gives 3 to 5."""

_WALK_MPS = 1.5
"""How much farther somebody may be for each second: people walk at 1.4 m/s."""


@dataclass(frozen=True)
class StitchingConfig(Settings):
    """When two tracks are one person."""

    longest_gap_s: Annotated[float, Interval(ge=0, le=86400)] = 10.0
    """Nobody is recognised after a longer time. 0: tracks are never joined."""
    reach_m: Annotated[float, Interval(ge=0, le=10)] = 0.5
    """How far from where a track ended the next may begin, at once; 1.5 m farther for each second that passed."""


@dataclass(frozen=True)
class Trace(Rows):
    """What stitching looks at, of the N solved rows of one track."""

    track: int
    """The identity."""
    time_s: Array
    """(N,) when each row is; rising."""
    centre: Array
    """(N, 3) centre of the core joints, metres."""
    bones: Array
    """(N, B) length of each bone between core joints, metres; NaN where unknown."""

    @classmethod
    def of(cls, track: int, time_s: Array, joints: Array, skeleton: Skeleton) -> "Trace":
        """Make the trace of solved rows with `joints` (N, J, 3)."""
        core = list(skeleton.core)
        bone = np.array([(j, p) for j, p in enumerate(skeleton.parents) if j in core and p in core])
        known = np.asarray(np.isfinite(joints[:, core]).all(axis=-1))[..., None]
        centre = np.where(known, joints[:, core], 0.0).sum(axis=1) / np.maximum(known.sum(axis=1), 1)
        length = np.linalg.norm(joints[:, bone[:, 0]] - joints[:, bone[:, 1]], axis=-1)
        return cls(track, time_s, centre, length)

    @property
    def build(self) -> Array:
        """(B,) median length of each bone, metres; NaN where it is known in too few rows."""
        enough = np.isfinite(self.bones).sum(axis=0) >= LEAST_ROWS
        return np.where(enough, np.nanmedian(np.where(enough, self.bones, 0.0), axis=0), np.nan)


@dataclass(frozen=True)
class Ends:
    """Where and when G tracks begin and end, and how their people are built."""

    track: Index
    """(G,) identities."""
    time_s: Array
    """(G, 2) times of the first and the last row, seconds."""
    place: Array
    """(G, 2, 3) centre of the core joints there, metres."""
    bones: Array
    """(G, B) median length of each bone between core joints, metres; NaN where it is not known."""

    @classmethod
    def of(cls, traces: Iterable[Trace]) -> "Ends":
        """Summarise tracks, one of which at a time is in memory."""
        rows = [(each.track, each.time_s[[0, -1]], each.centre[[0, -1]], each.build) for each in traces]
        if len(rows) == 0:
            return cls(np.zeros(0, np.intp), np.zeros((0, 2)), np.zeros((0, 2, 3)), np.zeros((0, 0)))
        return cls(*map(np.array, zip(*rows, strict=True)))


def stitch(ends: Ends, config: StitchingConfig, cuts_s: Sequence[float] = ()) -> dict[int, int]:
    """What each track is called after tracks are joined: of two that are one the earlier one's number stays.

    Each track has one before it and one after it at the most. Which, is decided for all together: as many as can
    be are joined, in the likeliest way by place and build. Nothing is joined across `cuts_s`.
    Time and memory grow with the pairs of tracks of which one begins within `longest_gap_s` of the other's end.
    """
    joined = _matched(*_pairs(ends, config, cuts_s))
    names = {}
    for place in np.argsort(ends.time_s[:, 0], kind="stable").tolist():
        earlier = joined.get(place)
        names[place] = ends.track[place] if earlier is None else names[earlier]
    return {int(ends.track[place]): int(name) for place, name in names.items()}


def _pairs(ends: Ends, config: StitchingConfig, cuts_s: Sequence[float]) -> tuple[Index, Index, Array]:
    """Tracks (K,) of whom others (K,) may be what comes after, and what that costs: see `_costs`."""
    begin_s, end_s = ends.time_s.T
    order = np.argsort(begin_s, kind="stable")
    first = np.searchsorted(begin_s[order], end_s, side="right")
    latest_s = np.nextafter(end_s + config.longest_gap_s, np.inf)  # no rounding leaves one out
    last = np.searchsorted(begin_s[order], latest_s, side="right")
    count = np.maximum(last - first, 0)
    before = np.repeat(np.arange(len(end_s)), count)
    after = order[np.arange(len(before)) + np.repeat(first - np.cumsum(count) + count, count)]
    gap_s = begin_s[after] - end_s[before]
    apart_m = np.linalg.norm(ends.place[after, 0] - ends.place[before, 1], axis=-1)
    reach_m = config.reach_m + _WALK_MPS * gap_s
    may = (gap_s <= config.longest_gap_s) & (apart_m <= reach_m)
    for cut in cuts_s:
        may &= ~((end_s[before] < cut) & (begin_s[after] >= cut))
    before, after, apart_m, reach_m = before[may], after[may], apart_m[may], reach_m[may]
    unlike = _unlike(ends.bones[before], ends.bones[after])
    alike = unlike <= _BUILD  # not where it is not known
    cost = _costs(apart_m, reach_m, ends.bones.shape[1] * unlike)[alike]
    return before[alike], after[alike], cost


def _unlike(bones: Array, others: Array) -> Array:
    """(K,) mean squared difference of builds (K, B) and others (K, B), in its variances.

    NaN where fewer than half of the bones are known.
    """
    difference = bones - others
    known = np.isfinite(difference)
    squared = np.where(known, difference, 0.0) ** 2 / (2 * _BONE_SIGMA_M**2)
    count = known.sum(axis=-1)
    enough = (count > 0) & (count >= bones.shape[1] / 2)
    return np.where(enough, squared.sum(axis=-1) / np.maximum(count, 1), np.nan)


def _costs(apart_m: Array, reach_m: Array, unlike: Array) -> Array:
    """(K,) how unlikely it is that two tracks are one, -2 log of a density but for a constant.

    Places `apart_m` (K,) are Gaussian on the floor, two standard deviations being what is in reach (K,); bones of
    one person differ by `unlike` (K,) squared standard deviations, all bones together.
    """
    sigma_m = np.maximum(reach_m / 2, _PLACE_SIGMA_M)
    return (apart_m / sigma_m) ** 2 + 4 * np.log(sigma_m / _PLACE_SIGMA_M) + unlike


def _matched(before: Index, after: Index, cost: Array) -> dict[int, int]:
    """For tracks that are joined the one before, of pairs (K,) that may be: as many as can be, the likeliest."""
    rows, row = np.unique(before, return_inverse=True)
    columns, column = np.unique(after, return_inverse=True)
    if len(rows) == len(columns) == len(before):  # nobody has a choice
        return dict(zip(after.tolist(), before.tolist(), strict=True))
    from scipy.sparse import csr_array  # with all of SciPy that it needs: a sixth of a second
    from scipy.sparse.csgraph import min_weight_full_bipartite_matching

    count, nobody = len(rows), len(columns) + np.arange(len(rows))  # each track may have nobody after it
    # A pair more counts more than all that others can gain by it. A cost of 0 would be no pair.
    alone = 2.0 + count * float(cost.max(initial=0.0))
    costs = np.concatenate([1.0 + cost, np.full(count, alone)])
    places = np.concatenate([row, np.arange(count)]), np.concatenate([column, nobody])
    matrix = csr_array((costs, places), shape=(count, len(columns) + count))
    first, second = min_weight_full_bipartite_matching(matrix)
    joined = second < len(columns)
    return dict(zip(columns[second[joined]].tolist(), rows[first[joined]].tolist(), strict=True))
