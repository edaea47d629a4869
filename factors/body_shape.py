"""Connects joints to a body whose pose and shape are variables (E_shape of Eq. 3), linearly.

Residual, metres: r = x - joints - by_pose theta - by_shape beta. Pose theta and shape beta are
vectors. The body is linearised around one pose and shape; `joints` are the linear model's joints
where both vectors are zero.
"""

from itertools import repeat

import gtsam
import numpy as np
from gtsam import noiseModel
from numpy.typing import ArrayLike, NDArray

from factors.linear import jacobian_factor


def shape_factors(
    keys: ArrayLike,
    body_keys: ArrayLike,
    shape_key: int,
    joints: ArrayLike,
    by_pose: ArrayLike,
    by_shape: ArrayLike,
    sigma_m: ArrayLike,
) -> list[gtsam.NonlinearFactor]:
    """Make the factors of D joints, metres: r = x - joints - by_pose theta - by_shape beta ~ N(0,
    sigma_m² I), with one standard deviation for all, or (D,).

    `keys` (D,) of the positions, `body_keys` (D,) of their poses, `joints` (D, 3) of the body
    where theta and beta are zero, `by_pose` (D, 3, N) and `by_shape` (D, 3, 10) its derivatives.
    """
    position, pose = np.asarray(keys), np.asarray(body_keys)
    points, to_pose, to_shape = (
        np.asarray(each, dtype=np.float64) for each in (joints, by_pose, by_shape)
    )
    if (
        points.shape != (len(position), 3)
        or to_pose.shape[:2] != points.shape
        or to_shape.shape[:2] != points.shape
    ):
        raise ValueError(
            f"joints must be (D, 3), by_pose (D, 3, N), got {points.shape}, {to_pose.shape}"
        )
    if not all(np.isfinite(each).all() for each in (points, to_pose, to_shape)):
        raise ValueError("a joint or a derivative holds a value that is not finite")
    sigma = np.broadcast_to(np.asarray(sigma_m, dtype=np.float64), position.shape)[:, None]
    eye, unit = np.eye(3) / sigma[..., None], noiseModel.Unit.Create(3)
    linear = map(
        gtsam.JacobianFactor, position.tolist(), eye, pose.tolist(), -to_pose / sigma[..., None],
        repeat(shape_key), -to_shape / sigma[..., None], points / sigma, repeat(unit),
    )  # fmt: skip
    return list(
        map(
            gtsam.LinearContainerFactor,
            linear,
            repeat(_zeros(position, pose, shape_key, to_pose.shape[2])),
        )
    )


def pose_factors(
    body_keys: ArrayLike,
    matrices: list[NDArray[np.float64]],
    right: NDArray[np.float64],
    count: int,
) -> list[gtsam.NonlinearFactor]:
    """Make linear factors on K successive poses: r = sum_k A_k theta_(t+k) - b ~ N(0, I).

    `matrices` are the K matrices A_k, (S, M, N) each, `right` (S, M), of factors that begin at the
    poses `body_keys` (S + K - 1,); `count` is N.
    """
    names, zeros = np.asarray(body_keys).tolist(), gtsam.Values()
    for name in names:
        zeros.insert(name, np.zeros(count))
    unit = noiseModel.Unit.Create(right.shape[1])
    found = list[gtsam.NonlinearFactor]()
    for t, measured in enumerate(right):
        terms = [(names[t + k], each[t]) for k, each in enumerate(matrices)]
        linear = jacobian_factor(terms, measured, unit)
        found.append(gtsam.LinearContainerFactor(linear, zeros))
    return found


def _zeros(
    position: NDArray[np.int64], pose: NDArray[np.int64], shape: int, count: int
) -> gtsam.Values:
    zeros = gtsam.Values()
    for key in np.unique(position).tolist():
        zeros.insert(key, np.zeros(3))
    for key in np.unique(pose).tolist():
        zeros.insert(key, np.zeros(count))
    zeros.insert(shape, np.zeros(10))
    return zeros
