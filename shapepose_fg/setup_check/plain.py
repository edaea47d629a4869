"""What is told without comparing places: cameras that are listed twice, the people's build, sizes of pictures."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.camera import Axis, Camera, Rig
from shapepose_fg.core.skeleton import Skeleton
from shapepose_fg.io.footage.footage import glance, open_footage
from shapepose_fg.io.footage.places import VIDEOS, find_footage
from shapepose_fg.setup_check.evidence import Evidence
from shapepose_fg.setup_check.findings import Duplicate, Finding, Kind
from shapepose_fg.setup_check.fit import difference
from shapepose_fg.setup_check.matching import same_frame

Array = NDArray[np.float64]

_SAME_PX = 0.6
"""Detections of one picture, stored with a pixel's accuracy, lie no farther apart."""
_SAME_SHARE = 0.8
_SAME_PLACE, _SAME_ANGLE_DEG = 0.002, 0.05
"""Poses that differ by less, of the cameras' mean distance and in degrees, are one: no stand is so exact."""
_BONES = (
    ("Hip", "Knee", 0.245),
    ("Knee", "Ankle", 0.246),
    ("Shoulder", "Elbow", 0.186),
    ("Elbow", "Wrist", 0.146),
)
"""Lengths of bones as parts of the stature of adults (Drillis and Contini 1966, as in Winter's "Biomechanics and
Motor Control of Human Movement")."""
_AXES: tuple[Axis, ...] = ("x", "-x", "y", "-y", "z", "-z")


def duplicates(rig: Rig, evidence: Evidence) -> list[Finding]:
    """Pairs of cameras with one pose, or with the same detections."""
    spread = np.linalg.norm(rig.centres - rig.centres.mean(axis=0), axis=1).mean()
    findings = []
    for first, second in combinations(range(len(rig)), 2):
        angle_deg, away = difference(rig.cTw[first], rig.cTw[second])
        pose = away <= _SAME_PLACE * spread and angle_deg < _SAME_ANGLE_DEG and len(rig) > 2
        seen = _same_detections(evidence, rig, first, second)
        if pose or seen:
            findings.append(Finding(Kind.DUPLICATE, (first, second), duplicate=Duplicate(bool(pose), seen)))
    return findings


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


def _distorted(xy: Array, camera: Camera) -> Array:
    seen = ~np.isnan(xy[..., 0])
    raw = np.full_like(xy, np.nan)
    raw[seen] = camera.distort(xy[seen])
    return raw


def other_sizes(given: Sequence[str], rig: Rig) -> tuple[Finding, ...]:
    """Cameras whose videos, or pictures, are not of the calibrated size; `given` as `find_footage` takes it."""
    found = []
    for view, path in enumerate(find_footage(given, rig.names)[0]):
        is_video = path.suffix.lower() in VIDEOS and path.is_file()
        width, height = glance(path)[0] if is_video else open_footage(path).size
        if (width, height) != rig.cameras[view].image_size:
            found.append(Finding(Kind.PICTURE_SIZE, (view,), shift_px=((float(width), float(height)),)))
    return tuple(found)


@dataclass(frozen=True)
class Build:
    """What people look like, in the calibration's frame and unit."""

    stature: float
    """Median stature that their bones say, the calibration's unit; NaN where too few are seen."""
    up: Array
    """(3,) mean direction from their hips to their necks; its length is 1 where all stand alike, else less."""
    count: int
    """People and frames that it is made of."""

    @property
    def axis(self) -> Axis:
        """The world axis nearest to the people's up."""
        return _AXES[int(np.argmax(np.ravel(np.column_stack([self.up, -self.up]))))]


def build_of(points: Array, skeleton: Skeleton) -> Build:
    """The build of people (P, J, 3), J the core joints of `skeleton`."""
    place = {skeleton.joints[joint]: index for index, joint in enumerate(skeleton.core)}
    nowhere = np.full((len(points), 3), np.nan)

    def joint(name: str) -> Array:
        return points[:, place[name]] if name in place else nowhere

    guess = np.stack(
        [np.linalg.norm(joint(s + a) - joint(s + b), axis=-1) / share for a, b, share in _BONES for s in "RL"],
        axis=1,
    )
    enough = (~np.isnan(guess)).sum(axis=1) >= 3
    statures = [np.nanmedian(row) for row in guess[enough]]
    trunk = (joint("RShoulder") + joint("LShoulder") - joint("RHip") - joint("LHip")) / 2
    trunk = trunk[~np.isnan(trunk).any(axis=1)]
    trunk = trunk / np.maximum(np.linalg.norm(trunk, axis=1, keepdims=True), 1e-12)
    up = trunk.mean(axis=0) if len(trunk) > 0 else np.zeros(3)
    return Build(float(np.median(statures)) if len(statures) > 0 else np.nan, up, int(enough.sum()))
