"""Re-identification after longer gaps: tracks are joined if their ends fit in place, time and
build.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from annotated_types import Interval

from shapepose_fg.core.arrays import Array, Index
from shapepose_fg.core.bounds import Settings
from shapepose_fg.core.rows import Rows
from shapepose_fg.core.skeleton import Skeleton
from shapepose_fg.estimation.in_time import WALK_M_S
from shapepose_fg.tracking.tracker import TrackingConfig

_BONE_SIGMA_M = 0.015
"""Standard deviation of a bone's mean length in a track, m; detector errors are correlated over
time."""
LEAST_ROWS = 10
"""Minimum number of rows with a bone for its length in a track to be known."""
_BUILD = 2.0
"""Maximum mean squared difference of bone lengths, in variances, of one person. Its expectation is
1 for one person; bone lengths of adults differ by 2 to 3 cm, which gives 3 to 5."""

_BRIEF_S = 1.0
"""Longest gap over which tracks are joined without knowing their build, s."""
_PACE_S = 0.2
"""Duration over which the velocity at the end of a track is measured, s."""


@dataclass(frozen=True)
class StitchingConfig(Settings):
    """When two tracks are joined."""

    longest_gap_s: Annotated[float, Interval(ge=0, le=86400)] = 10.0
    """Longest gap over which a person is re-identified, s. 0: tracks are never joined."""
    reach_m: Annotated[float, Interval(ge=0, le=10)] = 0.5
    """Maximum distance between the end of a track and the start of the next, m; plus 1.5 m per
    second of gap."""


@dataclass(frozen=True)
class Trace(Rows):
    """Data for stitching from the N solved rows of one track."""

    track: int
    """The identity."""
    time_s: Array
    """(N,) time of each row, s; ascending."""
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
        centre = np.where(known, joints[:, core], 0.0).sum(axis=1) / np.maximum(
            known.sum(axis=1), 1
        )
        length = np.linalg.norm(joints[:, bone[:, 0]] - joints[:, bone[:, 1]], axis=-1)
        return cls(track, time_s, centre, length)

    @property
    def build(self) -> Array:
        """(B,) median length of each bone, metres; NaN where it is known in too few rows."""
        enough = np.isfinite(self.bones).sum(axis=0) >= LEAST_ROWS
        return np.where(enough, np.nanmedian(np.where(enough, self.bones, 0.0), axis=0), np.nan)

    @property
    def velocity(self) -> Array:
        """(3,) mean velocity of the centre over the last `_PACE_S`, m/s; 0 with a single row."""
        first = int(np.searchsorted(self.time_s[:-1], self.time_s[-1] - _PACE_S - 1e-6))
        step_s = max(self.time_s[-1] - self.time_s[first], 1e-6)
        return (self.centre[-1] - self.centre[first]) / step_s


@dataclass(frozen=True)
class Ends:
    """Start and end of G tracks in time and place, and their bone lengths."""

    track: Index
    """(G,) identities."""
    time_s: Array
    """(G, 2) times of the first and the last row, seconds."""
    place: Array
    """(G, 2, 3) centre of the core joints at the track's start and end, metres."""
    bones: Array
    """(G, B) median length of each bone between core joints, metres; NaN where unknown."""
    velocity: Array
    """(G, 3) velocity of the centre at the track's end, m/s."""

    @classmethod
    def of(cls, traces: Iterable[Trace]) -> "Ends":
        """Summarise tracks one at a time, to save memory."""
        rows = [
            (each.track, each.time_s[[0, -1]], each.centre[[0, -1]], each.build, each.velocity)
            for each in traces
        ]
        if len(rows) == 0:
            return cls(
                np.zeros(0, np.intp),
                np.zeros((0, 2)),
                np.zeros((0, 2, 3)),
                np.zeros((0, 0)),
                np.zeros((0, 3)),
            )
        return cls(*map(np.array, zip(*rows, strict=True)))


def stitch(ends: Ends, config: StitchingConfig, cuts_s: Sequence[float] = ()) -> dict[int, int]:
    """New identity of each track after joining: that of the earliest track of each chain.

    Each track has at most one predecessor and one successor. The assignment is global: as many
    tracks as possible are joined, and among such assignments the one is taken that is most likely
    by place and build. Nothing is joined across the times `cuts_s`. Time and memory grow with the
    number of pairs in which one track begins within `longest_gap_s` of another's end.
    """
    joined = _matched(*_pairs(ends, config, cuts_s))
    names = {}
    for place in np.argsort(ends.time_s[:, 0], kind="stable").tolist():
        earlier = joined.get(place)
        names[place] = ends.track[place] if earlier is None else names[earlier]
    return {int(ends.track[place]): int(name) for place, name in names.items()}


def _pairs(
    ends: Ends, config: StitchingConfig, cuts_s: Sequence[float]
) -> tuple[Index, Index, Array]:
    """Possible pairs: tracks (K,), possible successors (K,), and the cost of each pair
    (`_costs`).
    """
    begin_s, end_s = ends.time_s.T
    order = np.argsort(begin_s, kind="stable")
    first = np.searchsorted(begin_s[order], end_s, side="right")
    latest_s = np.nextafter(end_s + config.longest_gap_s, np.inf)  # rounding must not exclude one
    last = np.searchsorted(begin_s[order], latest_s, side="right")
    count = np.maximum(last - first, 0)
    before = np.repeat(np.arange(len(end_s)), count)
    after = order[np.arange(len(before)) + np.repeat(first - np.cumsum(count) + count, count)]
    gap_s = begin_s[after] - end_s[before]
    # As long as a track is followed without evidence.
    moved = ends.velocity[before] * np.minimum(gap_s, TrackingConfig.patience_s)[:, None]
    apart_m = np.linalg.norm(ends.place[after, 0] - ends.place[before, 1] - moved, axis=-1)
    reach_m = config.reach_m + WALK_M_S * gap_s
    may = (gap_s <= config.longest_gap_s) & (apart_m <= reach_m)
    for cut in cuts_s:
        may &= ~((end_s[before] < cut) & (begin_s[after] >= cut))
    before, after, apart_m, reach_m = before[may], after[may], apart_m[may], reach_m[may]
    unlike = _unlike(ends.bones[before], ends.bones[after])
    unlike = np.where(np.isnan(unlike) & (gap_s[may] <= _BRIEF_S), 1.0, unlike)  # the expectation
    same_build = unlike <= _BUILD  # false where unknown
    unlike = ends.bones.shape[1] * unlike[same_build]
    return (
        before[same_build],
        after[same_build],
        _costs(apart_m[same_build], reach_m[same_build], unlike),
    )


def _unlike(bones: Array, others: Array) -> Array:
    """(K,) mean squared difference of bone lengths (K, B) and others (K, B), in variances.

    NaN where fewer than half of the bones are known.
    """
    difference = bones - others
    known = np.isfinite(difference)
    squared = np.where(known, difference, 0.0) ** 2 / (2 * _BONE_SIGMA_M**2)
    count = known.sum(axis=-1)
    enough = (count > 0) & (count >= bones.shape[1] / 2)
    return np.where(enough, squared.sum(axis=-1) / np.maximum(count, 1), np.nan)


def _costs(apart_m: Array, reach_m: Array, unlike: Array) -> Array:
    """(K,) cost of joining two tracks: -2 log-density up to a constant; at least 0.

    Distances `apart_m` (K,) are Gaussian on the floor, with `reach_m` (K,) as two standard
    deviations; `unlike` (K,) is the sum of squared differences of bone lengths, in variances.
    """
    cost = (2 * apart_m / reach_m) ** 2 + 4 * np.log(reach_m) + unlike
    return cost - cost.min(initial=np.inf)


def _matched(before: Index, after: Index, cost: Array) -> dict[int, int]:
    """Predecessor of each joined track, from possible pairs (K,): the largest matching, then the
    least cost.
    """
    rows, row = np.unique(before, return_inverse=True)
    columns, column = np.unique(after, return_inverse=True)
    if len(rows) == len(columns) == len(before):  # no conflicts
        return dict(zip(after.tolist(), before.tolist(), strict=True))
    from scipy.sparse import csr_array  # imported here because it takes a sixth of a second
    from scipy.sparse.csgraph import min_weight_full_bipartite_matching

    count, nobody = len(rows), len(columns) + np.arange(len(rows))  # or no successor
    # One more pair outweighs all savings of others. A cost of 0 would mean no edge.
    unjoined = 2.0 + count * float(cost.max(initial=0.0))
    costs = np.concatenate([1.0 + cost, np.full(count, unjoined)])
    places = np.concatenate([row, np.arange(count)]), np.concatenate([column, nobody])
    matrix = csr_array((costs, places), shape=(count, len(columns) + count))
    first, second = min_weight_full_bipartite_matching(matrix)
    joined = second < len(columns)
    return dict(zip(columns[second[joined]].tolist(), rows[first[joined]].tolist(), strict=True))
