"""Tests whether joints are determined, before solving: Levenberg-Marquardt returns without an error
if one is not.

A joint that only one camera sees is not determined along its ray; a joint on the line through two
cameras is not determined along this line. The information of a joint is J^T W J, summed over its
observations and priors, (3, 3) in 1/m².
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from factors.pinhole import project_with_jacobian


def joint_information(
    points_world: ArrayLike,
    joint: ArrayLike,
    view: ArrayLike,
    sigmas_px: ArrayLike,
    K: ArrayLike,
    cTw: ArrayLike,
    prior_information: ArrayLike | None = None,
) -> NDArray[np.float64]:
    """Information matrices (J, 3, 3), in 1/m², of J joints from D observations and the priors.

    Observation d is of `joint[d]` (D,) in `view[d]` (D,) with standard deviation `sigmas_px[d]`
    (D,); `points_world` (J, 3), metres, are the estimated positions; `K` (V, 3, 3) and `cTw` (V, 3,
    4) are the cameras; `prior_information` is (J, 3, 3), zero where a joint has no prior. Joints
    behind a camera are ignored in that view. ValueError if a sigma is not positive and finite.
    """
    points = np.asarray(points_world, dtype=np.float64)
    joints, views = np.asarray(joint, dtype=np.intp), np.asarray(view, dtype=np.intp)
    _, _, jacobian = project_with_jacobian(
        points[joints], np.asarray(K)[views], np.asarray(cTw)[views]
    )
    sigmas = np.asarray(sigmas_px, dtype=np.float64)
    if not np.all((sigmas > 0) & np.isfinite(sigmas)):
        raise ValueError("sigmas_px must be positive and finite: drop observations of no weight")
    jacobian = np.nan_to_num(jacobian) / sigmas[:, None, None]
    information = np.zeros((len(points), 3, 3))
    np.add.at(information, joints, jacobian.transpose(0, 2, 1) @ jacobian)
    return information if prior_information is None else information + np.asarray(prior_information)


def determined(
    information: ArrayLike, *, max_sigma_m: float = 1.0, max_condition: float = 1e10
) -> NDArray[np.bool_]:
    """Which of J joints are determined in all three directions by their `information` (J, 3, 3), in
    1/m².

    Rank 3 in numbers: the standard deviation along the weakest direction is at most `max_sigma_m`,
    and the ratio of the largest to the smallest eigenvalue at most `max_condition`, so that the
    solver's Cholesky factorisation is accurate. A joint without observations, or with NaN, is not
    determined.
    """
    matrices = np.asarray(information, dtype=np.float64)
    unknown = ~np.isfinite(matrices).all(axis=(1, 2), keepdims=True)
    eigenvalues = np.linalg.eigvalsh(np.where(unknown, 0.0, matrices))
    smallest, largest = eigenvalues[:, 0], eigenvalues[:, 2]
    return (smallest > 0) & (smallest >= max_sigma_m**-2) & (largest <= max_condition * smallest)
