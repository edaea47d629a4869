"""Odometry: how far what carries a camera has gone from frame to frame, by wheels, inertia or its own pictures."""

import gtsam
import numpy as np
from gtsam import noiseModel
from numpy.typing import ArrayLike

from factors.noise import check_covariances


def odometry_factors(keys: ArrayLike, wTb: ArrayLike, covariances: ArrayLike) -> list[gtsam.NonlinearFactor]:
    """T - 1 steps between the poses `keys` (T,), `Pose3`, world from carrier, as `wTb` (T, 4, 4) takes them.

    r = Log(measured step^-1 (pose_t^-1 pose_t+1)), turn then way, rad and m along the carrier's own axes, known to
    `covariances` (T - 1, 6, 6). Where the world is in which `wTb` was measured does not matter. ValueError for
    shapes that disagree and covariances that are none.
    """
    key, poses = np.asarray(keys), np.asarray(wTb, dtype=np.float64)
    covariance = np.asarray(covariances, dtype=np.float64)
    count = len(key)
    if poses.shape != (count, 4, 4) or covariance.shape != (max(count - 1, 0), 6, 6):
        raise ValueError(
            f"keys must be (T,), wTb (T, 4, 4), covariances (T - 1, 6, 6), got {key.shape}, {poses.shape}, "
            f"{covariance.shape}"
        )
    check_covariances(covariance)
    steps = map(gtsam.Pose3, np.linalg.inv(poses[:-1]) @ poses[1:])
    models = map(noiseModel.Gaussian.Covariance, covariance)
    return list(map(gtsam.BetweenFactorPose3, key[:-1].tolist(), key[1:].tolist(), steps, models))
