"""Which joint targets can be believed, and how much: what every fitter does before it fits."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.body.fitting.fitter import STATUS_TYPE, FitStatus, JointTargets, Rows
from shapepose_fg.core.arrays import Array, Mask

_ROUNDING = 1e-4
"""Asymmetry or negativity of information, relative, that passes for rounding: inverses of rays lose much."""
LEAST_JOINTS = 4
"""Joints with full information that a fit needs: three place a body in space, one more says whether they agree."""
_SEEN_SIGMA_M = 0.3
"""A joint's information is full when its target's sigma is under this along every axis, metres."""
MIN_SPREAD_M = 0.03
"""Joints with full information must lie this far off a common line (root mean square), metres: the body could spin
about it."""


@dataclass(frozen=True)
class Evidence(Rows):
    """Targets, judged: which rows can be fitted, and their information with the model's error in it."""

    status: NDArray[np.str_]
    """(B,) OK or why not."""
    xyz: Array
    """(B, K, 3) targets, zero where there is no information, metres."""
    root: Array
    """(B, K, 3, 3) symmetric square root of (information^-1 + sigma² I)^-1, 1/m."""
    variance_m2: Array
    """(B, K) mean variance over the axes of joints with full information, else infinite."""
    centre: Array
    """(B, 3) mean of the joints with full information, metres."""

    @property
    def total_information(self) -> Array:
        """(B,) of all joints of a row, mean over the axes, 1/m²."""
        return np.square(self.root).sum(axis=(1, 2, 3)) / 3


def weigh(targets: JointTargets, model_sigma_m: float) -> Evidence:
    """Judge the rows, and add the model's error, a sigma in metres, to every target.

    An eigenvalue l of the information becomes l / (1 + l sigma²), which is the inverse of 1 / l + sigma² and
    holds for l = 0 too: a direction in which nothing was measured.
    """
    xyz, information, valid = _refuse_nonsense(targets)
    values, vectors = np.linalg.eigh((information + information.swapaxes(-1, -2)) / 2)
    tolerance = _ROUNDING * np.maximum(np.abs(values).max(axis=-1), 1.0)
    asymmetry = np.abs(information - information.swapaxes(-1, -2)).max(axis=(-1, -2))
    valid &= ((values[..., 0] > -tolerance) & (asymmetry <= tolerance)).all(axis=1)
    values = np.maximum(values, 0.0)
    full = values[..., 0] > 1 / _SEEN_SIGMA_M**2
    count = full.sum(axis=1)
    centre = np.where(full[..., None], xyz, 0.0).sum(axis=1) / np.maximum(count, 1)[:, None]
    status = np.full(len(xyz), FitStatus.OK, dtype=STATUS_TYPE)
    status[~determine_pose(xyz, full)] = FitStatus.TOO_FEW_JOINTS
    status[~valid] = FitStatus.INVALID_TARGETS
    half = np.sqrt(values / (1 + values * model_sigma_m**2))
    root = (vectors * half[..., None, :]) @ vectors.swapaxes(-1, -2)
    variance = (1 / np.where(full[..., None], values, 1.0)).mean(axis=-1) + model_sigma_m**2
    return Evidence(status, xyz, root, np.where(full, variance, np.inf), centre)


def determine_pose(xyz: Array, used: Mask) -> Mask:
    """(...) whether the joints `used` (..., K) of `xyz` (..., K, 3) are enough, and do not lie on a line."""
    count = used.sum(axis=-1)
    points = np.where(used[..., None], xyz, 0.0)
    centre = points.sum(axis=-2) / np.maximum(count, 1)[..., None]
    points = np.where(used[..., None], points - centre[..., None, :], 0.0)
    scatter = points.swapaxes(-1, -2) @ points / np.maximum(count, 1)[..., None, None]
    # How far they lie off their best line, squared, is what the largest eigenvalue leaves of the trace.
    off = np.maximum(np.linalg.eigvalsh(scatter)[..., :2].sum(axis=-1), 0.0)
    return (count >= LEAST_JOINTS) & (off >= MIN_SPREAD_M**2)


def _refuse_nonsense(targets: JointTargets) -> tuple[Array, Array, Mask]:
    """Targets and information with rows that are not finite set to zero, and which rows (B,) were finite.

    The place of a joint without information may be anything, NaN too: it is not used.
    """
    known = np.any(targets.information != 0, axis=(2, 3))  # NaN differs from 0
    finite = np.isfinite(targets.information).all(axis=(1, 2, 3))
    finite &= (np.isfinite(targets.xyz).all(axis=2) | ~known).all(axis=1)
    xyz = np.where((known & finite[:, None])[..., None], targets.xyz, 0.0)
    return xyz, np.where(finite[:, None, None, None], targets.information, 0.0), finite
