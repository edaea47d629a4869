"""What the people themselves say of a set-up: how tall they come out, and which way they stand."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.camera import Axis
from shapepose_fg.core.skeleton import Skeleton

Array = NDArray[np.float64]

_BONES = (
    ("Hip", "Knee", 0.245),
    ("Knee", "Ankle", 0.246),
    ("Shoulder", "Elbow", 0.186),
    ("Elbow", "Wrist", 0.146),
)
"""Lengths of bones as parts of the stature of adults (Drillis and Contini 1966, as in Winter's "Biomechanics and
Motor Control of Human Movement")."""
AXES: tuple[Axis, ...] = ("x", "-x", "y", "-y", "z", "-z")


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
        return AXES[int(np.argmax(np.ravel(np.column_stack([self.up, -self.up]))))]


def build_of(points: Array, skeleton: Skeleton) -> Build:
    """The build of people (P, J, 3), J the core joints of `skeleton`."""
    names = [skeleton.joints[joint] for joint in skeleton.core]
    place = {name: index for index, name in enumerate(names)}
    guesses = [
        np.linalg.norm(points[:, place[side + a]] - points[:, place[side + b]], axis=-1) / share
        for a, b, share in _BONES
        for side in "RL"
        if side + a in place and side + b in place
    ]
    guess = np.stack(guesses, axis=1) if guesses else np.full((len(points), 1), np.nan)
    enough = (~np.isnan(guess)).sum(axis=1) >= 3
    statures = np.array([np.nanmedian(row) for row in guess[enough]])
    top, bottom = (_middle(points, place, pair) for pair in (("RShoulder", "LShoulder"), ("RHip", "LHip")))
    trunk = top - bottom
    trunk = trunk[~np.isnan(trunk).any(axis=1)]
    trunk = trunk / np.maximum(np.linalg.norm(trunk, axis=1, keepdims=True), 1e-12)
    up = trunk.mean(axis=0) if len(trunk) > 0 else np.zeros(3)
    return Build(float(np.median(statures)) if len(statures) > 0 else np.nan, up, int(enough.sum()))


def _middle(points: Array, place: dict[str, int], names: tuple[str, str]) -> Array:
    """(P, 3) the middle of two joints; NaN where the skeleton or a person lacks one."""
    if not all(name in place for name in names):
        return np.full((len(points), 3), np.nan)
    return (points[:, place[names[0]]] + points[:, place[names[1]]]) / 2
