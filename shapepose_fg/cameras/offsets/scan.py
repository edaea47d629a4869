"""Compares cameras at all time offsets, without association of people.

Two rays to a joint at the same time are coplanar with both cameras. For each person of one camera,
the best fitting person of the other is used, so that no association is needed.
"""

import numpy as np

from shapepose_fg.cameras.sightings import GATE, MIN_JOINTS, Sightings, centres_of, rays_of
from shapepose_fg.core.arrays import Array, Index
from shapepose_fg.core.camera import Views
from shapepose_fg.core.compiled import kernel

LEAST_MISS = 0.004
"""Minimum error of a detector as a share of a person's size: 7 mm."""


def scan(
    sightings: Sightings,
    views: Views,
    a: int,
    b: int,
    lags: Index,
    common: float,
    gate: float = GATE,
) -> Array:
    """(L,) mean residual of possible matches of two cameras, as a share of people's size, for the
    offsets `lags` (L,), frames; NaN with fewer than `common` frames in common.
    """
    one, other = (sightings.rows(sightings.view == view) for view in (a, b))
    if min(len(one), len(other)) == 0:
        return np.full(len(lags), np.nan)
    taken = np.unique(one.frame)
    # Number of frames of one camera that are compared with those of another, at every offset.
    wanted = taken[np.unique(np.linspace(0, len(taken) - 1, 150).astype(np.intp))]
    one = one.rows(np.isin(one.frame, wanted))
    other = other.rows(np.argsort(other.frame, kind="stable"))
    begin, last = int(other.frame[0]), int(other.frame[-1])
    first = np.searchsorted(other.frame, np.arange(begin, last + 2))
    normal = np.ascontiguousarray(normals(rays_of(one, views), views, a, b))
    rays, size = np.ascontiguousarray(rays_of(other, views)), other.size_px / views.focal_px[b]
    cost, count = np.zeros(len(lags)), np.zeros(len(lags))
    _scan(normal, rays, one.frame, size, first, begin, lags, gate, MIN_JOINTS, cost, count)
    frame = one.frame
    both = np.minimum(frame.max() + lags, last) - np.maximum(frame.min() + lags, begin)
    share = 0.2 * np.minimum(common / max(np.ptp(frame), 1), 1)
    enough = (both >= common) & (count >= share * len(frame)) & (count > 0)
    return np.where(enough, cost / np.maximum(count, 1), np.nan)


@kernel("f3 f3 i1 f1 i1 i0 i1 f0 i0 f1 f1")
def _scan(
    normal: Array,
    rays: Array,
    frame: Index,
    size: Array,
    first: Index,
    begin: int,
    lags: Index,
    gate: float,
    least: int,
    cost: Array,
    count: Array,
) -> None:
    """Add to `cost` (L,) the residual of the best fitting person of the other camera, and to
    `count` (L,) the number.
    """
    for n in range(len(lags)):
        for a in range(len(frame)):
            at = frame[a] + lags[n] - begin
            if at < 0 or at + 1 >= len(first) or first[at] == first[at + 1]:
                continue
            best = gate
            for s in range(first[at], first[at + 1]):
                total, seen = 0.0, 0
                for j in range(normal.shape[1]):
                    miss = normal[a, j, 0] * rays[s, j, 0] + normal[a, j, 1] * rays[s, j, 1]
                    miss = abs(miss + normal[a, j, 2] * rays[s, j, 2]) / size[s]
                    if miss == miss:  # not NaN
                        total += min(miss, gate)
                        seen += 1
                if seen >= least and total / seen < best:
                    best = total / seen
            cost[n] += best
            count[n] += 1


def normals(rays: Array, views: Views, a: int, b: int) -> Array:
    """(..., 3) unit normals of the planes through rays of camera `a` and the centre of camera
    `b`.
    """
    centres = centres_of(views)
    normal = np.cross(centres[b] - centres[a], rays)
    return np.asarray(normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12))
