"""Whether a camera's pictures are late: at which offset in frames its detections fit the others' people best."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.setup_check.evidence import Look
from shapepose_fg.setup_check.fit import Others, Pinhole
from shapepose_fg.setup_check.matching import GATE, least_of_each, residuals, same_frame
from shapepose_fg.setup_check.sightings import MIN_JOINTS, Sightings

Array = NDArray[np.float64]

_MIN_AGREEMENT = 0.12
_MIN_LAG_GAIN = 0.004
"""An offset in time is named if it takes away enough of what people move in it, and 7 mm on average."""
_HALF = 0.2
"""A half of the recording in which people move this share of all that they move has a say."""
_STRIDE = 4
"""Offsets are tried at every fourth frame first."""
_MOST_PEOPLE = 100
"""People that are enough to tell an offset by."""
_LEAST_FRAMES = 40
"""In fewer frames people hardly move far enough to tell a small offset in time from chance: in 20 frames of the
built-in scene a camera that is in time looked 4 frames early."""


@dataclass(frozen=True)
class Lag:
    """An offset of a camera in time."""

    frames: int
    """What the others show at frame t, the camera shows at t + frames: positive is late."""
    gain: float
    """By how much the joints' errors fall, as a part of the people's size: mean over all joints."""
    agreement: float
    """The same, over how far the joints move within the offset: near 1 if it is the offset, near -1 if there is
    none, 0 without motion. Of the half of the frames in which it is less: an offset is in both halves, while
    in one of them people may come by chance to where they were."""

    @property
    def is_offset(self) -> bool:
        """Whether it is more than chance."""
        return self.agreement > _MIN_AGREEMENT and self.gain > _MIN_LAG_GAIN


NONE = Lag(0, 0.0, 0.0)


def lags(look: Look) -> list[Lag]:
    """Each camera's offset in time against the others; none is told in a short recording that fits as it is."""
    if len(np.unique(look.evidence.sightings.frame)) < _LEAST_FRAMES:
        return [NONE] * look.view_count
    return [lag_of(look, view) for view in range(look.view_count)]


def lag_of(look: Look, view: int, most: int | None = None) -> Lag:
    """A camera's offset in time against the others, up to `most` frames: where its sightings fit people best."""
    most = look.evidence.most_lag if most is None else min(most, look.evidence.most_lag)
    others, seen, camera = look.others(view), look.seen_by(view, every_frame=True), look.setup.camera(view)
    step = max(1, len(others) // _MOST_PEOPLE)
    others = Others(others.frame[::step], others.points[::step])
    still = _nearest(others, seen, camera, 0)

    def tried(lag: int) -> Lag:
        return _compare(lag, others.frame, seen, still, _nearest(others, seen, camera, lag))

    first = [tried(lag) for lag in range(-(most // _STRIDE) * _STRIDE, most + 1, _STRIDE)]
    best = max(first, key=_worth)
    near = [tried(best.frames + d) for d in range(1 - _STRIDE, _STRIDE) if d != 0 and abs(best.frames + d) <= most]
    best = max([best, *near], key=_worth)
    return best if best.gain > 0 else NONE


def _worth(lag: Lag) -> float:
    """What an offset takes away, where it is one in both halves of the frames."""
    return lag.gain if lag.agreement >= 0 else -np.inf


@dataclass(frozen=True)
class _Nearest:
    """Each person's nearest sighting at some offset."""

    there: NDArray[np.bool_]
    """(P,) whether the camera has that frame at all."""
    sighting: NDArray[np.intp]
    """(P,) -1 where none is within the gate."""
    error: Array
    """(P, J) distance of each joint, a part of the size, no more than GATE; NaN where the joint is not seen."""


def _nearest(others: Others, seen: Sightings, camera: Pinhole, lag: int) -> _Nearest:
    person, sighting = same_frame(others.frame, seen.frame - lag)
    residual = residuals(others.points[person], seen.xy[sighting], camera.K, camera.cTw)
    error = np.linalg.norm(residual, axis=-1) / seen.size_px[sighting][:, None]
    both = ~np.isnan(error)
    mean = np.where(both, np.minimum(error, GATE), 0).sum(axis=1) / np.maximum(both.sum(axis=1), 1)
    mean = np.where(both.sum(axis=1) >= MIN_JOINTS, mean, GATE)
    best = least_of_each(person, mean)
    near = best[mean[best] < 0.9 * GATE]
    found = np.full(len(others), -1, dtype=np.intp)
    found[person[near]] = sighting[near]
    errors = np.full(others.points.shape[:2], np.nan)
    errors[person[near]] = np.minimum(error[near], GATE)
    return _Nearest(np.isin(others.frame + lag, seen.frame), found, errors)


def _compare(lag: int, frame: NDArray[np.integer], seen: Sightings, still: _Nearest, moved: _Nearest) -> Lag:
    """How much better people fit at an offset than without: joints of people that both have, or one has."""
    usable = still.there & moved.there & ((still.sighting >= 0) | (moved.sighting >= 0))
    a, b = still.sighting[usable], moved.sighting[usable]
    error_a, error_b = still.error[usable], moved.error[usable]
    # Who is out of the gate at one of the offsets has moved by that much.
    error_a = np.where((a < 0)[:, None] & ~np.isnan(error_b), GATE, error_a)
    error_b = np.where((b < 0)[:, None] & ~np.isnan(error_a), GATE, error_b)
    xy = np.concatenate([seen.xy, np.full((1, *seen.xy.shape[1:]), np.inf)])  # the last for nobody
    size = np.append(seen.size_px, np.inf)
    with np.errstate(invalid="ignore"):
        way = np.linalg.norm(xy[a] - xy[b], axis=-1) / np.minimum(size[a], size[b])[:, None]
    way = np.where(np.isnan(way), GATE, np.minimum(way, GATE))
    both = ~np.isnan(error_a) & ~np.isnan(error_b)
    if both.sum() < 10 * MIN_JOINTS:
        return Lag(lag, 0.0, 0.0)
    better, way = np.where(both, error_a - error_b, 0.0), np.where(both, way, 0.0)
    late = frame[usable] > np.median(frame[usable])
    halves = [(float(better[half].sum()), float(way[half].sum())) for half in (late, ~late)]
    whole = max(sum(moves for _, moves in halves), 1e-9)
    agreement = min(gain / moves for gain, moves in halves if moves >= _HALF * whole) if whole > 1e-9 else 0.0
    return Lag(lag, float(better[both].mean()), agreement)
