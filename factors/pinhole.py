"""The pinhole projection and its derivative, for arrays: the implementation that the package uses
outside GTSAM.

Undistorted pixels, x right, y down; cameras look along +z. NumPy only.
"""

import numpy as np
from numpy.typing import NDArray


def to_pixels(
    points_camera: NDArray[np.float64], K: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Pixels (..., 2) and depths (...,) of points (..., 3) in camera coordinates.

    `K` (..., 3, 3) broadcasts against the points. NaN pixels where the depth is not positive.
    """
    depth = points_camera[..., 2]
    before = np.where(depth > 0, depth, np.nan)
    x, y = points_camera[..., 0] / before, points_camera[..., 1] / before
    rows = (K[..., n, 0] * x + K[..., n, 1] * y + K[..., n, 2] for n in range(2))
    return np.stack(np.broadcast_arrays(*rows), axis=-1), depth


def project_with_jacobian(
    points_world: NDArray[np.float64], K: NDArray[np.float64], cTw: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Pixels (..., 2), depths (...,) and derivatives (..., 2, 3), pixels per metre, of
    `points_world` (..., 3).

    `K` (..., 3, 3) in pixels and `cTw` (..., 3, 4), camera from world, broadcast against the
    points. Pixels and derivatives are NaN where the depth is not positive. With R the rotation, K'
    the upper 2 x 2 of K and z the depth,

        d uv / d point = (K' R[:2] - (uv - c) R[2]) / z
    """
    R = cTw[..., :3]
    xy, depth = to_pixels(np.einsum("...ij,...j->...i", R, points_world) + cTw[..., 3], K)
    safe = np.where(depth > 0, depth, np.nan)[..., None, None]
    from_centre = (xy - K[..., :2, 2])[..., None]
    return xy, depth, (K[..., :2, :2] @ R[..., :2, :] - from_centre * R[..., 2:, :]) / safe
