"""A Gaussian mixture that is its own mirror image, learnt from rows with gaps by expectation maximisation."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
_Group = tuple[NDArray[np.intp], Mask]
"""Rows that have the same gaps, and which values they have."""


@dataclass(frozen=True)
class Mixture:
    """K Gaussians in D dimensions."""

    weights: Array
    """(K,) share of each, 1 in all."""
    means: Array
    """(K, D)."""
    covariances: Array
    """(K, D, D)."""

    def log_density(self, values: Array, seen: Mask) -> Array:
        """Log density (N,) of what was `seen` (N, D) of the rows `values` (N, D), nats."""
        return np.logaddexp.reduce(_log_densities(values, _groups(seen), self) + np.log(self.weights), axis=1)


@dataclass(frozen=True)
class Mirror:
    """What a mirror does to a row: value d becomes `sign[d] * row[order[d]]`."""

    order: NDArray[np.intp]
    """(D,) a permutation that is its own inverse."""
    sign: Array
    """(D,) 1 or -1, the same for both of a pair."""

    def rows(self, values: Array) -> Array:
        """Mirrored rows (..., D)."""
        return values[..., self.order] * self.sign

    def seen(self, mask: Mask) -> Mask:
        """Which values of the mirrored rows are seen (..., D)."""
        return mask[..., self.order]

    def covariances(self, matrices: Array) -> Array:
        """Covariances (..., D, D) of the mirrored rows."""
        return matrices[..., self.order[:, None], self.order] * np.outer(self.sign, self.sign)


@dataclass(frozen=True)
class MixtureConfig:
    """Settings of `fit_mixture`."""

    components: int = 1
    """K: 1, or an even number, for every component comes with its mirror image."""
    shrink: float = 300.0
    """Weight of rows with which each covariance is drawn to the mean of all of them."""
    iterations: int = 40
    """Rounds of expectation maximisation."""

    def __post_init__(self) -> None:
        if self.components != 1 and (self.components < 2 or self.components % 2):
            raise ValueError(f"components must be 1 or even, got {self.components}")


def fit_mixture(
    values: Array, seen: Mask, weight: Array, mirror: Mirror, config: MixtureConfig, rng: np.random.Generator
) -> Mixture:
    """The mixture under which rows and their mirror images are likely.

    Component k and its mirror image k' share parameters, so that k' at a row is k at the mirrored row: half of
    the components are fitted, to the rows and their mirror images, with responsibilities normalised over both.

    Parameters
    ----------
    values, seen: (N, D) rows and which of their values are known.
    weight: (N,) how much each row counts.
    mirror: the symmetry.
    config: settings.
    rng: draws the first means.
    """
    rows = np.concatenate([values, mirror.rows(values)])
    known = np.concatenate([seen, mirror.seen(seen)])
    count = np.concatenate([weight, weight])
    one, groups = _pooled(rows, known, count), _groups(known)
    if config.components > 1:
        one = _seeded(rows, known, count, one, config.components // 2, rng)
    for _ in range(config.iterations):
        share = count[:, None]  # a single component is its own mirror image
        if config.components > 1:
            share = share * _responsibilities(rows, groups, one)
        one = _maximise(rows, groups, share, one, config.shrink)
    if config.components == 1:
        return one
    return Mixture(
        np.concatenate([one.weights, one.weights]) / 2,
        np.concatenate([one.means, mirror.rows(one.means)]),
        np.concatenate([one.covariances, mirror.covariances(one.covariances)]),
    )


def _pooled(rows: Array, known: Mask, count: Array) -> Mixture:
    """One Gaussian with the variances of all rows; what is never known keeps zero mean."""
    total = np.maximum(count @ known, 1e-12)
    mean = (count @ (rows * known)) / total
    variance = (count @ (np.square(rows - mean) * known)) / total
    return Mixture(np.ones(1), mean[None], np.diag(variance + 1e-4)[None])


def _seeded(
    rows: Array, known: Mask, count: Array, pooled: Mixture, components: int, rng: np.random.Generator
) -> Mixture:
    """Means far apart (k-means++ on whitened rows), covariances of the whole."""
    scale = np.sqrt(np.diagonal(pooled.covariances[0]))
    filled = np.where(known, rows, pooled.means[0]) / scale
    chosen, nearest = [int(rng.choice(len(rows), p=count / count.sum()))], np.full(len(rows), np.inf)
    for _ in range(components - 1):
        nearest = np.minimum(nearest, np.square(filled - filled[chosen[-1]]).sum(axis=1))
        chance = nearest * count
        chosen.append(int(rng.choice(len(rows), p=chance / chance.sum())))
    covariance = pooled.covariances[0] / components ** (2 / 8)  # smaller parts are narrower, about 8 ways to move
    return Mixture(
        np.full(components, 1 / components),
        filled[chosen] * scale,
        np.repeat(covariance[None], components, axis=0),
    )


def _responsibilities(rows: Array, groups: list[_Group], mixture: Mixture) -> Array:
    """Share (2 N, K) of each component in each row; a row and its mirror image have 1 in all."""
    density = _log_densities(rows, groups, mixture) + np.log(mixture.weights)
    half = len(rows) // 2
    total = np.logaddexp.reduce(np.concatenate([density[:half], density[half:]], axis=1), axis=1)
    return np.exp(density - np.concatenate([total, total])[:, None])


def _log_densities(values: Array, groups: list[_Group], mixture: Mixture) -> Array:
    """Log density (N, K) of what is seen of every row under every component."""
    result = np.empty((len(values), len(mixture.weights)))
    for rows, known in groups:
        for k, (mean, covariance) in enumerate(zip(mixture.means, mixture.covariances, strict=True)):
            factor = np.linalg.cholesky(covariance[np.ix_(known, known)])
            white = solve_triangular(factor, (values[np.ix_(rows, known)] - mean[known]).T, lower=True)
            log_det = np.log(np.diagonal(factor)).sum() + 0.5 * len(factor) * np.log(2 * np.pi)
            result[rows, k] = -0.5 * np.square(white).sum(axis=0) - log_det
    return result


def _maximise(rows: Array, groups: list[_Group], share: Array, old: Mixture, shrink: float) -> Mixture:
    """Weights, means and covariances given each component's `share` (2 N, K) of every row."""
    K, D = old.means.shape
    first, second = np.zeros((K, D)), np.zeros((K, D, D))
    for index, seen in groups:
        gap = ~seen
        for k in range(K):
            filled, S, part = rows[index], old.covariances[k], share[index, k]
            if gap.any():
                gain = np.linalg.solve(S[np.ix_(seen, seen)], S[np.ix_(seen, gap)]).T
                filled[:, gap] = old.means[k, gap] + (filled[:, seen] - old.means[k, seen]) @ gain.T
                second[k][np.ix_(gap, gap)] += part.sum() * (S[np.ix_(gap, gap)] - gain @ S[np.ix_(seen, gap)])
            first[k] += part @ filled
            second[k] += (filled * part[:, None]).T @ filled
    total = np.maximum(share.sum(axis=0), 1e-9)
    means = first / total[:, None]
    scatter = second - total[:, None, None] * means[:, :, None] * means[:, None]
    common = scatter.sum(axis=0) / total.sum()
    covariances = (scatter + shrink * common) / (total + shrink)[:, None, None] + 1e-6 * np.eye(D)
    return Mixture(total / total.sum(), means, (covariances + covariances.swapaxes(1, 2)) / 2)


def _groups(seen: Mask) -> list[_Group]:
    """Rows that have the same gaps, and which values they have."""
    patterns, place = np.unique(seen, axis=0, return_inverse=True)
    return [(np.flatnonzero(place.ravel() == index), known) for index, known in enumerate(patterns)]
