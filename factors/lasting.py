"""Measurements with temporally correlated errors.

Native factors only, all linear. Time steps may be of any length.

A measurement that is repeated in every frame with the same error adds no information. The error of
a measurement (m_t, C_t) of a joint is therefore split into a part that is independent in each frame
and a correlated part: an Ornstein-Uhlenbeck process b_t, in units of standard deviations. With R_t
the symmetric square root of the information, R_t C_t R_t = I, and w the white (independent) share
of the variance:

    r = R_t (x_t - m_t) - sqrt(1 - w) P_t b_t  ~  N(0, w I)
    r = b' - a b  ~  N(0, (1 - a²) I),  a = exp(-dt / correlation_s),  b_0 ~ N(0, I)

P_t = R_t R_t^+ projects on the range of R_t. It is the identity, except for a measurement by one
ray: this constrains neither the joint nor the offset along the ray.
"""

from itertools import pairwise, repeat

import gtsam
import numpy as np
from gtsam import noiseModel
from numpy.typing import ArrayLike, NDArray

from factors.motion import contained, rise


def offset_factors(
    offset_keys: ArrayLike, times_s: ArrayLike, correlation_s: float
) -> list[gtsam.NonlinearFactor]:
    """Process of offsets b_t: a unit prior on the first, then T - 1 links with the time constant
    `correlation_s`.
    """
    times, keys = np.asarray(times_s, dtype=np.float64), np.asarray(offset_keys)
    if keys.shape != times.shape or times.ndim != 1 or not rise(times):
        raise ValueError(
            f"offset_keys and times_s must be (T,), times finite and rising; got {keys.shape}, "
            f"{times.shape}"
        )
    if not (np.isfinite(correlation_s) and correlation_s > 0):
        raise ValueError(f"correlation_s must be positive, got {correlation_s}")
    kept = np.exp(-np.diff(times) / correlation_s)
    scale = 1.0 / np.sqrt(-np.expm1(-2.0 * np.diff(times) / correlation_s))
    unit, zero, eye = noiseModel.Unit.Create(3), np.zeros(3), np.eye(3)
    links = [
        gtsam.JacobianFactor(key, -a * s * eye, after, s * eye, zero, unit)
        for (key, after), a, s in zip(
            pairwise(keys.tolist()), kept.tolist(), scale.tolist(), strict=True
        )
    ]
    first = [gtsam.PriorFactorPoint3(key, zero, unit) for key in keys[:1].tolist()]
    return [*first, *contained(links, keys)]


def lasting_prior_factors(
    keys: ArrayLike, offset_keys: ArrayLike, means: ArrayLike, roots: ArrayLike, white_share: float
) -> list[gtsam.NonlinearFactor]:
    """Factors of D measurements with correlated errors: positions `keys` (D,), `means` (D, 3) in
    metres, and offsets `offset_keys` (D,).

    A joint may have several measurements, with a common offset or one for each.

    `roots` (D, 3, 3), 1/m, are the symmetric square roots of the measurements' information (of the
    whole error); they may be singular (a ray). `white_share`, between 0 and 1, is the share of the
    error's variance that is independent in each frame.
    """
    points, whiten = np.asarray(means, dtype=np.float64), np.asarray(roots, dtype=np.float64)
    positions, offsets = np.asarray(keys), np.asarray(offset_keys)
    count = len(positions)
    if not (
        offsets.shape == (count,) and points.shape == (count, 3) and whiten.shape == (count, 3, 3)
    ):
        raise ValueError(
            "keys and offset_keys must be (D,), means (D, 3), roots (D, 3, 3), got "
            f"{positions.shape}, {offsets.shape}, {points.shape}, {whiten.shape}"
        )
    if not (np.isfinite(points).all() and np.isfinite(whiten).all()):
        raise ValueError(
            "a mean or a root holds a value that is not finite: give no prior to such a joint"
        )
    if not 0 < white_share < 1:
        raise ValueError(f"white_share must be between 0 and 1, got {white_share}")
    scaled, of_offsets, right = lasting_blocks(points, whiten, white_share)
    linear = map(
        gtsam.JacobianFactor, positions.tolist(), scaled, offsets.tolist(), of_offsets, right,
        repeat(noiseModel.Unit.Create(3)),
    )  # fmt: skip
    return contained(linear, np.concatenate([positions, offsets]))


def lasting_blocks(
    means: NDArray[np.float64], roots: NDArray[np.float64], white_share: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Whitened blocks of `lasting_prior_factors`: r = A x + B b - c, with A and B (D, 3, 3) and c
    (D, 3).
    """
    scaled = roots / np.sqrt(white_share)
    of_offsets = -np.sqrt((1.0 - white_share) / white_share) * _projectors(roots)
    return scaled, of_offsets, (scaled @ means[..., None])[..., 0]


def lasting_difference_factors(
    keys: ArrayLike,
    of_keys: ArrayLike,
    offset_keys: ArrayLike,
    differences: ArrayLike,
    covariances: ArrayLike,
    white_share: float,
) -> list[gtsam.NonlinearFactor]:
    """D measured differences of positions, `keys` (D,) minus `of_keys` (D,): `differences` (D, 3),
    metres, with correlated errors. These have `covariances` (D, 3, 3), positive definite, m², of
    which the share `white_share` is independent in each frame.

        r = R (y - x - d) - sqrt(1 - w) b  ~  N(0, w I),

        with R the symmetric root of the information.
    """
    difference, shape = np.asarray(differences, dtype=np.float64), np.shape(keys)
    values, vectors = np.linalg.eigh(np.asarray(covariances, dtype=np.float64))
    if not (
        shape
        == np.shape(of_keys)
        == np.shape(offset_keys)
        == difference.shape[:1]
        == values.shape[:1]
    ):
        raise ValueError(
            "keys, of_keys and offset_keys must be (D,), differences (D, 3), covariances (D, 3, 3)"
        )
    if not (np.isfinite(difference).all() and (values > 0).all()):
        raise ValueError("differences must be finite and covariances positive definite")
    if not 0 < white_share < 1:
        raise ValueError(f"white_share must be between 0 and 1, got {white_share}")
    scaled = (vectors / np.sqrt(white_share * values)[:, None]) @ vectors.mT
    right, every = (
        (scaled @ difference[..., None])[..., 0],
        [np.asarray(each) for each in (keys, of_keys, offset_keys)],
    )
    reported, of, offsets = (each.tolist() for each in every)
    of_offset = repeat(-np.sqrt((1.0 - white_share) / white_share) * np.eye(3))
    unit = repeat(noiseModel.Unit.Create(3))
    linear = map(
        gtsam.JacobianFactor, reported, scaled, of, -scaled, offsets, of_offset, right, unit
    )
    return contained(linear, np.concatenate(every))


def _projectors(matrices: NDArray[np.float64]) -> NDArray[np.float64]:
    """R R^+ of each R (D, 3, 3): the projectors on their ranges, the identity exactly where R has
    full rank.

    Singular values below 1e-5 of the largest are treated as rounding errors: R is the root of an
    information matrix with relative errors of 1e-10.
    """
    projectors = np.tile(np.eye(3), (len(matrices), 1, 1))
    # The determinant over the trace cubed is less than the smallest singular value over the
    # largest.
    open_ones = np.linalg.det(matrices) <= 1e-5 * np.trace(matrices, axis1=1, axis2=2) ** 3
    left, values, _ = np.linalg.svd(matrices[open_ones])
    ranged = left * (values > 1e-5 * values[:, :1])[:, None]
    full = (values[:, 2] > 1e-5 * values[:, 0])[:, None, None]
    projectors[open_ones] = np.where(full, np.eye(3), ranged @ ranged.swapaxes(1, 2))
    return projectors
