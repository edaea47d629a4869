"""Odometry: relative motion of a camera's carrier from frame to frame, by wheels, inertial sensors
or visual odometry.
"""

import gtsam
import numpy as np
from gtsam import noiseModel
from numpy.typing import ArrayLike

from factors.noise import check_covariances


def odometry_factors(
    keys: ArrayLike, wTb: ArrayLike, covariances: ArrayLike
) -> list[gtsam.NonlinearFactor]:
    """T - 1 factors between consecutive poses `keys` (T,), `Pose3`, world from carrier, from the
    odometry `wTb` (T, 4, 4).

    r = Log(step^-1 (pose_t^-1 pose_t+1)), with `step` the measured relative pose; rotation first,
    then translation, rad and m along the carrier's own axes, with `covariances` (T - 1, 6, 6). The
    world frame of `wTb` may be any. ValueError for shapes that disagree and for invalid
    covariances.
    """
    key, poses = np.asarray(keys), np.asarray(wTb, dtype=np.float64)
    covariance = np.asarray(covariances, dtype=np.float64)
    count = len(key)
    if poses.shape != (count, 4, 4) or covariance.shape != (max(count - 1, 0), 6, 6):
        raise ValueError(
            f"keys must be (T,), wTb (T, 4, 4), covariances (T - 1, 6, 6), got {key.shape}, "
            f"{poses.shape}, {covariance.shape}"
        )
    check_covariances(covariance)
    steps = map(gtsam.Pose3, np.linalg.inv(poses[:-1]) @ poses[1:])
    models = map(noiseModel.Gaussian.Covariance, covariance)
    return list(map(gtsam.BetweenFactorPose3, key[:-1].tolist(), key[1:].tolist(), steps, models))
