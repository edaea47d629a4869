"""Bundle adjustment: what of the residuals small changes of the cameras explain, by GTSAM.

The points are not known, so that what a change moves *along with the points* explains nothing: GTSAM eliminates
them.
"""

from dataclasses import dataclass

import gtsam
import numpy as np
from gtsam.symbol_shorthand import C, K, P
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from shapepose_fg.core.camera import Views
from shapepose_fg.setup_check.structure import Structure

Array = NDArray[np.float64]

PARAMETERS = ("turn x", "turn y", "turn z", "move x", "move y", "move z", "centre x", "centre y", "focal")
"""Of a camera: a turn about its own axes (rad) where it stands, a move along them (unit of the calibration), the
principal point (px), and the logarithm of the focal length."""
Q = len(PARAMETERS)
TURN, CENTRE, FOCAL, POSE = [0, 1, 2], [6, 7], [8], [0, 1, 2, 3, 4, 5]
_MOST_ZOOM = 5.0
"""A step of the focal length's logarithm beyond this is no camera's, and would soon be no number."""
_WEAK = 1e-9
"""The information that a point has without any view, as a part of what it has: two rays may be parallel."""


@dataclass(frozen=True)
class Normal:
    """Normal equations of all cameras' small changes, the points taken out."""

    H: Array
    """(V Q, V Q)."""
    g: Array
    """(V Q,)."""

    def solve(self, columns: NDArray[np.intp]) -> Array:
        """The change (n,) of some parameters that lowers the squares most."""
        H = self.H[np.ix_(columns, columns)]
        return np.asarray(-np.linalg.lstsq(H, self.g[columns], rcond=1e-10)[0], dtype=np.float64)


def normal_equations(structure: Structure, views: Views) -> Normal:
    """The normal equations at a structure that is triangulated (see `triangulate`), with its robust weights."""
    V = len(views)
    ok = (structure.weight > 0) & np.isfinite(structure.residual[..., 0]) & (structure.depth > 0)
    used, graph, values = np.flatnonzero(ok.any(axis=-1)), gtsam.NonlinearFactorGraph(), gtsam.Values()
    precision = gtsam.noiseModel.Isotropic.Precision
    poses, lenses, points = ([name(index) for index in range(n)] for name, n in ((C, V), (K, V), (P, len(used))))
    for pose, lens, M, cTw in zip(poses, lenses, views.K, views.cTw, strict=True):
        R = cTw[:, :3]
        values.insert(pose, gtsam.Pose3(gtsam.Rot3(R.T), -R.T @ cTw[:, 3]))
        values.insert(lens, gtsam.Cal3_S2(M[0, 0], M[1, 1], M[0, 1], M[0, 2], M[1, 2]))
        # Next to no information: cameras without people stay in the equations.
        graph.add(gtsam.PriorFactorPose3(pose, values.atPose3(pose), precision(6, 1e-12)))
        graph.add(gtsam.PriorFactorCal3_S2(lens, values.atCal3_S2(lens), precision(5, 1e-12)))
    ok, weight = ok.reshape(-1, V)[used], structure.weight.reshape(-1, V)[used]
    slope = np.square(structure.jacobian.reshape(-1, V, 6)[used]).sum(axis=-1)
    weak = _WEAK * np.where(ok, weight * slope, 0.0).sum(axis=-1)
    for point, xyz, least in zip(points, structure.points.reshape(-1, 3)[used], weak, strict=True):
        values.insert(point, xyz)
        graph.add(gtsam.PriorFactorPoint3(point, xyz, precision(3, least)))
    row, view = np.nonzero(ok)
    seen = zip(row.tolist(), view.tolist(), structure.xy.reshape(-1, V, 2)[used][ok], weight[ok], strict=True)
    for n, v, xy, each in seen:
        factor = gtsam.GeneralSFMFactor2Cal3_S2(xy, precision(2, each), poses[v], points[n], lenses[v])
        graph.add(factor)
    order, rest = gtsam.Ordering(), gtsam.Ordering()
    for key in points:
        order.push_back(key)
    for pose, lens in zip(poses, lenses, strict=True):
        rest.push_back(pose)
        rest.push_back(lens)
    _, cameras = graph.linearize(values).eliminatePartialMultifrontal(order)
    H, eta = cameras.hessian(rest)
    T: Array = np.asarray(block_diag(*map(_tangent, views.K)))
    return Normal(T.T @ H @ T, -T.T @ eta)


def _tangent(M: Array) -> Array:
    """(11, Q) GTSAM's tangents of a camera's pose (world from camera) and calibration by `PARAMETERS`."""
    tangent = np.zeros((11, Q))
    tangent[:6, POSE] = -np.eye(6)
    tangent[6:9, 8] = M[0, 0], M[1, 1], M[0, 1]
    tangent[9:, CENTRE] = np.eye(2)
    return tangent


def changed(views: Views, change: Array) -> Views:
    """The cameras with `change` (V, Q) made to their parameters."""
    cTw = Rotation.from_rotvec(change[:, 0:3]).as_matrix() @ views.cTw
    cTw[:, :, 3] += change[:, 3:6]
    K = views.K.copy()
    K[:, :2, :2] *= np.exp(np.clip(change[:, 8], -_MOST_ZOOM, _MOST_ZOOM))[:, None, None]
    K[:, :2, 2] += change[:, 6:8]
    return Views(K, cTw)
