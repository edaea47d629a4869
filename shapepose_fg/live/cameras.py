"""Which cameras are believed while it runs: who repeats pictures, falls silent, or sees people elsewhere."""

from dataclasses import dataclass, replace
from enum import IntEnum

import numpy as np

from shapepose_fg.core.arrays import Array, Mask, Whole
from shapepose_fg.core.camera import Rig
from shapepose_fg.core.detections import Detections
from shapepose_fg.core.repeated_pictures import repeated_views

_OVER_S = 1.0
"""Over about so long a camera's distances are averaged: a crowd hides people for less."""
_SILENT_S = 0.5
"""A camera that gives nothing for longer is silent."""
_NEAREST = 0.25
"""A camera sees people as near to where they are as the nearest quarter of their joints, or of its detections:
others may be hidden from it, and it may see others."""
_OFF_M, _TIMES = 0.06, 2.5
"""It contradicts the others where that is farther, three times a detector's error, and so many times as far as in
the median camera."""
_BACK_M = 0.04
"""It is believed again where it is nearer than this."""
_CAP_M = 0.5
"""A distance counts no more."""
_LEAST = 12
"""Joints in a picture, and detections there, that say anything: about half a person."""


class CameraState(IntEnum):
    """What is the matter with a camera."""

    OK = 0
    """Nothing."""
    FROZEN = 1
    """Its picture repeats: its detections are left out."""
    SILENT = 2
    """It gives no detections where people should be seen."""
    CONTRADICTS = 3
    """It sees people elsewhere than the others do: its detections are left out until it agrees again."""
    DOUBTED = 4
    """Too many cameras see people elsewhere to tell which of them are right: all are used."""
    OFF_CLOCK = 5
    """Its times are seconds away from those of the other cameras: its views are left out until they agree."""


@dataclass(frozen=True)
class CameraWatch:
    """What is known of V cameras so far."""

    apart_m: Array
    """(V,) how far people's joints are from the nearest detection, averaged over a second; NaN unknown."""
    heard_s: Array
    """(V,) when each gave detections last."""
    state: Whole
    """(V,) codes of `CameraState`."""

    @classmethod
    def of(cls, views: int) -> "CameraWatch":
        """Nothing is known yet."""
        return cls(np.full(views, np.nan), np.full(views, -np.inf), np.zeros(views, dtype=np.int64))

    def seen(
        self, given: Detections, before: Detections | None, rig: Rig, time_s: float
    ) -> tuple["CameraWatch", Rig]:
        """With a frame's detections: what is said of each camera, and the rig without those that are left out.

        A view without any detection counts as without a picture: who should be seen there is not missed.
        """
        views = len(rig)
        there = np.bincount(given.view, minlength=views) > 0
        frozen = repeated_views(before, given, views) if before is not None else np.zeros(views, dtype=bool)
        heard_s = np.where(there, time_s, np.where(np.isinf(self.heard_s), time_s, self.heard_s))
        silent = time_s - heard_s > _SILENT_S
        state = self._judged()
        state = np.where(silent, CameraState.SILENT, state)
        state = np.where(frozen, CameraState.FROZEN, state)
        now = CameraWatch(self.apart_m, heard_s, state.astype(np.int64))
        return now, now.believed(given, rig)

    def believed(self, given: Detections, rig: Rig) -> Rig:
        """The rig of a frame with these detections, without the cameras that are left out."""
        there = np.bincount(given.view, minlength=len(rig)) > 0
        out = ~there | np.isin(self.state, (CameraState.FROZEN, CameraState.CONTRADICTS))
        doubted = np.flatnonzero(self.state == CameraState.DOUBTED).tolist()
        return replace(rig, dark=tuple(np.flatnonzero(out).tolist()), doubted=tuple(doubted))

    def compared(self, given: Detections, places: Array, rig: Rig, lasts_s: float) -> "CameraWatch":
        """With how far the detections are from people at `places` (A, J, 3), metres, NaN where unknown."""
        if len(places) == 0 or len(given) == 0:
            return self
        uv, depth = rig.project(places)
        sizes = np.array([camera.image_size for camera in rig.cameras])[:, None, None]
        inside = (depth > 0) & (uv >= 0).all(axis=-1) & (uv < sizes).all(axis=-1)
        px_m = np.where(depth > 0, depth, np.nan) / rig.focal_px[:, None, None]
        away = np.linalg.norm(uv[given.view, :, given.joint] - given.xy[:, None], axis=-1)
        away = np.nan_to_num(away * px_m[given.view, :, given.joint], nan=_CAP_M)
        nearest = np.full((len(rig), places.shape[1], len(places)), _CAP_M)
        np.fmin.at(nearest, (given.view, given.joint), away)
        metres, of_detections = nearest.swapaxes(1, 2), np.minimum(away.min(axis=1), _CAP_M)
        apart_m, fresh = self.apart_m.copy(), min(lasts_s / _OVER_S, 1.0)
        counts = np.bincount(given.view, minlength=len(rig))
        for view in np.flatnonzero((inside.sum(axis=(1, 2)) >= _LEAST) & (counts >= _LEAST)).tolist():
            if self.state[view] != CameraState.FROZEN:
                both = metres[view][inside[view]], of_detections[given.view == view]
                now, last = min(float(np.quantile(each, _NEAREST)) for each in both), apart_m[view]
                apart_m[view] = now if np.isnan(last) else last + fresh * (now - last)
        return replace(self, apart_m=apart_m)

    def _judged(self) -> Whole:
        """(V,) which contradict the others; where these are not more than half, and two, all are doubted."""
        known = np.isfinite(self.apart_m)
        was = self.state == CameraState.CONTRADICTS
        if not known.any():
            return np.zeros(len(known), dtype=np.int64)
        most = (
            max(_OFF_M, _TIMES * float(np.median(self.apart_m[known & ~was]))) if (known & ~was).any() else _OFF_M
        )
        off: Mask = known & (np.nan_to_num(self.apart_m) > np.where(was, _BACK_M, most))
        agree = known & ~off
        if off.any() and (agree.sum() < 2 or off.sum() >= agree.sum()):
            return np.where(known, CameraState.DOUBTED, CameraState.OK)
        return np.where(off, CameraState.CONTRADICTS, CameraState.OK)
