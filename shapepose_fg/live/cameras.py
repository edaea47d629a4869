"""Detects faulty cameras online: those that repeat pictures, fall silent, or contradict the
others.
"""

from dataclasses import dataclass, replace
from enum import IntEnum

import numpy as np

from shapepose_fg.core.arrays import Array, Mask, Whole
from shapepose_fg.core.camera import Rig
from shapepose_fg.core.detections import Detections
from shapepose_fg.core.repeated_pictures import repeated_views

_OVER_S = 1.0
"""Time over which a camera's distances are averaged, s: a crowd hides people for less."""
SILENT_S = 0.5
"""Time without detections after which a camera is silent, and is not waited for, s."""
_NEAREST = 0.25
"""Quantile of the distances between people's joints and detections that measures a camera: other
people may be hidden from it, and it may see further ones."""
_OFF_M, _TIMES = 0.06, 2.5
"""A camera contradicts the others above this distance, m, three times a detector's error, and above
this multiple of the median camera's distance."""
_BACK_M = 0.04
"""Distance below which a camera is used again, m."""
_CAP_M = 0.5
"""Upper limit of a distance in the average, m."""
_LEAST = 12
"""Minimum number of joints in a picture, and of detections, from which distances are computed: half
a person."""


class CameraState(IntEnum):
    """Status of a camera."""

    OK = 0
    """The camera works."""
    FROZEN = 1
    """The camera repeats its picture; its detections are ignored."""
    SILENT = 2
    """The camera gives no detections for half a second, because it fails or sees nobody."""
    CONTRADICTS = 3
    """The camera contradicts the others; its detections are ignored until it agrees again."""
    DOUBTED = 4
    """Too many cameras contradict each other to tell which are right; all are used."""
    OFF_CLOCK = 5
    """The camera's clock differs by seconds from those of the others; its views are ignored until
    it agrees."""


@dataclass(frozen=True)
class CameraWatch:
    """Statuses and statistics of V cameras."""

    apart_m: Array
    """(V,) distance of people's joints from the nearest detection, averaged over a second, m; NaN
    where unknown."""
    heard_s: Array
    """(V,) times of the last detections of each camera, s."""
    state: Whole
    """(V,) codes of `CameraState`."""

    @classmethod
    def of(cls, views: int) -> "CameraWatch":
        """Initial state, before any detection."""
        return cls(np.full(views, np.nan), np.full(views, -np.inf), np.zeros(views, dtype=np.int64))

    def seen(
        self, given: Detections, before: Detections | None, rig: Rig, time_s: float
    ) -> tuple["CameraWatch", Rig]:
        """Update with a frame's detections; returns the new state, and the rig without excluded
        cameras.

        A view without any detection is treated as one without a picture: people are not expected in
        it.
        """
        views = len(rig)
        has_detections = np.bincount(given.view, minlength=views) > 0
        frozen = (
            repeated_views(before, given, views)
            if before is not None
            else np.zeros(views, dtype=bool)
        )
        heard_s = np.where(
            has_detections, time_s, np.where(np.isinf(self.heard_s), time_s, self.heard_s)
        )
        silent = time_s - heard_s > SILENT_S
        state = self._judged()
        state = np.where(silent, CameraState.SILENT, state)
        state = np.where(frozen, CameraState.FROZEN, state)
        now = CameraWatch(self.apart_m, heard_s, state.astype(np.int64))
        return now, now.believed(given, rig)

    def believed(self, given: Detections, rig: Rig) -> Rig:
        """The rig for a frame with these detections, without excluded cameras."""
        has_detections = np.bincount(given.view, minlength=len(rig)) > 0
        out = ~has_detections | np.isin(self.state, (CameraState.FROZEN, CameraState.CONTRADICTS))
        doubted = np.flatnonzero(self.state == CameraState.DOUBTED).tolist()
        return replace(rig, excluded=tuple(np.flatnonzero(out).tolist()), doubted=tuple(doubted))

    def compared(self, given: Detections, places: Array, rig: Rig, lasts_s: float) -> "CameraWatch":
        """Update with the distances of the detections from people at `places` (A, J, 3), metres,
        NaN where unknown.
        """
        if len(places) == 0 or len(given) == 0:
            return self
        uv, depth = rig.project(places)
        sizes = np.array([camera.image_size for camera in rig.cameras])[:, None, None]
        inside = (depth > 0) & (uv >= 0).all(axis=-1) & (uv < sizes).all(axis=-1)
        px_m = np.where(depth > 0, depth, np.nan) / rig.focal_px[:, None, None]
        distance = np.linalg.norm(uv[given.view, :, given.joint] - given.xy[:, None], axis=-1)
        distance = np.nan_to_num(distance * px_m[given.view, :, given.joint], nan=_CAP_M)
        nearest = np.full((len(rig), places.shape[1], len(places)), _CAP_M)
        np.fmin.at(nearest, (given.view, given.joint), distance)
        metres, of_detections = nearest.swapaxes(1, 2), np.minimum(distance.min(axis=1), _CAP_M)
        apart_m, fresh = self.apart_m.copy(), min(lasts_s / _OVER_S, 1.0)
        counts = np.bincount(given.view, minlength=len(rig))
        for view in np.flatnonzero(
            (inside.sum(axis=(1, 2)) >= _LEAST) & (counts >= _LEAST)
        ).tolist():
            if self.state[view] != CameraState.FROZEN:
                both = metres[view][inside[view]], of_detections[given.view == view]
                now, last = min(float(np.quantile(each, _NEAREST)) for each in both), apart_m[view]
                apart_m[view] = now if np.isnan(last) else last + fresh * (now - last)
        return replace(self, apart_m=apart_m)

    def _judged(self) -> Whole:
        """(V,) codes of `CameraState`: cameras that contradict the others; all are doubted unless
        at least two agree, and more agree than contradict.
        """
        known = np.isfinite(self.apart_m)
        was = self.state == CameraState.CONTRADICTS
        if not known.any():
            return np.zeros(len(known), dtype=np.int64)
        most = (
            max(_OFF_M, _TIMES * float(np.median(self.apart_m[known & ~was])))
            if (known & ~was).any()
            else _OFF_M
        )
        off: Mask = known & (np.nan_to_num(self.apart_m) > np.where(was, _BACK_M, most))
        agree = known & ~off
        if off.any() and (agree.sum() < 2 or off.sum() >= agree.sum()):
            return np.where(known, CameraState.DOUBTED, CameraState.OK)
        return np.where(off, CameraState.CONTRADICTS, CameraState.OK)
