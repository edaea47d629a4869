"""The motion prior from recorded motions: mean squares of velocities and of their changes, frame to frame."""

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from shapepose_fg.body.fitting.motion_prior import NUM_MOVING, MotionPrior
from shapepose_fg.simulation.mocap import Clip
from shapepose_fg.simulation.shoulder import shoulder_rhythm
from shapepose_fg.simulation.training.motions import MIRROR_JOINTS

Array = NDArray[np.float64]

_WRISTS, _HANDS, _TOES = (20, 21), (22, 23), (10, 11)
STEP_S = 1.0
"""Over which the random walk is measured, seconds: what is not seen moves as far as people do in that time."""
FLOORS = (1.0, 0.1)
"""Root densities of acceleration, rad/s^1.5, and velocity, rad/s^0.5, that no angle goes below: recorded knees and
toes are hinges, and collars were not recorded."""
WRAPS_RAD = 2.6
"""Angle of a joint from which on its axis-angle may jump to the other side of the turn."""


def learn_motion_prior(clips: Iterable[Clip], weights: Iterable[float], provenance: str) -> MotionPrior:
    """Densities from `clips`, a frame of each of which counts for its weight; left and right are taken together.

    With h the time between frames, q h³ is the mean square of second differences and, over `STEP_S`, r h that of
    first ones. Wrists and toes count where they were recorded; hands, which never are, move as wrists do.
    """
    total, count = np.zeros((2, NUM_MOVING)), np.zeros((2, NUM_MOVING))
    for clip, weight in zip(clips, weights, strict=True):
        h, step = 1 / clip.fps, round(STEP_S * clip.fps)
        if len(clip) <= max(step, 2):
            continue
        angles, known = _angles(clip), _recorded(clip) & _unwrapped(clip)
        velocity, within = _change(clip, angles, 1), known[1:] & known[:-1]
        far, both = _change(clip, angles, step), known[step:] & known[:-step]
        parts = ((np.diff(velocity, axis=0), within[1:] & within[:-1], h**3), (far, both, step * h))
        for row, (change, used, scale) in enumerate(parts):
            total[row] += weight * np.where(used, np.square(change), 0.0).sum(axis=0) / scale
            count[row] += weight * used.sum(axis=0)
    mean = _symmetric(total / np.maximum(count, 1e-9))
    mean[:, 3:-3] = np.maximum(mean[:, 3:-3], np.square(FLOORS)[:, None])
    return MotionPrior(*mean, provenance=provenance)


def _angles(clip: Clip) -> Array:
    """(T, 69) axis-angles of the joints below the root."""
    rotations = shoulder_rhythm(clip.rotations)[:, 1:]
    return Rotation.from_matrix(rotations.reshape(-1, 3, 3)).as_rotvec().reshape(len(clip), -1)


def _change(clip: Clip, angles: Array, frames: int) -> Array:
    """(T - frames, 75) by how much everything changes over so many frames."""
    root = Rotation.from_matrix(clip.rotations[:, 0])
    turned = (root[frames:] * root[:-frames].inv()).as_rotvec()
    parts = (turned, angles[frames:] - angles[:-frames], clip.pelvis[frames:] - clip.pelvis[:-frames])
    return np.concatenate(parts, axis=1)


def _unwrapped(clip: Clip) -> NDArray[np.bool_]:
    """(T, 75) where an axis-angle is not about to jump to the other side."""
    angle = np.linalg.norm(_angles(clip).reshape(len(clip), 23, 3), axis=-1)
    moving = np.ones((len(clip), NUM_MOVING), dtype=bool)
    moving[:, 3:-3] = np.repeat(angle < WRAPS_RAD, 3, axis=1)
    return moving


def _recorded(clip: Clip) -> NDArray[np.bool_]:
    """(75,) what the clip recorded."""
    joint = np.ones(24, dtype=bool)
    joint[list(_HANDS)] = False
    joint[list(_WRISTS)], joint[list(_TOES)] = clip.wrist_valid, clip.toe_valid
    return np.concatenate([np.repeat(joint, 3), np.ones(3, dtype=bool)])


def _symmetric(density: Array) -> Array:
    """(2, 75) the same for left and right, for all axes of the root, and for hands as for wrists."""
    angles = density[:, 3:-3].reshape(2, 23, 3).copy()
    for hand, wrist in zip(_HANDS, _WRISTS, strict=True):
        angles[:, hand - 1] = angles[:, wrist - 1]
    mirror = np.array(MIRROR_JOINTS)[1:] - 1
    angles = (angles + angles[:, mirror]) / 2
    root, place = (
        density[:, part].mean(axis=1, keepdims=True).repeat(3, axis=1) for part in (slice(3), slice(-3, None))
    )
    return np.concatenate([root, angles.reshape(2, -1), place], axis=1)
