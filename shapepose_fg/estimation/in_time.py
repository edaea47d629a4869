"""Joints over the frames of a window: how fast, how long unseen, gaps closed, values smoothed."""

import numpy as np

from shapepose_fg.core.arrays import Array, Mask

SPEED_S = 0.1
"""Speeds are taken over this time before and after a step, so that noise does not pass for speed."""


def speeds(points: Array, times_s: Array) -> Array:
    """(T - 1, J) how fast points (T, J, 3) are in each step, m/s, over `SPEED_S` on either side."""
    first = np.searchsorted(times_s, times_s[:-1] - SPEED_S, side="left")
    last = np.searchsorted(times_s, times_s[1:] + SPEED_S, side="right") - 1
    return np.linalg.norm(points[last] - points[first], axis=2) / (times_s[last] - times_s[first])[:, None]


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
