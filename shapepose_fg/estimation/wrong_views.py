"""Detects a camera with a wrong pose: residuals against the other views, before and after a change
of its pose.
"""

from dataclasses import dataclass

import numpy as np

from factors import kernel_weight
from shapepose_fg.body.model.rotation import hat
from shapepose_fg.core.arrays import Array, Mask
from shapepose_fg.core.camera import Views
from shapepose_fg.estimation.linearisation import ObservationConfig, inverses

_REST_M = 0.05
"""Approximate standard deviation of a joint by body and motion, per axis, m."""
_MOST = 36.0
"""Upper limit of squared distances, 6 sigmas: some detections are other people's."""
_WIDTH, _ROUNDS = 3.0, 12
"""Width of Cauchy's kernel, in sigmas, and number of reweighting rounds for a pose."""
_TURN_RAD, _SHIFT_M = np.radians(5.0), 0.5
"""Prior standard deviations of a camera's pose change per axis, rad and m."""
_TOGETHER = 50.0
"""Number of detections that count as one: errors are correlated over frames and over a person."""
_LEAST = 30
"""Minimum number of detections of a tested camera."""
_BETTER = 1.2
"""Minimum factor by which the mean squared distance falls for a wrong camera: 1.4 and more in 32
set-ups with a camera rotated by 0.7 to 3 degrees or moved by 8 to 30 cm, 1.03 in correct ones
(simulated)."""


@dataclass(frozen=True)
class WrongView:
    """A view with a pose that does not fit the others."""

    view: int
    """Index of the view."""
    turn_deg: tuple[float, float]
    """Rotation that would make it fit, and its standard deviation, degrees."""
    shift_m: tuple[float, float]
    """Translation that, with this rotation, would make it fit, and its standard
    deviation, metres."""
    before: float
    """Mean squared distance of its detections from the other views' prediction, in variances, up to
    36; 2 is usual."""
    after: float
    """Mean squared distance after the change of the view's pose."""


@dataclass(frozen=True)
class Seen:
    """All detections of N rows, relative to the current joints."""

    residual_px: Array
    """(N, J, V, 2) projected joint minus detection, pixels; arbitrary without a detection."""
    sigmas_px: Array
    """(N, J, V) standard deviations, pixels."""
    there: Mask
    """(N, J, V) whether there is a detection of a joint with a position."""
    used: Mask
    """(N, J, V) mask of the used detections."""


def wrong_view(
    seen: Seen, joints: Array, views: Views, config: ObservationConfig
) -> WrongView | None:
    """The view with the pose change that best makes all views agree on `joints` (N, J, 3); None if
    no change is significant.

    Each detection is compared with the joint predicted without that view, and each view's pose is
    changed by Gauss-Newton with iterative reweighting. Then all joints are solved again, linearly,
    with that pose.
    """
    points = np.nan_to_num(joints)
    _, _, slope = views.project(points)
    there = seen.there & np.isfinite(slope).all(axis=(-1, -2)) & (seen.sigmas_px > 0)
    if not there.any():
        return None
    sigma, used = np.where(there, seen.sigmas_px, 1.0), seen.used & there
    slope = np.where(there[..., None, None], slope, 0.0)
    residual = np.where(there[..., None], np.nan_to_num(seen.residual_px), 0.0)
    weight = (
        kernel_weight(config.robust_kernel, np.linalg.norm(residual, axis=-1) / sigma) / sigma**2
    )
    weight = np.where(used, weight, 0.0)
    information = np.einsum("njv,njvki,njvkl->njvil", weight, slope, slope)
    whole = information.sum(axis=2) + np.eye(3) / _REST_M**2
    without = inverses(whole[:, :, None] - information)
    spread = sigma[..., None, None] ** 2 * np.eye(2) + slope @ without @ slope.mT
    root = np.linalg.inv(np.linalg.cholesky(spread))

    def whitened(residual: Array) -> Array:
        """(N, J, V, 2) residuals from the other views' prediction, in sigmas."""
        pull = np.einsum("njv,njvki,njvk->njvi", weight, slope, residual)
        away = residual + np.einsum("njvki,njvil,njvl->njvk", slope, without, pull)
        return np.einsum("njvik,njvk->njvi", root, away)

    off, before = whitened(residual), _cost(whitened(residual), there)
    best, found = before / _BETTER, None
    for view in np.flatnonzero(there.sum(axis=(0, 1)) >= _LEAST).tolist():
        twist = _slope_of_pose(points, slope, views, view)
        step, covariance = _pose_step(root[:, :, view] @ twist, off[:, :, view], there[:, :, view])
        changed = residual.copy()
        changed[:, :, view] -= twist @ step
        change = np.einsum(
            "nj,njki,njk->nji",
            weight[:, :, view],
            slope[:, :, view],
            (changed - residual)[:, :, view],
        )
        changed -= np.einsum(
            "njvki,nji->njvk", slope, np.linalg.solve(whole, change[..., None])[..., 0]
        )
        after = whitened(changed)
        if _cost(after, there) < best:
            best, only = _cost(after, there), there[:, :, [view]]
            turn, shift = (
                (
                    float(np.linalg.norm(step[part])),
                    float(np.sqrt(np.linalg.norm(covariance[part, part], ord=2))),
                )
                for part in (slice(3), slice(3, 6))
            )
            costs = _cost(off[:, :, [view]], only), _cost(after[:, :, [view]], only)
            found = WrongView(view, (np.degrees(turn[0]), np.degrees(turn[1])), shift, *costs)
    return found


def _cost(off: Array, there: Mask) -> float:
    return float(np.minimum((off[there] ** 2).sum(axis=-1), _MOST).mean())


def _slope_of_pose(points: Array, slope: Array, views: Views, view: int) -> Array:
    """(N, J, 2, 6) derivatives of pixels by a rotation, radians, and a translation, metres, of the
    world in the camera.
    """
    cTw = views.cTw[..., view, :, :]
    R, t = cTw[..., :3], cTw[..., 3]
    before = points @ R.mT + (t[:, None] if cTw.ndim == 3 else t)
    of_camera = slope[:, :, view] @ (R.mT[:, None] if cTw.ndim == 3 else R.mT)
    return np.concatenate([of_camera @ -hat(before), of_camera], axis=-1)


def _pose_step(slope: Array, off: Array, there: Mask) -> tuple[Array, Array]:
    """(6,) rotation and translation that best reduce the whitened `off`, and their covariance (6,
    6).
    """
    slope, off = slope[there], off[there]
    prior = np.diag([_TURN_RAD**-2.0] * 3 + [_SHIFT_M**-2.0] * 3)
    step, normal = np.zeros(6), prior
    for _ in range(_ROUNDS):
        left = np.linalg.norm(off - slope @ step, axis=-1)
        weight = kernel_weight("cauchy", left, _WIDTH) / _TOGETHER
        normal = np.einsum("n,nki,nkl->il", weight, slope, slope) + prior
        step = np.linalg.solve(normal, np.einsum("n,nki,nk->i", weight, slope, off))
    return step, np.linalg.inv(normal)
