"""Joints over the frames of a window: how fast, how long unseen, gaps closed, values smoothed."""

import numpy as np

from shapepose_fg.core.arrays import Array, Index, Mask

SPEED_S = 0.1
"""Time before and after a frame or a step over which motion is averaged, s."""
_HOP_S = 0.045
"""Shortest time over which a displacement counts as motion, s: over less, noise is larger."""
_KNOWN_M = 0.1
"""Points that are less certain along an axis say nothing of motion, m."""


def motion_of(points: Array, variance: Array, times_s: Array) -> tuple[Array, Array]:
    """(T - 1, J) speed, m/s, and (T - 1, J) power spectral density of the acceleration along an axis, m²/s³, of
    points (T, J, 3), metres, around each step.

    The speed is the length of the path per second: a limb that swings to and fro is fast. The density is that of
    second differences, without what noise of `variance` (T, J) along an axis, m², adds to them. Both are medians
    over time, which a few wrong points do not change, from points known to `_KNOWN_M`; 0 where there are too few.
    """
    T, J = variance.shape
    known = np.asarray(np.isfinite(points).all(axis=2) & (variance < _KNOWN_M**2))
    at, joint = np.arange(T)[:, None], np.arange(J)
    # The nearest known points that are at least a hop away; row T is none.
    later = np.minimum.accumulate(np.where(known, at, T)[::-1])[::-1]
    earlier = np.maximum.accumulate(np.where(known, at, -1))
    after = np.append(later, np.full((1, J), T), axis=0)[
        np.maximum(np.searchsorted(times_s, times_s + _HOP_S), at[:, 0] + 1)
    ]
    before = np.append(earlier, np.full((1, J), -1), axis=0)[
        np.minimum(np.searchsorted(times_s, times_s - _HOP_S, side="right") - 1, at[:, 0] - 1)
    ]
    velocity, lasts, noise = [], [], 0.0
    for there in (after, before):
        fine, end = known & (there >= 0) & (there < T), np.clip(there, 0, T - 1)
        h = np.where(fine, times_s[end] - times_s[:, None], np.nan)
        h[np.abs(h) > 2 * SPEED_S + 1e-6] = np.nan
        velocity.append((points[end, joint] - points) / h[..., None])
        lasts.append(np.abs(h))
        noise = noise + variance[end, joint] / h**2
    noise = noise + variance * (1 / lasts[0] + 1 / lasts[1]) ** 2
    turned = np.square(velocity[0] - velocity[1]).sum(axis=2) / 3 - noise
    turning = 3 * turned / (lasts[0] + lasts[1])
    first = np.searchsorted(times_s, times_s[:-1] - SPEED_S - 1e-6)
    until = np.searchsorted(times_s, times_s[1:] + SPEED_S + 1e-6)
    return _median(np.linalg.norm(np.array(velocity), axis=3), first, until), _median(turning[None], first, until)


def _median(values: Array, first: Index, until: Index) -> Array:
    """(S, J) medians of `values` (K, T, J), K alike, each from frames `first` (S,) `until` (S,); NaN does not
    count, and without any value it is 0.
    """
    near = first[:, None] + np.arange(int((until - first).max(initial=0)))
    each = values[:, np.minimum(near, values.shape[1] - 1)]
    each = np.where((near < until[:, None])[..., None], each, np.nan)
    each = np.sort(np.moveaxis(each, 0, 1).reshape(len(first), -1, values.shape[2]), axis=1)
    count = (~np.isnan(each)).sum(axis=1, keepdims=True)
    middle = np.take_along_axis(each, np.minimum(count // 2, np.maximum(count - 1, 0)), axis=1)[:, 0]
    return np.where(count[:, 0] > 0, np.maximum(middle, 0.0), 0.0)


def velocities(points: Array, times_s: Array) -> Array:
    """(T, J, 3) how points (T, J, 3) move, m/s, over `SPEED_S` before and after; NaN in a single frame."""
    first = np.searchsorted(times_s, times_s - SPEED_S, side="left")
    last = np.searchsorted(times_s, times_s + SPEED_S, side="right") - 1
    lasts = np.where(last > first, times_s[last] - times_s[first], np.nan)
    return (points[last] - points[first]) / lasts[:, None, None]


def near_in_time(marked: Mask, times_s: Array, within_s: float) -> Mask:
    """(T, J) which frames are at most `within_s` from one that is `marked` (T, J)."""
    first = np.searchsorted(times_s, times_s - within_s, side="left")
    last = np.searchsorted(times_s, times_s + within_s, side="right")
    count = np.concatenate([np.zeros((1, marked.shape[1]), dtype=int), np.cumsum(marked, axis=0)])
    return count[last] > count[first]


def spanned(marked: Mask) -> Mask:
    """(T, J) which frames lie between the first and the last that are `marked` (T, J), these two included."""
    return np.maximum.accumulate(marked, axis=0) & np.maximum.accumulate(marked[::-1], axis=0)[::-1]


def waited_s(seen: Mask, times_s: Array) -> Array:
    """(T, J) seconds to the nearest frame in which a joint is `seen` (T, J); infinite where there is none."""
    at = np.broadcast_to(times_s[:, None], seen.shape)
    return np.where(seen.any(axis=0), np.abs(at - carried(at, seen, times_s)), np.inf)


def carried(values: Array, seen: Mask, times_s: Array) -> Array:
    """Values (T, J, ...) of joints, where they are not `seen` (T, J) from the nearest frame in which they are."""
    result = values.copy()
    for joint in np.flatnonzero(seen.any(axis=0) & ~seen.all(axis=0)).tolist():
        frames = np.flatnonzero(seen[:, joint])
        nearest = frames[np.abs(times_s[:, None] - times_s[frames]).argmin(axis=1)]
        result[:, joint] = values[nearest, joint]
    return result


def interpolated(points: Array, times_s: Array) -> Array:
    """Points (T, J, 3) with gaps closed in a straight line, and the ends held; joints never known stay NaN."""
    known = np.asarray(np.isfinite(points).all(axis=2))
    result = points.copy()
    for joint in np.flatnonzero(known.any(axis=0) & ~known.all(axis=0)).tolist():
        there = known[:, joint]
        for axis in range(3):
            result[:, joint, axis] = np.interp(times_s, times_s[there], points[there, joint, axis])
    return result


def smoothed_in_time(values: Array, times_s: Array, width_s: float) -> Array:
    """Values (T, ...) averaged over time with a Gaussian of `width_s`, one sigma."""
    weight = np.exp(-0.5 * ((times_s[:, None] - times_s) / width_s) ** 2)
    weight /= weight.sum(axis=1, keepdims=True)
    return np.asarray(np.tensordot(weight, values, axes=1), dtype=np.float64)
