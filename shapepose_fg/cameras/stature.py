"""Stature and upright direction of people, from their bones."""

from dataclasses import dataclass

import numpy as np

from shapepose_fg.cameras.sightings import MIN_SIGHTINGS
from shapepose_fg.core.arrays import Array
from shapepose_fg.core.camera import Axis
from shapepose_fg.core.skeleton import Skeleton

_BONES = (
    ("Shoulder", "Hip", 0.311, 0.52),
    ("Hip", "Knee", 0.227, 0.15),
    ("Knee", "Ankle", 0.231, 0.15),
    ("Shoulder", "Elbow", 0.155, 0.08),
    ("Elbow", "Wrist", 0.153, 0.10),
)
"""Lengths between joints as shares of stature, for the body model's mean person, and their weights:
the best linear estimator for four people, given the model's shape space and a detector error of 2
cm."""
_AXES: tuple[Axis, ...] = ("x", "-x", "y", "-y", "z", "-z")
SHORTEST_M, TALLEST_M = 0.45, 2.4
"""Range of plausible median statures, metres; outside, the calibration's unit is wrong. Newborns
are 0.5 m tall, the tallest people 2.5 m, and stature from bones is accurate to a tenth."""
_CHILD = 1.2
"""Median stature, metres, below which the people are children, or the calibration's lengths too
short."""
ADULT_M = 1.7
"""Mean stature of adults, metres, in the body model and in the world's population."""


@dataclass(frozen=True)
class Build:
    """Build of the people, in the calibration's frame and unit."""

    stature: float
    """Median stature computed from the bones, in the calibration's unit; NaN if too few
    are seen."""
    up: Array
    """(3,) mean unit vector from hips to neck; its length is 1 if all are parallel, else less."""
    count: int
    """Number of people, one per frame, that were used."""

    @property
    def axis(self) -> Axis:
        """The world axis nearest to the people's up."""
        return _AXES[int(np.argmax(np.ravel(np.column_stack([self.up, -self.up]))))]

    @property
    def are_children(self) -> bool:
        """Whether the median stature is a child's, which also occurs for adults in a rig that is
        scaled too small.
        """
        return self.count >= MIN_SIGHTINGS and SHORTEST_M <= self.stature < _CHILD


def build_of(points: Array, skeleton: Skeleton) -> Build:
    """The build of people (P, J, 3), J the core joints of `skeleton`."""
    place = {skeleton.joints[joint]: index for index, joint in enumerate(skeleton.core)}
    nowhere = np.full((len(points), 3), np.nan)

    def joint(name: str) -> Array:
        return points[:, place[name]] if name in place else nowhere

    sides = [[joint(s + a) - joint(s + b) for s in "RL"] for a, b, *_ in _BONES]
    lengths = np.linalg.norm(sides, axis=-1)  # (bones, 2, P)
    enough = np.isfinite(lengths).sum(axis=(0, 1)) >= 3
    terms = [
        (np.log(np.nanmedian(each) / share), weight)
        for each, (*_, share, weight) in zip(lengths[..., enough], _BONES, strict=True)
        if np.isfinite(each).any()
    ]
    logs, weights = np.array(terms).reshape(-1, 2).T
    stature = float(np.exp(np.average(logs, weights=weights))) if terms else np.nan
    trunk = (joint("RShoulder") + joint("LShoulder") - joint("RHip") - joint("LHip")) / 2
    trunk = trunk[~np.isnan(trunk).any(axis=1)]
    trunk = trunk / np.maximum(np.linalg.norm(trunk, axis=1, keepdims=True), 1e-12)
    up = trunk.mean(axis=0) if len(trunk) > 0 else np.zeros(3)
    return Build(stature, up, int(enough.sum()))
