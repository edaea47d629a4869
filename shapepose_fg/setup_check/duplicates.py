"""Cameras that are listed twice: the same pose, the same detections, or both."""

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from shapepose_fg.core.camera import Camera, Rig
from shapepose_fg.setup_check.evidence import Evidence
from shapepose_fg.setup_check.matching import same_frame

_SAME_PX = 0.6
"""Detections of one picture, stored with a pixel's accuracy, lie no farther apart."""
_SAME_SHARE = 0.8
_SAME_PLACE, _SAME_ANGLE_DEG = 0.002, 0.05
"""Poses that differ by less, of the cameras' mean distance and in degrees, are one: no stand is so exact."""


@dataclass(frozen=True)
class Duplicate:
    """Two cameras that are one."""

    first: int
    second: int
    same_pose: bool
    same_detections: bool


def duplicates(rig: Rig, evidence: Evidence) -> list[Duplicate]:
    """Pairs of cameras with one pose, or with the same detections."""
    centres = np.array([camera.centre for camera in rig.cameras])
    spread = np.linalg.norm(centres - centres.mean(axis=0), axis=1).mean()
    found = []
    for first, second in combinations(range(len(rig)), 2):
        a, b = rig.cameras[first], rig.cameras[second]
        near = np.linalg.norm(a.centre - b.centre) <= _SAME_PLACE * spread
        pose = bool(near and _angle_deg(a, b) < _SAME_ANGLE_DEG and len(rig) > 2)
        seen = _same_detections(evidence, rig, first, second)
        if pose or seen:
            found.append(Duplicate(first, second, pose, seen))
    return found


def _angle_deg(a: Camera, b: Camera) -> float:
    cosine = (np.trace(a.wTc[:3, :3].T @ b.wTc[:3, :3]) - 1) / 2
    return float(np.rad2deg(np.arccos(np.clip(cosine, -1.0, 1.0))))


def _same_detections(evidence: Evidence, rig: Rig, first: int, second: int) -> bool:
    """Whether two cameras saw the same pixels; as the pictures were, with the bend of their lenses."""
    every = evidence.sightings
    every = every.only(np.isin(every.frame, evidence.anchors))
    one, other = (every.only(every.view == view) for view in (first, second))
    if min(len(one), len(other)) < 5:
        return False
    i, j = same_frame(one.frame, other.frame)
    raw = [_distorted(seen.xy, rig.cameras[view]) for seen, view in ((one, first), (other, second))]
    distance = np.linalg.norm(raw[0][i] - raw[1][j], axis=-1)
    there = ~np.isnan(distance)
    alike = (there & (distance < _SAME_PX)).sum(axis=1) >= 0.9 * np.maximum(there.sum(axis=1), 1)
    alike &= there.sum(axis=1) >= 3
    return bool(len(np.unique(i[alike])) >= _SAME_SHARE * len(one))


def _distorted(xy: np.ndarray, camera: Camera) -> np.ndarray:
    seen = ~np.isnan(xy[..., 0])
    raw = np.full_like(xy, np.nan)
    raw[seen] = camera.distort(xy[seen])
    return raw
