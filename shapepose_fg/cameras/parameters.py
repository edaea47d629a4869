"""Parameters of cameras, and the derivatives of pixels by these and by the points."""

from dataclasses import replace

import numpy as np

from shapepose_fg.body.model.rotation import exp_so3
from shapepose_fg.core.arrays import Array
from shapepose_fg.core.camera import Views
from shapepose_fg.core.decompositions import rotation_angle

PARAMETERS = (
    "turn x",
    "turn y",
    "turn z",
    "move x",
    "move y",
    "move z",
    "centre x",
    "centre y",
    "focal",
)
"""Parameters of a camera: rotation about its own axes (rad) at a fixed centre, translation along
them (unit of the calibration), principal point (px), and logarithm of the focal length."""
Q = len(PARAMETERS)
TURN, MOVE, CENTRE, FOCAL, POSE = [0, 1, 2], [3, 4, 5], [6, 7], [8], [0, 1, 2, 3, 4, 5]
_MOST_ZOOM = 5.0
"""Maximum step of the focal length's logarithm; larger ones are implausible and would overflow."""


def seen_by(points: Array, views: Views) -> tuple[Array, Array, Array]:
    """Projections of `points` (N, J, 3): pixels (N, J, V, 2), coordinates in the cameras (N, J, V,
    3), and derivatives of pixels by these (N, J, V, 2, 3).
    """
    at = np.einsum("vab,njb->njva", views.cTw[:, :, :3], points) + views.cTw[:, :, 3]
    at[..., 2] = np.where(np.abs(at[..., 2]) < 1e-9, 1e-9, at[..., 2])
    xy = np.einsum("vab,njvb->njva", views.K[:, :2], at / at[..., 2:])
    return xy, at, (views.K[:, :2] - xy[..., None] * views.K[:, None, 2]) / at[..., 2, None, None]


def by_parameters(xy: Array, at: Array, by_point: Array, views: Views) -> Array:
    """(N, J, V, 2, Q) derivatives of pixels by the cameras' `PARAMETERS`, from the results of
    `seen_by`.
    """
    J = np.empty((*xy.shape, Q))
    J[..., TURN], J[..., MOVE] = np.cross(at[..., None, :], by_point), by_point
    J[..., CENTRE], J[..., FOCAL] = np.eye(2), (xy - views.K[:, :2, 2])[..., None]
    return J


def placing(A: Array) -> Array:
    """(..., 3, m) map from residuals (..., m) to the motion of a point that reduces them most, for
    their derivatives A (..., m, 3) by its position.
    """
    H = A.mT @ A
    # Relative information added to each joint's position, since two rays may be parallel.
    H += np.eye(3) * (1e-6 * np.trace(H, axis1=-2, axis2=-1)[..., None, None] + 1e-300)
    return np.linalg.solve(H, A.mT)


def difference(cTw: Array, other: Array) -> tuple[Array, Array]:
    """Rotations (...) in degrees and distances (...) of centres between poses (..., 3, 4)."""
    centres = [(-each[..., :3].mT @ each[..., 3:])[..., 0] for each in (cTw, other)]
    turns = rotation_angle(cTw[..., :3] @ other[..., :3].mT)
    return np.rad2deg(turns), np.linalg.norm(centres[0] - centres[1], axis=-1)


def changed_one(views: Views, view: int, columns: list[int], change: Array) -> Views:
    """The cameras with `change` (n,) applied to some parameters of one of them."""
    every = np.zeros((len(views), Q))
    every[view, columns] = change
    return changed(views, every)


def changed(views: Views, change: Array) -> Views:
    """The cameras with `change` (V, Q) applied to their parameters."""
    cTw = exp_so3(change[:, 0:3]) @ views.cTw
    cTw[:, :, 3] += change[:, 3:6]
    K = views.K.copy()
    K[:, :2, :2] *= np.exp(np.clip(change[:, 8], -_MOST_ZOOM, _MOST_ZOOM))[:, None, None]
    K[:, :2, 2] += change[:, 6:8]
    return replace(views, K=K, cTw=cTw)
