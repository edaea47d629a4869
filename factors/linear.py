"""Linear factors on any number of variables, such as constant acceleration over four frames."""

from collections.abc import Sequence

import gtsam
import numpy as np
from gtsam import noiseModel
from numpy.typing import ArrayLike, NDArray


def linear_factor(
    keys: ArrayLike,
    matrices: Sequence[ArrayLike],
    measured: ArrayLike = 0.0,
    sigma: ArrayLike = 1.0,
) -> gtsam.LinearContainerFactor:
    """Linear factor on K variables: r = sum_k A_k x_k - z  ~  N(0, diag(sigma²)).

    `keys` (K,) are distinct keys of `Point3` variables, such as positions and velocities of joints,
    or of vectors, such as bodies. `matrices` are the K matrices A_k, (M, 3) each, or as wide as the
    vector; a number stands for that number times the identity of a point. `measured` (M,) is z, or
    one number for all rows; `sigma` (M,), or one number, is in the residual's unit. GTSAM's own
    JacobianFactor takes at most three variables from Python. In a nonlinear graph, the error of a
    linear factor without a linearisation point is always 0; this function sets one. ValueError if
    shapes do not fit or a value is not finite.
    """
    names = np.atleast_1d(np.asarray(keys)).tolist()
    if len(names) == 0 or len(set(names)) < len(names):
        raise ValueError(f"keys must be one or more distinct keys, got {names}")
    if len(matrices) != len(names):
        raise ValueError(f"matrices must be one for each of {len(names)} keys, got {len(matrices)}")
    blocks = [_block(each) for each in matrices]
    rows = len(blocks[0])
    if any(block.ndim != 2 or len(block) != rows for block in blocks):
        raise ValueError(
            f"matrices must be (M, 3), all of as many rows, got {[block.shape for block in blocks]}"
        )
    z, deviation = (np.asarray(each, dtype=np.float64) for each in (measured, sigma))
    for name, value in (("measured", z), ("sigma", deviation)):
        if value.shape not in ((), (rows,)):
            raise ValueError(f"{name} must be a number or ({rows},), got {value.shape}")
    if not all(np.isfinite(each).all() for each in (*blocks, z, deviation)):
        raise ValueError("matrices, measured and sigma must be finite")
    if not (deviation > 0).all():
        raise ValueError(f"sigma must be positive, got {sigma}")
    z, deviation = np.broadcast_to(z, rows), np.broadcast_to(deviation, rows)
    whitened = [block / deviation[:, None] for block in blocks]
    terms, unit = list(zip(names, whitened, strict=True)), noiseModel.Unit.Create(rows)
    linear = jacobian_factor(terms, z / deviation, unit)
    origin = gtsam.Values()
    for key, block in zip(names, blocks, strict=True):
        origin.insert(key, np.zeros(block.shape[1]))
    return gtsam.LinearContainerFactor(linear, origin)


def jacobian_factor(
    terms: list[tuple[int, NDArray[np.float64]]],
    right: NDArray[np.float64],
    model: noiseModel.Diagonal,
) -> gtsam.JacobianFactor:
    """The linear factor sum_k A_k x_k = `right` (M,) of `terms` (key, A_k) on any number of
    variables, for linear graphs.
    """
    # The only constructor in GTSAM's Python interface that takes any number of variables.
    return gtsam.JacobianFactor(gtsam.GaussianConditional(terms, 1, right, model))


def _block(matrix: ArrayLike) -> NDArray[np.float64]:
    found = np.asarray(matrix, dtype=np.float64)
    return found * np.eye(3) if found.ndim == 0 else np.atleast_2d(found)
