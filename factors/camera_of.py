"""Recovers the camera of a native projection factor from its projections, because GTSAM's Python
interface does not expose it.
"""

from collections.abc import Callable

import gtsam
import numpy as np
from numpy.typing import NDArray

from factors.projection import make_calibration

Array = NDArray[np.float64]
Camera = gtsam.PinholeCameraCal3_S2

_LEAST, _TRIED = 16, 4000
"""Minimum number of visible points for the fit, and maximum number of points that are tried, at
increasing distances."""


def camera_of(pixel: Callable[[Array], Array | None], near: Array) -> Camera | None:
    """Estimate the pinhole camera from `pixel`, a function that projects a point (3,) to (2,)
    pixels, or returns None for a point behind the camera.

    Points around `near` (3,), metres, are projected. Returns None if no pinhole camera reproduces
    the pixels to 1e-10 of the picture's size.
    """
    rng, points, pixels = np.random.default_rng(0), list[Array](), list[Array]()
    for count in range(_TRIED):
        point = near + rng.normal(0, 1 + count / 40, 3)
        uv = pixel(point)
        if uv is not None:
            points.append(point)
            pixels.append(uv)
        if len(points) == _LEAST:
            break
    else:
        return None
    X, uv = np.array(points), np.array(pixels)
    camera = _of_matrix(_linear(X, uv))
    for _ in range(4):
        off = _seen(camera, X) - uv
        if not np.isfinite(off).all():
            return None
        # Typical changes of the entries of K, px, of the rotation, rad, and of the position, m.
        steps = np.eye(11) * 1e-6 * np.array([camera.calibration().fx()] * 5 + [1.0] * 6)
        slopes = [
            (_seen(_moved(camera, d), X) - _seen(_moved(camera, -d), X)).ravel() / 2 for d in steps
        ]
        change = np.linalg.lstsq(np.stack(slopes, axis=1), -off.ravel(), rcond=None)[0]
        camera = _moved(camera, change @ steps)
    return camera if np.abs(_seen(camera, X) - uv).max() < 1e-10 * np.abs(uv).max() else None


def _linear(X: Array, uv: Array) -> Array:
    """(3, 4) projection matrix K [R | t], up to scale, by the direct linear transform from points
    `X` (M, 3) and pixels `uv` (M, 2).
    """
    middle, size = X.mean(axis=0), X.std()
    centre, spread = uv.mean(axis=0), uv.std()
    to_world = np.diag([1 / size] * 3 + [1.0])
    to_world[:3, 3] = -middle / size
    X1 = np.column_stack([(X - middle) / size, np.ones(len(X))])
    x, y = ((uv - centre) / spread).T[..., None]
    nothing = np.zeros_like(X1)
    rows = np.vstack([np.hstack([X1, nothing, -x * X1]), np.hstack([nothing, X1, -y * X1])])
    P = np.linalg.svd(rows)[2][-1].reshape(3, 4)
    from_picture = np.array([[spread, 0, centre[0]], [0, spread, centre[1]], [0, 0, 1.0]])
    P = from_picture @ P @ to_world
    return P * np.sign((X @ P[2, :3] + P[2, 3]).mean()) / np.linalg.norm(P[2, :3])


def _of_matrix(P: Array) -> Camera:
    """Decompose a projection matrix (3, 4) into intrinsics and pose, by an RQ decomposition of P[:,
    :3] = K R from the last row up.
    """
    Q, L = np.linalg.qr(P[::-1, :3].T)
    signs = np.where(np.diag(L) < 0, -1.0, 1.0)
    K, R = (L.T * signs)[::-1, ::-1], (Q * signs).T[::-1]
    pose = gtsam.Pose3(gtsam.Rot3(R.T), -np.linalg.solve(P[:, :3], P[:, 3]))
    return Camera(pose, make_calibration(K / K[2, 2]))


def _moved(camera: Camera, change: Array) -> Camera:
    calibration = gtsam.Cal3_S2(*(camera.calibration().vector() + change[:5]))
    return Camera(camera.pose().retract(change[5:]), calibration)


def _seen(camera: Camera, X: Array) -> Array:
    """(M, 2) pixels of points (M, 3) projected by the camera."""
    cTw = np.linalg.inv(camera.pose().matrix())
    ends = (X @ cTw[:3, :3].T + cTw[:3, 3]) @ camera.calibration().K().T
    return ends[:, :2] / ends[:, 2:]
