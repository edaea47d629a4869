"""How a small change of each camera would move its pixels, and what of the residuals it explains.

The points are not known, so that what a change moves *along with the points* explains nothing: it is taken out
before (the Schur complement of a bundle adjustment), joint by joint.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.camera import Views
from shapepose_fg.setup_check.structure import Structure

Array = NDArray[np.float64]

PARAMETERS = ("turn x", "turn y", "turn z", "move x", "move y", "move z", "centre x", "centre y", "focal")
"""Of a camera: a turn about its own axes (rad) where it stands, a move along them (unit of the calibration), the
principal point (px), and the logarithm of the focal length."""
Q = len(PARAMETERS)
TURN, CENTRE, FOCAL, POSE = [0, 1, 2], [6, 7], [8], [0, 1, 2, 3, 4, 5]


@dataclass(frozen=True)
class Normal:
    """Normal equations of all cameras' small changes, the points taken out."""

    H: Array
    """(V Q, V Q)."""
    g: Array
    """(V Q,)."""

    def solve(self, columns: NDArray[np.intp], information: Array | float = 0.0) -> Array:
        """The change (n,) of some parameters that lowers the squares most; `information` (n,) holds it at 0."""
        H = self.H[np.ix_(columns, columns)] + np.diag(np.broadcast_to(information, len(columns)))
        return np.asarray(-np.linalg.lstsq(H, self.g[columns], rcond=1e-10)[0], dtype=np.float64)


def derivatives(structure: Structure, views: Views) -> Array:
    """(P, J, V, 2, Q) how each camera's parameters move its projections."""
    at = np.einsum("vab,pjb->pjva", views.cTw[:, :, :3], structure.points) + views.cTw[:, :, 3]
    return camera_derivatives(at, views.K)


def camera_derivatives(at: Array, K: Array) -> Array:
    """(..., 2, Q) how a camera's parameters move the pixels of points `at` (..., 3) in its frame; NaN behind."""
    fx, fy = K[..., 0, 0], K[..., 1, 1]
    X, Y = at[..., 0], at[..., 1]
    Z = np.where(at[..., 2] > 0, at[..., 2], np.nan)
    x, y, zero = X / Z, Y / Z, np.zeros_like(X)
    by_point = np.stack(
        [np.stack([fx / Z, zero, -fx * x / Z], -1), np.stack([zero, fy / Z, -fy * y / Z], -1)], axis=-2
    )
    cross = np.zeros((*X.shape, 3, 3))  # d (w x P) / d w = -[P]x
    cross[..., 0, 1], cross[..., 0, 2] = Z, -Y
    cross[..., 1, 0], cross[..., 1, 2] = -Z, X
    cross[..., 2, 0], cross[..., 2, 1] = Y, -X
    centre = np.broadcast_to(np.eye(2), (*X.shape, 2, 2))
    focal = np.stack([fx * x, fy * y], axis=-1)[..., None]
    return np.concatenate([by_point @ cross, by_point, centre, focal], axis=-1)


def normal_equations(structure: Structure, views: Views) -> Normal:
    """The normal equations at a structure that is triangulated (see `triangulate`), with its robust weights."""
    V = len(views)
    B = derivatives(structure, views)
    ok = (structure.weight > 0) & np.isfinite(structure.residual[..., 0]) & np.isfinite(B).all(axis=(-1, -2))
    root = np.where(ok, np.sqrt(structure.weight), 0.0)[..., None]
    P, J = ok.shape[:2]
    A = (np.where(ok[..., None, None], structure.jacobian, 0.0) * root[..., None]).reshape(P, J, 2 * V, 3)
    B = np.where(ok[..., None, None], B, 0.0) * root[..., None]
    r = np.where(ok[..., None], structure.residual, 0.0) * root
    At = A.swapaxes(-1, -2)
    points = At @ A
    points = points + (1e-9 * np.trace(points, axis1=-2, axis2=-1)[..., None, None] + 1e-300) * np.eye(3)
    # A camera's rows have its own columns only.
    coupling = (At.reshape(P, J, 3, V, 2).swapaxes(2, 3) @ B).swapaxes(2, 3).reshape(P, J, 3, V * Q)
    pull = At @ r.reshape(P, J, 2 * V, 1)
    solved = np.linalg.solve(points, np.concatenate([coupling, pull], axis=-1)).reshape(-1, V * Q + 1)
    H = -(coupling.reshape(-1, V * Q).T @ solved[:, :-1])
    g = -(coupling.reshape(-1, V * Q).T @ solved[:, -1])
    for view in range(V):
        block = slice(view * Q, view * Q + Q)
        own = B[:, :, view].reshape(-1, Q)
        H[block, block] += own.T @ own
        g[block] += own.T @ r[:, :, view].ravel()
    return Normal(H, g)


def changed(views: Views, change: Array) -> Views:
    """The cameras with `change` (V, Q) made to their parameters."""
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_rotvec(change[:, 0:3]).as_matrix()
    cTw = turn @ views.cTw
    cTw[:, :, 3] += change[:, 3:6]
    K = views.K.copy()
    K[:, :2, :2] *= np.exp(change[:, 8])[:, None, None]
    K[:, :2, 2] += change[:, 6:8]
    return Views(K, cTw)
