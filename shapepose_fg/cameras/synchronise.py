"""Time offsets of any size between cameras with known poses, with subframe accuracy, from people.

First all offsets between two cameras are scanned (`offset_scan`); then tracks are associated, and
offsets refined to parts of a frame (`subframe_offsets`).
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np

from shapepose_fg.cameras.offsets.scan import LEAST_MISS, scan
from shapepose_fg.cameras.offsets.subframe import InSpace, Pairwise
from shapepose_fg.cameras.sightings import Sightings
from shapepose_fg.cameras.tracks import CameraTracks, at_regular_times
from shapepose_fg.core.arrays import Array, Index
from shapepose_fg.core.camera import Rig, Views
from shapepose_fg.core.detections import DetectionSequence
from shapepose_fg.core.errors import InputError

_STEP_S = 0.1
"""Step of the first scan of offsets, s: people's joints move by 10 cm."""
_LEAST_S = 3.0
"""Minimum common duration of two cameras, s; a third of the recording if that is less."""
_AROUND_S = 0.6
"""Distance below which two offsets are the same, s."""
_LEAST_SEEN = 50
"""Minimum number of people, one per frame, that a camera must see in tracks."""
_SURE = 1.5
"""Minimum prominence of the best offset over all others, in their standard deviations: wrong ones
were below 0.5, correct ones on Shelf above 1.9."""
_WORST_S = 0.05
"""Maximum standard deviation of a determined offset, s."""
_WIDER = 1.5
"""Factor on standard deviations: 95 % regions cover 82 % without it, and 92 % with it, Shelf
included."""
WHOLE_S, _END_S, _DRIFT_S = 180.0, 60.0, 2.0
"""Duration used of a longer recording, s; duration at its end for estimating drift, s; and the
maximum drift searched for there, s."""


@dataclass(frozen=True)
class Synchronised:
    """Time offsets of cameras: frame f of camera v, at t = f / fps on its own clock, was exposed at
    `of_views(t)`.
    """

    offset_s: Array
    """(V,) offset at `middle_s`, seconds; 0 for the first camera."""
    sigma_s: Array
    """(V,) standard deviation of the offset, seconds; 0 for the first camera."""
    prominence: Array
    """(V,) prominence of the offset over all others, in their standard deviations."""
    drift: Array
    """(V,) drift, seconds per second that the camera falls behind; 0 in recordings of under four
    minutes."""
    middle_s: float
    """Time for which the offset is stated, on the camera's own clock, s."""

    def of_views(self, time_s: Array) -> Array:
        """(..., V) times on the common clock for times (..., V) on the cameras' own clocks."""
        return np.asarray(time_s + self.offset_s + self.drift * (time_s - self.middle_s))

    def as_dict(self, rig: Rig) -> dict[str, Any]:
        """All figures as plain values; null for an unknown standard deviation."""
        figures = zip(
            rig.names, self.offset_s, self.sigma_s, self.prominence, self.drift, strict=True
        )
        cameras = [
            {
                "camera": name,
                "offset_s": round(float(offset), 5),
                "sigma_s": round(float(sigma), 5) if np.isfinite(sigma) else None,
                "stands_out": round(float(prominence), 2),
                "drift_ppm": round(1e6 * float(drift), 2),
            }
            for name, offset, sigma, prominence, drift in figures
        ]
        return {"cameras": cameras, "undetermined": self.undetermined(rig)}

    def undetermined(self, rig: Rig) -> list[str]:
        """Cameras whose offset the people's motion does not determine, in words."""
        cure = "film people who walk about and wave, in view of all cameras"
        return [
            f"camera {name}: the motion of the people does not determine its offset, because "
            f"other offsets fit about as well; {cure}"
            for name, prominence, sigma in zip(
                rig.names, self.prominence, self.sigma_s, strict=True
            )
            if prominence < _SURE or not sigma < _WORST_S
        ]


def synchronise(
    detections: DetectionSequence,
    rig: Rig,
    fps: float,
    frames: range,
    most_s: float = 60.0,
    progress: Callable[[int, int], None] = lambda done, total: None,
    time_s: Array | None = None,
) -> Synchronised:
    """Estimate offsets, up to `most_s` between any two cameras with known poses, from people in
    `frames`.

    `time_s` (T, V) are the times of the frames on each camera's own clock, s, from 0 on; by default
    frame / `fps`. In recordings of over four minutes drift is also estimated. Raises InputError if
    a camera sees too few people.
    """
    whole, end = round(WHOLE_S * fps), round(_END_S * fps)
    first = frames if len(frames) <= whole + end else frames[:whole]
    seen = at_regular_times(Sightings.of(detections, first), time_s, fps)
    offset, sigma, prominence = offsets(seen, rig, fps, first, most_s, np.zeros(len(rig)), progress)
    middle, none = (first.start + first.stop) / 2 / fps, np.zeros(len(rig))
    if len(first) == len(frames):
        return Synchronised(offset, sigma, prominence, none, middle)
    seen = at_regular_times(Sightings.of(detections, frames[-end:]), time_s, fps)
    later, *_ = offsets(seen, rig, fps, frames[-end:], _DRIFT_S, offset, progress)
    lasts = (frames.stop - end / 2) / fps - middle
    return Synchronised(offset, sigma, prominence, (later - offset) / lasts, middle)


def offsets(
    sightings: Sightings,
    rig: Rig,
    fps: float,
    frames: range,
    most_s: float,
    around_s: Array,
    progress: Callable[[int, int], None],
) -> tuple[Array, Array, Array]:
    """Offsets (V,) within `most_s` of `around_s`, their standard deviations and prominence, from
    sightings in `frames`.
    """
    views, tracks = Views.of(rig), list[CameraTracks]()
    start = -np.rint(around_s * fps).astype(np.intp)
    # Frames are counted on the clock of the first camera: with `shift` zero all clocks agree.
    sightings = replace(sightings, frame=sightings.frame - start[sightings.view])
    for view, name in enumerate(rig.names):
        tracks.append(CameraTracks.of(sightings, views, view, fps))
        if len(tracks[view].frame) < _LEAST_SEEN:
            raise InputError(
                f"camera {name}: too few people are seen, or in single frames only, to estimate "
                "the times of its frames; film people for a minute who walk about"
            )
    pairs = list(combinations(range(len(rig)), 2))
    step = max(1, round(_STEP_S * fps))
    common = min(_LEAST_S * fps, len(frames) / 3)
    most = min(round(most_s * fps), int(len(frames) - common)) // step * step
    lags = np.arange(-most, most + 1, step)
    curves = {}
    for number, (a, b) in enumerate(pairs):
        curves[a, b] = scan(sightings, views, a, b, lags, common)
        progress(number + 1, len(pairs))
    coarse, prominence = chosen(curves, lags, len(rig), round(_AROUND_S * fps))
    fine = Pairwise(tracks, views, coarse.astype(float), fps)
    shift, covariance = InSpace.of(fine).settled() if len(rig) > 2 else fine.solved()
    offset = -(shift + start)
    offset = offset - offset[0]
    return offset / fps, _WIDER * np.sqrt(np.diag(covariance)) / fps, prominence


def chosen(
    curves: dict[tuple[int, int], Array], lags: Index, views: int, around: int
) -> tuple[Array, Array]:
    """(V,) shifts in frames relative to the first camera, and their prominence (V,).

    Frame f of the first camera is frame f + shift of another. Cameras are added one by one in order
    of prominence, each at the offset that fits all those before it.
    """
    step = int(lags[1] - lags[0]) if len(lags) > 1 else 1
    half = len(lags) // 2

    def fit(one: int, other: int, lag: Index) -> Array:
        """Fit of two cameras at offsets `lag`: standard deviations below the median over all
        offsets.
        """
        curve = curves[one, other] if one < other else curves[other, one][::-1]
        known = np.isfinite(curve)
        if known.sum() < 3:
            return np.zeros(len(lag))
        middle = np.median(curve[known])
        spread = max(1.5 * float(np.median(np.abs(curve[known] - middle))), LEAST_MISS)
        place = np.clip(lag + half, 0, len(lags) - 1)
        inside = (np.abs(lag) <= half) & known[place]
        return np.where(inside, (middle - curve[place]) / spread, 0.0)

    def best(view: int, placed: dict[int, int]) -> tuple[float, int]:
        low, high = min(placed.values()) - half, max(placed.values()) + half
        tried = np.arange(low, high + 1)
        score = np.sum(
            [fit(one, view, tried - at) for one, at in placed.items()], axis=0
        ) / np.sqrt(len(placed))
        top = int(np.argmax(score))
        far = np.abs(tried - tried[top]) * step > around
        return float(score[top] - score[far].max(initial=0.0)), int(tried[top])

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
    prominence = np.array(
        [best(view, {o: at for o, at in placed.items() if o != view})[0] for view in range(views)]
    )
    shift = np.array([placed[view] for view in range(views)]) * step
    return shift - shift[0], prominence
