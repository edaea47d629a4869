"""Collars that nobody recorded: the shoulder girdle follows the arm, the arm stays where it was."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]

COLLARS, SHOULDERS = (13, 14), (16, 17)
"""Left and right in SMPL's order."""
_SETTING = np.radians(30.0)
"""Up to this elevation of the arm only the glenohumeral joint turns (Inman, Saunders and Abbott 1944)."""
_RISE = 0.2
"""Elevation of the clavicle for each radian of the arm's beyond `_SETTING`: 30 degrees with the arm overhead.

Overhead, a third of the arm's elevation is the shoulder blade's (1:2), and half of that the clavicle's; the other
half, at the outer end of the clavicle, hardly moves the shoulder's centre, and SMPL's tree has no joint for it.
"""
_REST = np.radians(60.0)
"""The arm's elevation at which the collar is as in the T-pose: the T-pose of a body file is made by turning the
arms of one that stands with arms half raised, its collars stay."""
_SWEEP = 0.22
"""Radians by which the collar goes forward when the raised arm points forward, and back when it points back."""


def shoulder_rhythm(rotations: Array) -> Array:
    """Local rotations (T, 24, 3, 3) with collars that follow the arms; collars that came with them are dropped.

    The collar rises and sweeps with the upper arm's direction in the chest's frame (scapulohumeral rhythm);
    the shoulder turns back by as much, so the upper arm's rotation in the chest's frame, and with it in the
    world, is exactly what it was.
    """
    adapted = rotations.copy()
    for side, (collar, shoulder) in enumerate(zip(COLLARS, SHOULDERS, strict=True)):
        sign = (1.0, -1.0)[side]
        arm = rotations[:, collar] @ rotations[:, shoulder]
        along = sign * arm[:, :, 0]  # the T-pose's arm lies along +x on the left
        turned = _collar(along, sign)
        adapted[:, collar] = turned
        adapted[:, shoulder] = np.swapaxes(turned, -1, -2) @ arm
    return adapted


def _collar(along: Array, sign: float) -> Array:
    """Rotation (T, 3, 3) of the collar when the upper arm points `along` (T, 3) in the chest's frame."""
    elevation = np.arccos(np.clip(-along[:, 1], -1.0, 1.0))  # 0 hanging, pi overhead
    rise = _RISE * (_ramp(elevation - _SETTING) - _ramp(np.array([_REST - _SETTING])))
    raised = np.sin(np.clip(elevation, 0.0, np.pi / 2)) ** 2
    sweep = _SWEEP * raised * along[:, 2] - 0.35 * np.maximum(rise, 0.0)
    return Rotation.from_euler("yz", np.stack([-sign * sweep, sign * rise], axis=1)).as_matrix()


def _ramp(angle: Array) -> Array:
    """0 below 0 and `angle` above it, rounded over a tenth of a radian: the collar does not start with a jerk."""
    return 0.05 * np.logaddexp(0.0, angle / 0.05)
