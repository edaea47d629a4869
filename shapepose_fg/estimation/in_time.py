"""Temporal operations on a window's joints: velocities, times since seen, gap filling,
smoothing.
"""

import numpy as np

from shapepose_fg.core.arrays import Array, Index, Mask

SPEED_S = 0.05
"""Time before and after a frame for estimating a velocity, s; at least one frame."""
_AROUND_S = 0.3
"""Time before and after a step over which motion is a median, s; errors for a quarter of it have no
effect."""
_HOP_S = 0.045
"""Minimum duration of a displacement for a speed, s; over less, noise dominates."""
KNOWN_M = 0.1
"""Maximum standard deviation of a point whose place counts as known, m. A track does not lose such
a joint in the next frame, however long the interval: at 10 frames a second the unknown velocity of
a new person's joints alone adds 20 cm."""
WALK_M_S = 1.5
"""Speed of a walker, m/s: people walk at 1.4 m/s."""


def motion_of(points: Array, variance: Array, times_s: Array) -> tuple[Array, Array]:
    """(T - 1, J) speed, m/s, and (T - 1, J) power spectral density of the acceleration along an
    axis, m²/s³, of points (T, J, 3), metres, around each step.

    The speed is the path length per second, so that a limb swinging back and forth is fast. The
    density is computed from second differences, minus the contribution of noise with `variance` (T,
    J) along an axis, m². Both are temporal medians, robust to a few wrong points, over points known
    to `KNOWN_M`; 0 without any.
    """
    at, joint = np.arange(len(times_s))[:, None], np.arange(points.shape[1])
    known = np.asarray(np.isfinite(points).all(axis=2) & (variance < KNOWN_M**2))
    velocity, hops, noise = [], [], [variance]
    for end in _hop_ends(known, times_s):
        hop = np.where(known & (end != at), times_s[end] - times_s[:, None], np.nan)
        hops.append(np.where((np.abs(hop) < _AROUND_S) | (np.abs(end - at) == 1), hop, np.nan))
        velocity.append((points[end, joint] - points) / hops[-1][..., None])
        noise.append(variance[end, joint] / hops[-1] ** 2)
    noise[0] = variance * (1 / hops[1] - 1 / hops[0]) ** 2
    turned = np.square(velocity[1] - velocity[0]).sum(axis=2) - 3 * np.sum(noise, axis=0)
    first = np.searchsorted(times_s, times_s[:-1] - _AROUND_S - 1e-6)
    until = np.searchsorted(times_s, times_s[1:] + _AROUND_S + 1e-6)
    speed = np.linalg.norm(velocity, axis=3)
    return _median(speed, first, until), _median(turned[None] / (hops[1] - hops[0]), first, until)


def _hop_ends(known: Mask, times_s: Array) -> tuple[Index, Index]:
    """(T, J) for each frame, the nearest earlier and later frames, at least `_HOP_S` away, in which
    a joint is `known` (T, J); the frame itself if none.
    """
    T, at = len(times_s), np.arange(len(times_s))[:, None]
    before = np.searchsorted(times_s, times_s - _HOP_S, side="right") - 1
    after = np.searchsorted(times_s, times_s + _HOP_S)
    earlier = np.maximum.accumulate(np.where(known, at, -1))[np.minimum(before, at[:, 0] - 1)]
    later = np.minimum.accumulate(np.where(known, at, T)[::-1])[::-1][
        np.clip(after, at[:, 0] + 1, T) % T
    ]
    return np.where((earlier >= 0) & (earlier < at), earlier, at), np.where(
        (at < later) & (later < T), later, at
    )


def _median(values: Array, first: Index, until: Index) -> Array:
    """(S, J) medians of `values` (K, T, J), over all K and frames from `first` (S,) to before
    `until` (S,), at least 0; NaN is ignored, and the result is 0 without any value.
    """
    near = first[:, None] + np.arange(int((until - first).max(initial=1)))
    each = np.where(
        (near < until[:, None])[..., None], values[:, np.minimum(near, values.shape[1] - 1)], np.nan
    )
    each = np.sort(np.concatenate(list(each), axis=1), axis=1)
    middle = np.isfinite(each).sum(axis=1, keepdims=True) // 2
    return np.nan_to_num(np.maximum(np.take_along_axis(each, middle, axis=1)[:, 0], 0.0))


def velocities(points: Array, times_s: Array) -> Array:
    """(T, J, 3) velocities of points (T, J, 3), m/s, over `SPEED_S` before and after; NaN for a
    single frame.
    """
    first, last, lasts = moments(times_s)
    return (points[last] - points[first]) / lasts[:, None, None]


def moments(times_s: Array) -> tuple[Index, Index, Array]:
    """(T,) first and last frame from which a frame's velocity is computed, and the time between
    them, seconds; NaN for a single frame.
    """
    at, end = np.arange(len(times_s)), len(times_s) - 1
    first = np.searchsorted(times_s, times_s - SPEED_S - 1e-9, side="left")
    last = np.searchsorted(times_s, times_s + SPEED_S + 1e-9, side="right") - 1
    first, last = np.clip(first, 0, at - 1).clip(0), np.clip(last, at + 1, None).clip(None, end)
    return first, last, np.where(last > first, times_s[last] - times_s[first], np.nan)


def near_in_time(marked: Mask, times_s: Array, within_s: float) -> Mask:
    """(T, J) frames within `within_s` of one that is `marked` (T, J)."""
    first = np.searchsorted(times_s, times_s - within_s, side="left")
    last = np.searchsorted(times_s, times_s + within_s, side="right")
    count = np.concatenate([np.zeros((1, marked.shape[1]), dtype=int), np.cumsum(marked, axis=0)])
    return count[last] > count[first]


def waited_s(seen: Mask, times_s: Array) -> Array:
    """(T, J) time to the nearest frame in which a joint is `seen` (T, J), seconds; infinite if
    never.
    """
    at = np.broadcast_to(times_s[:, None], seen.shape)
    return np.where(seen.any(axis=0), np.abs(at - carried(at, seen, times_s)), np.inf)


def carried(values: Array, seen: Mask, times_s: Array) -> Array:
    """Values (T, J, ...), with those of joints not `seen` (T, J) copied from the nearest frame in
    which they are.
    """
    result = values.copy()
    for joint in np.flatnonzero(seen.any(axis=0) & ~seen.all(axis=0)).tolist():
        frames = np.flatnonzero(seen[:, joint])
        nearest = frames[np.abs(times_s[:, None] - times_s[frames]).argmin(axis=1)]
        result[:, joint] = values[nearest, joint]
    return result
