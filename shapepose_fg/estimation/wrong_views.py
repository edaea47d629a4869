"""Is a camera off with whatever it sees? Residuals against the other views, before and after a pose gives way."""

from dataclasses import dataclass

import numpy as np

from factors import kernel_weight
from shapepose_fg.body.model.rotation import hat
from shapepose_fg.core.arrays import Array, Mask
from shapepose_fg.core.camera import Views
from shapepose_fg.estimation.linearisation import ObservationConfig, inverses

_REST_M = 0.05
"""What body and motion say of a joint, about, one sigma per axis."""
_MOST = 36.0
"""Squared distances count up to 6 sigmas: some detections are somebody else's."""
_WIDTH, _ROUNDS = 3.0, 12
"""Width of Cauchy's kernel, in sigmas, and rounds of reweighting in which a pose gives way."""
_TURN_RAD, _SHIFT_M = np.radians(5.0), 0.5
"""How far a camera may have come off, one sigma per axis."""
_TOGETHER = 50.0
"""Number of detections that tell as much as one: errors last from frame to frame and go through a whole person."""
_LEAST = 30
"""Detections by which a camera is judged."""
_BETTER = 1.2
"""The mean squared distance falls by this factor, at the least, where a camera is wrong: by 1.4 and more in 32
set-ups with a camera turned by 0.7 to 3 degrees or moved by 8 to 30 cm, by 1.03 in sound ones (simulated)."""


@dataclass(frozen=True)
class WrongView:
    """A view whose pose does not fit what the others see."""

    view: int
    """Which."""
    turn_deg: tuple[float, float]
    """How far turning it would make it fit, and the sigma of that."""
    shift_m: tuple[float, float]
    """How far moving it, together with that turn, and the sigma of that."""
    before: float
    """Mean squared distance of its detections from what the others say, in sigmas, up to 36; 2 is usual."""
    after: float
    """Mean squared distance if its pose gave way."""


@dataclass(frozen=True)
class Seen:
    """All detections of N rows, and the joints as they are."""

    residual_px: Array
    """(N, J, V, 2) projected joint minus detection; anything where there is none."""
    sigmas_px: Array
    """(N, J, V)"""
    there: Mask
    """(N, J, V) whether there is a detection of a placed joint."""
    used: Mask
    """(N, J, V) which are part of the solution."""


def wrong_view(seen: Seen, joints: Array, views: Views, config: ObservationConfig) -> WrongView | None:
    """The view whose pose, let go, makes all views agree best on `joints` (N, J, 3); None where none does so by
    much.

    Each detection is compared with the joint as it is without that view, and each view's pose gets one
    Gauss-Newton step from there, robust by iterated reweighting. Then all joints are solved once more, linearly,
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
    weight = kernel_weight(config.robust_kernel, np.linalg.norm(residual, axis=-1) / sigma) / sigma**2
    weight = np.where(used, weight, 0.0)
    information = np.einsum("njv,njvki,njvkl->njvil", weight, slope, slope)
    whole = information.sum(axis=2) + np.eye(3) / _REST_M**2
    without = inverses(whole[:, :, None] - information)
    spread = sigma[..., None, None] ** 2 * np.eye(2) + slope @ without @ slope.mT
    root = np.linalg.inv(np.linalg.cholesky(spread))

    def whitened(residual: Array) -> Array:
        """(N, J, V, 2) residuals from where the other views have the joint, in sigmas."""
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
            "nj,njki,njk->nji", weight[:, :, view], slope[:, :, view], (changed - residual)[:, :, view]
        )
        changed -= np.einsum("njvki,nji->njvk", slope, np.linalg.solve(whole, change[..., None])[..., 0])
        after = whitened(changed)
        if _cost(after, there) < best:
            best, only = _cost(after, there), there[:, :, [view]]
            turn, shift = (
                (float(np.linalg.norm(step[part])), float(np.sqrt(np.linalg.norm(covariance[part, part], ord=2))))
                for part in (slice(3), slice(3, 6))
            )
            costs = _cost(off[:, :, [view]], only), _cost(after[:, :, [view]], only)
            found = WrongView(view, (np.degrees(turn[0]), np.degrees(turn[1])), shift, *costs)
    return found


def _cost(off: Array, there: Mask) -> float:
    return float(np.minimum((off[there] ** 2).sum(axis=-1), _MOST).mean())


def _slope_of_pose(points: Array, slope: Array, views: Views, view: int) -> Array:
    """(N, J, 2, 6) how pixels go with a turn, radians, and a shift, metres, of the world before a camera."""
    cTw = views.cTw[..., view, :, :]
    R, t = cTw[..., :3], cTw[..., 3]
    before = points @ R.mT + (t[:, None] if cTw.ndim == 3 else t)
    of_camera = slope[:, :, view] @ (R.mT[:, None] if cTw.ndim == 3 else R.mT)
    return np.concatenate([of_camera @ -hat(before), of_camera], axis=-1)


def _pose_step(slope: Array, off: Array, there: Mask) -> tuple[Array, Array]:
    """(6,) the turn and shift that take most of `off` away, whitened, and their covariance (6, 6)."""
    slope, off = slope[there], off[there]
    prior = np.diag([_TURN_RAD**-2.0] * 3 + [_SHIFT_M**-2.0] * 3)
    step, normal = np.zeros(6), prior
    for _ in range(_ROUNDS):
        left = np.linalg.norm(off - slope @ step, axis=-1)
        weight = kernel_weight("cauchy", left, _WIDTH) / _TOGETHER
        normal = np.einsum("n,nki,nkl->il", weight, slope, slope) + prior
        step = np.linalg.solve(normal, np.einsum("n,nki,nk->i", weight, slope, off))
    return step, np.linalg.inv(normal)
