"""Tracks people in the pictures of one camera, without knowledge of the other cameras."""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import correlate1d, gaussian_filter1d

from shapepose_fg.cameras.sightings import MIN_JOINTS, Sightings, follow, median_of, rays_of
from shapepose_fg.core.arrays import Array, Index, Mask
from shapepose_fg.core.camera import Views
from shapepose_fg.core.detections import DetectionSequence
from shapepose_fg.core.skeleton import Skeleton

_SAME = 0.08
"""Maximum median motion of a person's joints between frames of a track, as a share of the person's
size."""
_SHORTEST_S = 0.4
"""Minimum duration of a track, s."""
_SMOOTH_S = 0.05
"""Standard deviation of the smoothing kernel of tracks, s."""
FAST_S = 1.0
"""Time scale above which changes are removed from residuals, s, and duration within which errors
count as one: errors of detectors and cameras are correlated."""
FASTEST = 2.0
"""Maximum speed of a joint, statures per second; faster ones are identity switches."""
_SAME_TIME = 1e-3
"""Difference of times that is ignored, frames."""
_LEAST_AROUND, _LEAST_SPREAD = 0.6, 0.25
"""Minimum share of known values around a frame, and minimum share of their temporal spread."""


@dataclass(frozen=True)
class CameraTracks:
    """K tracks of people in one camera: M rows, those of a track together, one per frame."""

    first: Index
    """(K,) first row of each track."""
    frame: Index
    """(M,) frame of each row."""
    track: Index
    """(M,) track of each row."""
    rays: Array
    """(M, J, 3) directions in the world, smoothed; NaN where a joint is not seen."""
    speed: Array
    """(M, J, 3) change of the rays' directions per frame."""
    size: Array
    """(M,) size of the person, rad."""

    @property
    def lasts(self) -> Index:
        """(K,) the last frame of each track."""
        return self.frame[np.append(self.first[1:], len(self.frame))[: len(self.first)] - 1]

    def at(self, track: Index, time: Array) -> tuple[Array, Array, Array]:
        """Directions (N, J, 3), their speeds and sizes (N,) of tracks (N,) at `time` (N,), frames;
        NaN outside.
        """
        stop = np.append(self.first[1:], len(self.frame))
        before = np.floor(time).astype(np.intp)
        row = self.first[track] + before - self.frame[self.first[track]]
        inside = (row >= self.first[track]) & (row + 1 < stop[track])
        row = np.where(inside, row, 0)
        part = np.where(inside, time - before, np.nan)
        near, far = (1 - part)[:, None, None], part[:, None, None]
        rays = near * self.rays[row] + far * self.rays[row + 1]
        speed = near * self.speed[row] + far * self.speed[row + 1]
        return rays, speed, np.where(inside, self.size[row], np.nan)

    @classmethod
    def of(cls, sightings: Sightings, views: Views, view: int, fps: float) -> "CameraTracks":
        """The tracks of camera `view`, smoothed."""
        seen = sightings.rows(sightings.view == view)
        rays, size = rays_of(seen, views), seen.size_px / views.focal_px[view]
        shortest = max(4, round(_SHORTEST_S * fps))
        parts = [rows for rows in _followed(seen) if len(rows) >= shortest]
        frames = [
            np.arange(int(seen.frame[rows[0]]), int(seen.frame[rows[-1]]) + 1) for rows in parts
        ]
        joints = seen.xy.shape[1]
        every = [_smoothed(rays[rows], seen.frame[rows], _SMOOTH_S * fps) for rows in parts]
        sizes = [
            np.interp(f, seen.frame[rows], size[rows])
            for f, rows in zip(frames, parts, strict=True)
        ]
        lengths = [len(each) for each in frames]
        none = np.zeros((0, joints, 3))
        return cls(
            np.cumsum([0, *lengths])[:-1].astype(np.intp),
            np.concatenate([np.zeros(0, np.intp), *frames]),
            np.repeat(np.arange(len(parts)), lengths),
            np.concatenate([none, *(each for each, _ in every)]),
            np.concatenate([none, *(change for _, change in every)]),
            np.concatenate([np.zeros(0), *sizes]),
        )


@dataclass(frozen=True)
class OneClock:
    """Sightings of cameras with different start times, on one clock."""

    skeleton: Skeleton
    """The detector's joints."""
    sightings: Sightings
    """Sightings; `frame` counts on the common clock, from 0."""
    frames: range
    """Frames of the common clock in which two or more cameras record."""

    def at(self, frames: Iterable[int]) -> Sightings:
        """The sightings in some frames."""
        return self.sightings.rows(np.isin(self.sightings.frame, np.fromiter(frames, np.intp)))


def on_one_clock(
    sightings: Sightings, following: Index, shift: Array, skeleton: Skeleton
) -> OneClock:
    """The sightings on the common clock: frame t of it is frame t + shift[v] of camera v,
    interpolated linearly.

    `following` (S,) is the sighting of the same person in the next frame (`next_of`).
    """
    seen = _resampled(sightings, following, sightings.frame - shift[sightings.view])
    view, frame = seen.view, seen.frame - seen.frame.min(initial=np.iinfo(np.intp).max)
    ends = [(int(frame[view == v].min()), int(frame[view == v].max())) for v in np.unique(view)]
    begin, end = sorted(first for first, _ in ends)[1:2], sorted(last for _, last in ends)[-2:-1]
    span = range(begin[0], end[0] + 1) if begin else range(0)
    return OneClock(skeleton, replace(seen, frame=frame), span)


def at_regular_times(sightings: Sightings, time_s: Array | None, fps: float) -> Sightings:
    """The sightings of each camera at the times n / `fps` of its own clock, interpolated linearly;
    `frame` is then n. `time_s` (T, V) are the own times of the frames, s, from about 0 on; None:
    they are regular already.
    """
    if time_s is None:
        return sightings
    begin = time_s[sightings.frame, sightings.view] * fps
    return _resampled(sightings, next_of(sightings), begin)


def _resampled(sightings: Sightings, following: Index, begin: Array) -> Sightings:
    """The sightings at times `begin` (S,) at whole times, interpolated linearly between a sighting
    and the `following` one (S,); `frame` is then the whole time.
    """
    end = np.where(following < 0, begin + 2 * _SAME_TIME, begin[following])
    first, last = (np.ceil(each - _SAME_TIME).astype(np.intp) for each in (begin, end))
    rows = np.repeat(np.arange(len(first)), np.maximum(last - first, 0))
    number = first[rows] + np.arange(len(rows)) - np.searchsorted(rows, rows)
    part = ((number - begin[rows]) / (end - begin)[rows]).clip(0.0, 1.0)
    part = np.where(following[rows] < 0, 0.0, part)
    near, other = (
        sightings.rows(each) for each in (rows, np.where(part == 0, rows, following[rows]))
    )
    xy = (1 - part)[:, None, None] * near.xy + part[:, None, None] * other.xy
    confidence = np.minimum(near.confidence, other.confidence)
    return Sightings(number, near.view, xy, np.where(np.isfinite(xy[..., 0]), confidence, 0.0))


def next_of(sightings: Sightings) -> Index:
    """(S,) the sighting of the same person in the camera's next frame; -1 for none."""
    following = np.full(len(sightings), -1, dtype=np.intp)
    for view in np.unique(sightings.view):
        rows = np.flatnonzero(sightings.view == view)
        for track in _followed(sightings.rows(rows)):
            one, other = rows[track[:-1]], rows[track[1:]]
            near = sightings.frame[other] - sightings.frame[one] == 1
            following[one[near]] = other[near]
    return following


def seen_at(detections: "DetectionSequence | OneClock", frames: Iterable[int]) -> Sightings:
    """The 2D people of some frames, on the common clock for `OneClock`."""
    return (
        detections.at(frames)
        if isinstance(detections, OneClock)
        else Sightings.of(detections, frames)
    )


def _followed(seen: Sightings) -> list[Index]:
    """Rows of each track, ordered by frame; single missing frames are bridged."""

    def distance_of(one: Index, other: Index) -> Array:
        apart_px = np.linalg.norm(seen.xy[one][:, None] - seen.xy[other], axis=-1)
        return median_of(apart_px / seen.size_px[other][:, None], MIN_JOINTS)

    identity = follow(seen.frame, distance_of, _SAME, 2)
    order = np.lexsort((seen.frame, identity))
    return np.split(order, np.flatnonzero(np.diff(identity[order])) + 1)


def _smoothed(rays: Array, frame: Index, width: float) -> tuple[Array, Array]:
    """Smooth directions (N, J, 3) at ascending frames (N,) by `lines`, for every frame from the
    first to the last.
    """
    full = np.full((frame[-1] - frame[0] + 1, *rays.shape[1:]), np.nan)
    full[frame - frame[0]] = rays
    return lines(full, width)


def lines(values: Array, width: float) -> tuple[Array, Array]:
    """Local linear regression of values (T, J, 3), and their change per step, in a Gaussian window
    of `width` steps.

    Plain means would be biased in time beside gaps. NaN if too little is known around.
    """
    known = np.isfinite(values[..., :1])
    lag = np.arange(-np.ceil(3 * width), np.ceil(3 * width) + 1)
    near = np.exp(-0.5 * (lag / width) ** 2) / (width * np.sqrt(2 * np.pi))

    def around(each: Array, power: int) -> Array:
        return np.asarray(correlate1d(each, near * lag**power, axis=0, mode="constant"))

    known_share, full = known.astype(np.float64), np.where(known, values, 0.0)
    w0, w1, w2, y0, y1 = (
        around(known_share, 0),
        around(known_share, 1),
        around(known_share, 2),
        around(full, 0),
        around(full, 1),
    )
    spread = w0 * w2 - w1**2
    spread = np.where((w0 > _LEAST_AROUND) & (spread > _LEAST_SPREAD * width**2), spread, np.nan)
    return (w2 * y0 - w1 * y1) / spread, (w0 * y1 - w1 * y0) / spread


def block_frames(fps: float, lasts: float) -> float:
    """Number of frames that count as one correlated error; fewer in short recordings of `lasts`
    frames.
    """
    return max(1.0, min(FAST_S * fps, lasts / 12))


def fast_part(values: Array, known: Mask, track: Index, width: float) -> Array:
    """Values (N, ...) minus local means of the `known` ones over the rows of a track (N,), with a
    Gaussian window of `width` rows; 0 where unknown. This removes correlated errors.
    """
    result = np.zeros_like(values)
    for rows in np.split(np.arange(len(track)), np.flatnonzero(np.diff(track)) + 1):
        is_known, filled = known[rows], np.where(known[rows], values[rows], 0.0)
        weight, total = (
            gaussian_filter1d(each, width, axis=0, mode="constant")
            for each in (is_known.astype(np.float64), filled)
        )
        result[rows] = np.where(is_known, filled - total / np.maximum(weight, 1e-9), 0.0)
    return result
