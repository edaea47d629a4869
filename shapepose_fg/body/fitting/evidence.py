"""Validation and weighting of joint targets before any fit."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.body.fitting.fitter import STATUS_TYPE, FitStatus, JointTargets
from shapepose_fg.core.arrays import Array, Mask
from shapepose_fg.core.compiled import kernel, part
from shapepose_fg.core.rows import Rows

LEAST_JOINTS = 4
"""Minimum number of joints with full information: three determine a pose, one more
allows a check."""
_SEEN_SIGMA_M = 0.3
"""A joint has full information if its standard deviation along every axis is below this, m."""
WELL_SEEN_M = 0.05
"""Standard deviation up to which a joint is well seen, m."""
MIN_SPREAD_M = 0.03
"""Minimum root mean square distance of the joints with full information from a common line, m; else
the rotation about it is undetermined."""


@dataclass(frozen=True)
class Evidence(Rows):
    """Validated targets: status of each row, and information including the model's error."""

    status: NDArray[np.str_]
    """(B,) OK, or the reason why the row cannot be fitted."""
    xyz: Array
    """(B, K, 3) targets, zero where there is no information, metres."""
    information: Array
    """(B, K, 3, 3) inverse of (information^-1 + sigma² I), 1/m²; also valid for singular
    information."""
    variance_m2: Array
    """(B, K) mean variance over the axes, m², of joints with full information; else infinite."""
    centre: Array
    """(B, 3) mean of the joints with full information, metres."""

    @property
    def total_information(self) -> Array:
        """(B,) total information of all joints of a row, mean over the axes, 1/m²."""
        return np.asarray(np.trace(self.information, axis1=2, axis2=3).sum(axis=1) / 3)


def weigh(targets: JointTargets, model_sigma_m: float) -> Evidence:
    """Validate the rows, and add the model's error, a standard deviation in metres, to every
    target.
    """
    xyz, information, valid = _refuse_nonsense(targets)
    weighed, variance, full = (
        np.empty_like(information),
        np.empty(xyz.shape[:2]),
        np.empty(xyz.shape[:2], dtype=bool),
    )
    _weighed(information, model_sigma_m**2, weighed, variance, full, valid)
    count = full.sum(axis=1)
    centre = np.where(full[..., None], xyz, 0.0).sum(axis=1) / np.maximum(count, 1)[:, None]
    status = np.full(len(xyz), FitStatus.OK, dtype=STATUS_TYPE)
    status[~determine_pose(xyz, full)] = FitStatus.TOO_FEW_JOINTS
    status[~valid] = FitStatus.INVALID_TARGETS
    return Evidence(status, xyz, weighed, variance, centre)


@part
def _positive(a, b, c, d, e, f):
    """Whether the symmetric matrix ((a, b, c), (b, d, e), (c, e, f)) is positive definite, by its
    minors.
    """
    return (
        a > 0
        and a * d - b * b > 0
        and a * (d * f - e * e) + b * (c * e - b * f) + c * (b * e - c * d) > 0
    )


@kernel("f4 f0 f4 f2 b2 b1")
def _weighed(information, v, found, variance, full, valid):
    """For B rows of targets with `information` L (B, K, 3, 3), fill in `found` = (L^-1 + v I)^-1;
    the mean `variance` (B, K) over the axes of targets that are `full`, else infinite; and which
    rows are not `valid` (B,).
    """
    least = 1 / _SEEN_SIGMA_M**2
    for n in range(len(information)):
        for k in range(information.shape[1]):
            L, M = information[n, k], found[n, k]
            a, d, f = L[0, 0], L[1, 1], L[2, 2]
            b, c, e = (L[0, 1] + L[1, 0]) / 2, (L[0, 2] + L[2, 0]) / 2, (L[1, 2] + L[2, 1]) / 2
            # Relative tolerance for asymmetry and negative eigenvalues of information; inverses for
            # rays lose precision.
            t = 1e-4 * max(math.sqrt(a * a + d * d + f * f + 2 * (b * b + c * c + e * e)), 1.0)
            askew = max(abs(L[0, 1] - L[1, 0]), abs(L[0, 2] - L[2, 0]), abs(L[1, 2] - L[2, 1]))
            if askew > t or not _positive(a + t, b, c, d + t, e, f + t):
                valid[n] = False
            full[n, k] = _positive(a - least, b, c, d - least, e, f - least)
            # L (I + v L)^-1, by minors.
            A, D, F, B, C, E = 1 + v * a, 1 + v * d, 1 + v * f, v * b, v * c, v * e
            p, q, r, s, u, w = (
                D * F - E * E,
                C * E - B * F,
                B * E - C * D,
                A * F - C * C,
                B * C - A * E,
                A * D - B * B,
            )
            scale = 1 / (A * p + B * q + C * r)
            M[0, 0], M[1, 1] = scale * (a * p + b * q + c * r), scale * (b * q + d * s + e * u)
            M[2, 2] = scale * (c * r + e * u + f * w)
            M[0, 1] = M[1, 0] = scale * (a * q + b * s + c * u)
            M[0, 2] = M[2, 0] = scale * (a * r + b * u + c * w)
            M[1, 2] = M[2, 1] = scale * (b * r + d * u + e * w)
            variance[n, k] = math.inf
            if full[n, k]:
                det = a * (d * f - e * e) + b * (c * e - b * f) + c * (b * e - c * d)
                variance[n, k] = (d * f - e * e + a * f - c * c + a * d - b * b) / (3 * det) + v


def determine_pose(xyz: Array, used: Mask) -> Mask:
    """(...) whether the joints `used` (..., K) of `xyz` (..., K, 3) determine a pose: enough, and
    not on a line.
    """
    count = used.sum(axis=-1)
    points = np.where(used[..., None], xyz, 0.0)
    centre = points.sum(axis=-2) / np.maximum(count, 1)[..., None]
    points = np.where(used[..., None], points - centre[..., None, :], 0.0)
    scatter = points.swapaxes(-1, -2) @ points / np.maximum(count, 1)[..., None, None]
    # The mean squared distance from the best line is the trace less the largest eigenvalue.
    off = np.maximum(np.linalg.eigvalsh(scatter)[..., :2].sum(axis=-1), 0.0)
    return (count >= LEAST_JOINTS) & (off >= MIN_SPREAD_M**2)


def _refuse_nonsense(targets: JointTargets) -> tuple[Array, Array, Mask]:
    """Targets and information with non-finite rows set to zero, and a mask (B,) of the finite rows.

    The position of a joint without information is ignored, and may be NaN.
    """
    known = np.any(targets.information != 0, axis=(2, 3))  # NaN differs from 0
    finite = np.isfinite(targets.information).all(axis=(1, 2, 3))
    finite &= (np.isfinite(targets.xyz).all(axis=2) | ~known).all(axis=1)
    xyz = np.where((known & finite[:, None])[..., None], targets.xyz, 0.0)
    return xyz, np.where(finite[:, None, None, None], targets.information, 0.0), finite
