"""Noise models: standard deviations in pixels from confidence and distance, and robust kernels by
name.

Every factor here keeps its residual raw (pixels, metres) and its weight in the noise model. GTSAM
applies a robust kernel to the *whitened* residual, so a kernel's width is in standard deviations,
whatever the unit of the residual.
"""

from itertools import repeat
from typing import Literal

import numpy as np
from gtsam import noiseModel
from numpy.typing import ArrayLike, NDArray

KernelName = Literal["huber", "cauchy", "geman_mcclure", "tukey"]
"""Robust kernels. The weight falls as 1/r (huber), 1/r² (cauchy), 1/r⁴ (geman_mcclure), or to 0
(tukey)."""

Kernel = noiseModel.mEstimator.Base
"""Type of the argument `kernel`: any of GTSAM's M-estimators. One object may be shared by many
factors."""

ESTIMATORS = {
    "huber": noiseModel.mEstimator.Huber,
    "cauchy": noiseModel.mEstimator.Cauchy,
    "geman_mcclure": noiseModel.mEstimator.GemanMcClure,
    "tukey": noiseModel.mEstimator.Tukey,
}

DEFAULT_WIDTH_SIGMA: dict[str, float] = {
    "huber": 1.50,
    "cauchy": 2.55,
    "geman_mcclure": 4.10,
    "tukey": 5.12,
}
"""Width of each kernel, in standard deviations, that keeps 95 % of the efficiency of least
squares if the pixel residual (two dimensions) is in fact Gaussian; the usual tables are for one
dimension."""


def robust_kernel(name: KernelName | None, width_sigma: float | None = None) -> Kernel | None:
    """Make the robust kernel called `name`, or None for plain least squares.

    `width_sigma` is the whitened residual norm, in standard deviations, above which residuals are
    downweighted (the kernel's parameter); None means `DEFAULT_WIDTH_SIGMA`. Huber is convex; the
    others need a start near the solution.
    """
    if name is None:
        return None
    if name not in ESTIMATORS:
        raise ValueError(f"kernel must be one of {', '.join(ESTIMATORS)} or None, got {name!r}")
    width = DEFAULT_WIDTH_SIGMA[name] if width_sigma is None else float(width_sigma)
    if not (np.isfinite(width) and width > 0):
        raise ValueError(f"width_sigma must be positive, got {width_sigma}")
    return ESTIMATORS[name].Create(width)


def kernel_weight(
    name: KernelName | None, whitened_norm: ArrayLike, width_sigma: float | None = None
) -> NDArray[np.float64]:
    """Weight (...,) of the kernel for residuals with this `whitened_norm` (...,); 1 for a norm of
    0.

    It is the weight of the squared residual when GTSAM linearises a robust factor.
    """
    r = np.asarray(whitened_norm, dtype=np.float64)
    if name is None:
        return np.ones_like(r)
    robust_kernel(
        name, width_sigma
    )  # raises ValueError for an unknown name or a width that is not positive
    width = DEFAULT_WIDTH_SIGMA[name] if width_sigma is None else float(width_sigma)
    ratio = (r / width) ** 2
    if name == "huber":
        return 1.0 / np.sqrt(np.maximum(ratio, 1.0))
    if name == "cauchy":
        return 1.0 / (1.0 + ratio)
    if name == "geman_mcclure":
        return 1.0 / (1.0 + ratio) ** 2
    return np.maximum(1.0 - ratio, 0.0) ** 2  # tukey


def sigma_px(
    confidence: ArrayLike,
    depth_m: ArrayLike,
    focal_px: ArrayLike,
    *,
    sigma_m: float = 0.02,
    floor_px: ArrayLike = 1.0,
) -> NDArray[np.float64]:
    """Standard deviation, in pixels, of detections with `confidence` of joints at `depth_m`.

    sigma = sqrt(floor_px² + (sigma_m · focal_px / depth_m)²) / sqrt(confidence)

    A detector places a joint on a body to within `sigma_m` metres, so the error in pixels scales
    with the size of the person in the image; `floor_px` is the error that the detector's grid adds
    at any size. The confidence multiplies the squared error, as w_ij does in Eq. 1 of the paper.
    The arrays broadcast against each other. ValueError if a confidence, depth or focal length is
    not positive: gate such observations out first.
    """
    w, depth, focal = (
        np.asarray(value, dtype=np.float64) for value in (confidence, depth_m, focal_px)
    )
    for name, value in (("confidence", w), ("depth_m", depth), ("focal_px", focal)):
        if not np.all((value > 0) & np.isfinite(value)):
            raise ValueError(f"{name} must be positive and finite: drop observations of no weight")
    return np.hypot(floor_px, sigma_m * focal / depth) / np.sqrt(w)


def isotropic(dimension: int, sigma: float, kernel: Kernel | None = None) -> noiseModel.Base:
    """Noise with the same standard deviation on every axis; `sigma` in the residual's unit."""
    if not (np.isfinite(sigma) and sigma > 0):
        raise ValueError(f"sigma must be positive, got {sigma}")
    return robust(noiseModel.Isotropic.Sigma(dimension, float(sigma)), kernel)


def diagonal(sigmas: ArrayLike, kernel: Kernel | None = None) -> noiseModel.Base:
    """Noise with one standard deviation per axis; `sigmas` (N,) in the residual's unit."""
    values = np.asarray(sigmas, dtype=np.float64)
    if values.ndim != 1 or not np.all((values > 0) & np.isfinite(values)):
        raise ValueError(f"sigmas must be (N,), positive and finite, got {sigmas}")
    return robust(noiseModel.Diagonal.Sigmas(values), kernel)


def gaussian(covariance: ArrayLike, kernel: Kernel | None = None) -> noiseModel.Base:
    """Noise with a full covariance (N, N), in the residual's unit squared.

    ValueError if it is not symmetric positive definite: GTSAM would continue with NaN.
    """
    matrix = np.asarray(covariance, dtype=np.float64)
    check_covariances(matrix[None])
    return robust(noiseModel.Gaussian.Covariance(matrix), kernel)


def robust(base: noiseModel.Base, kernel: Kernel | None) -> noiseModel.Base:
    """Wrap a Gaussian noise model in the robust `kernel`; None returns the model itself."""
    return base if kernel is None else noiseModel.Robust.Create(kernel, base)


def isotropic_models(
    dimension: int, sigmas: ArrayLike, kernel: Kernel | None = None
) -> list[noiseModel.Base]:
    """One isotropic noise model for each of `sigmas` (D,): `isotropic` for an array."""
    values = np.asarray(sigmas, dtype=np.float64)
    if values.ndim != 1 or not np.all((values > 0) & np.isfinite(values)):
        raise ValueError("sigmas must be (D,), positive and finite: drop observations of no weight")
    models: list[noiseModel.Base] = list(
        map(noiseModel.Isotropic.Sigma, repeat(dimension), values.tolist())
    )
    return models if kernel is None else list(map(noiseModel.Robust.Create, repeat(kernel), models))


def check_covariances(covariances: NDArray[np.float64]) -> None:
    """Raise ValueError unless every one of `covariances` (D, N, N) is finite, symmetric and
    positive definite.
    """
    if covariances.ndim != 3 or covariances.shape[1] != covariances.shape[2]:
        raise ValueError(f"covariances must be square matrices (D, N, N), got {covariances.shape}")
    if not np.isfinite(covariances).all():
        raise ValueError("a covariance holds a value that is not finite")
    scale = np.abs(covariances).max(axis=(1, 2), initial=0.0)
    skew = np.abs(covariances - covariances.transpose(0, 2, 1)).max(axis=(1, 2), initial=0.0)
    # Symmetry is tested up to rounding errors; the Cholesky factorisation reads only one triangle.
    if np.any(skew > 1e-9 * scale):
        raise ValueError(
            f"covariance {np.argmax(skew > 1e-9 * scale)} is not symmetric: give (C + Cᵀ) / 2"
        )
    try:
        np.linalg.cholesky(covariances)
    except np.linalg.LinAlgError:
        smallest = np.linalg.eigvalsh(covariances)[:, 0]
        raise ValueError(
            f"covariance {smallest.argmin()} is not positive definite: add a small variance to "
            "its diagonal"
        ) from None
