"""Who was seen by which camera, without any calibration: 2D people of some frames of a recording."""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.detections import Detections, DetectionSequence
from shapepose_fg.core.skeleton import Skeleton
from shapepose_fg.proposal.people_2d import group_people

Array = NDArray[np.float64]
Index = NDArray[np.intp]

MIN_JOINTS = 5
"""A person with fewer core joints in view says too little about the camera."""
_STATURE_PER_SPREAD = 3.4
"""Stature of a standing person over the root of the joints' summed variances: 1 / 0.29 if spread evenly."""


@dataclass(frozen=True)
class Sightings:
    """S people as single cameras saw them, J core joints each."""

    frame: Index
    """(S,) frame of the recording."""
    view: Index
    """(S,) camera in the rig."""
    xy: Array
    """(S, J, 2) joints, undistorted pixels; NaN where not seen."""
    confidence: Array
    """(S, J) the detector's score; 0 where not seen."""

    def __len__(self) -> int:
        return len(self.frame)

    @cached_property
    def size_px(self) -> Array:
        """(S,) how large a person is in the picture, about the height of one who stands, pixels."""
        return size_of(self.xy)

    def only(self, keep: NDArray[np.bool_] | Index) -> "Sightings":
        """Some of the sightings."""
        return Sightings(self.frame[keep], self.view[keep], self.xy[keep], self.confidence[keep])


def size_of(xy: Array) -> Array:
    """(...) size of people whose joints xy (..., J, 2) lie so, pixels; 1 where nothing is seen."""
    seen = ~np.isnan(xy[..., :1])
    count = np.maximum(seen.sum(axis=-2), 1)
    here = np.where(seen, xy, 0.0)
    mean = here.sum(axis=-2) / count
    variance = (np.where(seen, (here - mean[..., None, :]) ** 2, 0.0).sum(axis=-2) / count).sum(axis=-1)
    return np.asarray(np.maximum(_STATURE_PER_SPREAD * np.sqrt(variance), 1.0))


def sightings_of(detections: DetectionSequence, frames: Iterable[int]) -> Sightings:
    """The 2D people of some `frames`; joints of the skeleton's `core` only.

    Candidates are grouped into people by the affinities of their own picture alone.
    """
    parts = [_of_frame(detections[frame], frame, detections.skeleton) for frame in frames]
    joints = len(detections.skeleton.core)
    none = Sightings(np.zeros(0, np.intp), np.zeros(0, np.intp), np.zeros((0, joints, 2)), np.zeros((0, joints)))
    parts = [none, *parts]
    return Sightings(
        *(
            np.concatenate([getattr(part, name) for part in parts])
            for name in ("frame", "view", "xy", "confidence")
        )
    )


def _of_frame(found: Detections, frame: int, skeleton: Skeleton) -> Sightings:
    """The 2D people of one frame."""
    place = np.full(len(skeleton), -1)
    place[list(skeleton.core)] = np.arange(len(skeleton.core))
    groups = [rows[place[found.joint[rows]] >= 0] for rows in group_people(found) if len(rows) >= MIN_JOINTS]
    groups = [rows for rows in groups if len(rows) >= MIN_JOINTS]
    xy = np.full((len(groups), len(skeleton.core), 2), np.nan)
    confidence = np.zeros(xy.shape[:2])
    for person, rows in enumerate(groups):
        xy[person, place[found.joint[rows]]] = found.xy[rows]
        confidence[person, place[found.joint[rows]]] = found.confidence[rows]
    view = np.array([found.view[rows[0]] for rows in groups], dtype=np.intp)
    return Sightings(np.full(len(groups), frame, dtype=np.intp), view, xy, confidence)
