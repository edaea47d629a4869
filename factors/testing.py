"""Checks for a factor's test: its Jacobian against a numeric one, and zero error at the truth.

They work for native factors and for `gtsam.CustomFactor`, with Gaussian or robust noise.
"""

import gtsam
import numpy as np
from gtsam import noiseModel
from numpy.typing import NDArray

Factor = gtsam.NoiseModelFactor | gtsam.LinearContainerFactor
"""Types of factors that can be checked."""


def assert_jacobian(
    factor: Factor,
    values: gtsam.Values,
    *,
    step: float = 1e-5,
    rtol: float = 1e-6,
    atol: float = 1e-8,
) -> None:
    """AssertionError unless the factor's Jacobian at `values` equals central differences of its
    error.

    Every variable is perturbed by `step` along each axis of its tangent space (metres, radians).
    Entries may differ by `rtol` of the Jacobian's largest entry plus `atol`; the truncation error
    of a pinhole projection is well below that for points more than 10 cm away. Choose a point at
    which no entry happens to be zero.
    """
    analytic = analytic_jacobian(factor, values)
    numeric = numeric_jacobian(factor, values, step)
    bound = rtol * np.abs(numeric).max(initial=0.0) + atol
    worst = np.abs(analytic - numeric).max(initial=0.0)
    if not worst <= bound:  # NaN fails too
        raise AssertionError(
            f"Jacobian is off by {worst:.3g} (allowed {bound:.3g}); "
            f"analytic\n{analytic}\nnumeric\n{numeric}"
        )


def assert_zero_at_truth(factor: Factor, values: gtsam.Values, *, atol: float = 1e-9) -> None:
    """AssertionError unless the factor's raw residual at `values` is zero to `atol`, in its own
    unit; in standard deviations for a `LinearContainerFactor`, which has no noise model.
    """
    linear = isinstance(factor, gtsam.LinearContainerFactor)
    residual = _of_linear(factor, values) if linear else np.asarray(factor.unwhitenedError(values))
    if not np.all(np.abs(residual) <= atol):
        raise AssertionError(f"residual at the truth is {residual}, not zero to {atol}")


def analytic_jacobian(factor: Factor, values: gtsam.Values) -> NDArray[np.float64]:
    """The analytic Jacobian (residual, tangent) of the factor, whitened by its Gaussian noise, in
    the order of its keys.
    """
    jacobian, right_hand_side = factor.linearize(values).jacobian()
    if isinstance(factor, gtsam.LinearContainerFactor):
        return np.asarray(jacobian)
    model = factor.noiseModel()
    if not isinstance(model, noiseModel.Robust):
        return np.asarray(jacobian)
    # A robust kernel scales Jacobian and residual by the square root of the same weight: undo it.
    whitened = np.linalg.norm(_whitened(factor, values))
    scale = np.linalg.norm(right_hand_side) / whitened if whitened > 0 else 1.0
    if scale == 0.0:
        raise AssertionError(
            "the robust kernel gives this factor no weight: test closer to the truth"
        )
    return np.asarray(jacobian) / scale


def numeric_jacobian(
    factor: Factor, values: gtsam.Values, step: float = 1e-5
) -> NDArray[np.float64]:
    """Central differences of the residual whitened by its Gaussian noise, in the order of the
    factor's keys.
    """
    columns = []
    keys = list(factor.keys())
    for key in keys:
        dimension = len(values.zeroVectors().at(key))
        for axis in range(dimension):
            delta = np.zeros(dimension)
            delta[axis] = step
            ahead = _whitened(factor, _moved(values, key, delta))
            behind = _whitened(factor, _moved(values, key, -delta))
            columns.append((ahead - behind) / (2 * step))
    return np.stack(columns, axis=1)


def _whitened(factor: Factor, values: gtsam.Values) -> NDArray[np.float64]:
    """Residual whitened by the Gaussian noise, without any robust kernel."""
    if isinstance(factor, gtsam.LinearContainerFactor):
        return _of_linear(factor, values)
    residual = np.asarray(factor.unwhitenedError(values))
    model = factor.noiseModel()
    if isinstance(model, noiseModel.Robust):
        model = model.noise()
    return residual if model is None else np.asarray(model.whiten(residual))


def _of_linear(factor: gtsam.LinearContainerFactor, values: gtsam.Values) -> NDArray[np.float64]:
    """Whitened residual of a linear factor; AssertionError if it does not agree with the factor's
    error.
    """
    residual = -np.asarray(factor.linearize(values).jacobian()[1])
    if not np.isclose(factor.error(values), residual @ residual / 2, rtol=1e-9, atol=1e-12):
        raise AssertionError(
            "the factor has no point of linearisation, and so no error: make it with linear_factor"
        )
    return residual


def _moved(values: gtsam.Values, key: int, delta: NDArray[np.float64]) -> gtsam.Values:
    """Return the values with one variable moved by `delta` in its tangent space."""
    step = values.zeroVectors()
    step.update(_single(key, delta))
    return values.retract(step)


def _single(key: int, delta: NDArray[np.float64]) -> gtsam.VectorValues:
    vector = gtsam.VectorValues()
    vector.insert(key, delta)
    return vector
