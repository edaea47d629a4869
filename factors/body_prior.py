"""Prior of a body model on a joint: a native Gaussian prior on its position, with covariance.

Residual, in metres in the world (Eq. 3):

    r = joint - mean
"""

import gtsam
import numpy as np
from gtsam import noiseModel
from numpy.typing import ArrayLike

from factors.noise import Kernel, check_covariances, gaussian, isotropic, robust


def body_prior_factor(
    key: int,
    mean: ArrayLike,
    covariance: ArrayLike | None = None,
    *,
    sigma_m: float | None = None,
    kernel: Kernel | None = None,
) -> gtsam.NoiseModelFactor:
    """Gaussian prior of a body model on the joint `key`, with `mean` (3,), metres in the world.

    Give either its `covariance` (3, 3), metres squared, or one `sigma_m` for all axes.
    """
    if (covariance is None) == (sigma_m is None):
        raise ValueError("give exactly one of covariance and sigma_m")
    point = np.asarray(mean, dtype=np.float64)
    if point.shape != (3,) or not np.isfinite(point).all():
        raise ValueError(f"mean must be three finite metres, got {mean}")
    model = (
        isotropic(3, sigma_m, kernel)
        if sigma_m is not None
        else gaussian(np.asarray(covariance), kernel)
    )
    return gtsam.PriorFactorPoint3(key, point, model)


def body_prior_factors(
    keys: ArrayLike,
    means: ArrayLike,
    covariances: ArrayLike,
    kernel: Kernel | None = None,
) -> list[gtsam.NoiseModelFactor]:
    """One prior for each of D joints: `keys` (D,), `means` (D, 3) metres, `covariances` (D, 3,
    3).
    """
    key_list = np.asarray(keys)
    points = np.asarray(means, dtype=np.float64)
    matrices = np.asarray(covariances, dtype=np.float64)
    count = len(key_list)
    if points.shape != (count, 3) or matrices.shape != (count, 3, 3):
        raise ValueError(
            f"keys must be (D,), means (D, 3), covariances (D, 3, 3), got {key_list.shape}, "
            f"{points.shape}, {matrices.shape}"
        )
    if not np.isfinite(points).all():
        raise ValueError("a mean holds a value that is not finite: give no prior to such a joint")
    check_covariances(matrices)
    make = noiseModel.Gaussian.Covariance
    # GTSAM would check each matrix again; check_covariances has already done it.
    models = [robust(make(matrix), kernel) for matrix in matrices]
    return list(map(gtsam.PriorFactorPoint3, key_list.tolist(), points, models))
