"""Compares two cameras at all time offsets, without association of people.

Two rays to a joint at the same time are coplanar with both cameras. For each person of one camera,
the best fitting person of the other is used, so that no association is needed.
"""

import numpy as np

from shapepose_fg.calibration.tracks import LEAST_MISS
from shapepose_fg.core.arrays import Array, Index
from shapepose_fg.core.camera import Views
from shapepose_fg.core.compiled import kernel
from shapepose_fg.setup_check.matching import GATE, MIN_JOINTS, Sightings, centres_of, rays_of

_ANCHORS = 150
"""Number of frames of one camera that are compared with those of another, at every offset."""


def scan(sightings: Sightings, views: Views, a: int, b: int, lags: Index, common: float) -> Array:
    """(L,) mean residual of possible matches of two cameras, as a share of people's size, for the
    offsets `lags` (L,), frames; NaN with fewer than `common` frames in common.
    """
    one, other = (sightings.rows(sightings.view == view) for view in (a, b))
    taken = np.unique(one.frame)
    wanted = taken[np.unique(np.linspace(0, len(taken) - 1, _ANCHORS).astype(np.intp))]
    one = one.rows(np.isin(one.frame, wanted))
    other = other.rows(np.argsort(other.frame, kind="stable"))
    begin, last = int(other.frame[0]), int(other.frame[-1])
    first = np.searchsorted(other.frame, np.arange(begin, last + 2))
    normal = np.ascontiguousarray(normals(rays_of(one, views), views, a, b))
    rays, size = np.ascontiguousarray(rays_of(other, views)), other.size_px / views.focal_px[b]
    cost, count = np.zeros(len(lags)), np.zeros(len(lags))
    _scan(normal, rays, one.frame, size, first, begin, lags, GATE, MIN_JOINTS, cost, count)
    frame = one.frame
    both = np.minimum(frame.max() + lags, last) - np.maximum(frame.min() + lags, begin)
    share = 0.2 * np.minimum(common / np.ptp(frame), 1)
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


def chosen(
    curves: dict[tuple[int, int], Array], lags: Index, views: int, around: int
) -> tuple[Array, Array]:
    """(V,) shifts relative to the first camera, and their prominence (V,).

    Cameras are added one by one in order of prominence, each at the offset that fits all those
    before it: frame f of the first camera is frame f + shift of another.
    """
    step = int(lags[1] - lags[0]) if len(lags) > 1 else 1
    half = len(lags) // 2

    def fit(one: int, other: int, apart: Index) -> Array:
        """Fit of two cameras at offsets `apart`: standard deviations below the median over all
        offsets.
        """
        curve = curves[one, other] if one < other else curves[other, one][::-1]
        known = np.isfinite(curve)
        if known.sum() < 3:
            return np.zeros(len(apart))
        middle = np.median(curve[known])
        spread = max(1.5 * float(np.median(np.abs(curve[known] - middle))), LEAST_MISS)
        place = np.clip(apart + half, 0, len(lags) - 1)
        inside = (np.abs(apart) <= half) & known[place]
        return np.where(inside, (middle - curve[place]) / spread, 0.0)

    def best(view: int, placed: dict[int, int]) -> tuple[float, int]:
        low, high = min(placed.values()) - half, max(placed.values()) + half
        tried = np.arange(low, high + 1)
        worth = np.sum(
            [fit(one, view, tried - at) for one, at in placed.items()], axis=0
        ) / np.sqrt(len(placed))
        top = int(np.argmax(worth))
        far = np.abs(tried - tried[top]) * step > around
        return float(worth[top] - worth[far].max(initial=0.0)), int(tried[top])

    margins = {pair: best(pair[1], {pair[0]: 0})[0] for pair in curves}
    root = max(margins, key=lambda pair: margins[pair])[0]
    placed = {root: 0}
    while len(placed) < views:
        offers = {view: best(view, placed) for view in range(views) if view not in placed}
        view = max(offers, key=lambda each: offers[each][0])
        placed[view] = offers[view][1]
    for _ in range(2):
        for view in range(views):
            placed[view] = best(view, {one: at for one, at in placed.items() if one != view})[1]
    sure = np.array(
        [best(view, {o: at for o, at in placed.items() if o != view})[0] for view in range(views)]
    )
    shift = np.array([placed[view] for view in range(views)]) * step
    return shift - shift[0], sure
