"""Tests of joint orders: distances between joints, compared with those of a body.

Distances between a person's joints are compared with those of bodies in many poses and views. They
are relative to the person's size, so that neither unit nor calibration is needed, in 3D and in
images alike.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np

from shapepose_fg.body.fitting.priors import PosePrior
from shapepose_fg.body.model.body_model import BodyModel, BodyParameters
from shapepose_fg.body.model.target_skeletons import BODY_POINTS
from shapepose_fg.core.arrays import Array, Index

_POSES = 1500
"""Number of sampled bodies; means and standard deviations of distances are then known to 3 %."""
_NOISE_M = 0.015
"""Standard deviation of a joint along each axis, m, as of a good detector."""
_OUTLIER, _OUTLIER_SIGMA = 0.1, 1.0
"""Share of outlier distances, and standard deviation of their logarithm: a detector places joints
that it does not find anywhere on the person."""
LIKE_A_BODY = -1.0
"""Minimum fit in images of anything like a body, nats per pair; gowned people at a
table have -1."""


@dataclass(frozen=True)
class _Distances:
    """Log-distances between `BODY_POINTS`, relative to the mean over all pairs of a body."""

    mean: Array
    """(P, P) mean log-distance over poses, builds and views."""
    sigma: Array
    """(P, P) standard deviation of the log-distance over poses, builds and views."""


@cache
def _distances(dimensions: int) -> _Distances:
    """Statistics of distances in 3D (3), or in images of upright cameras (2)."""
    rng = np.random.default_rng(0)
    betas, pose = (
        np.clip(rng.normal(size=(_POSES, 10)), -2, 2),
        PosePrior.default().sample(rng, _POSES),
    )
    body = BodyModel.default().with_keypoints(BODY_POINTS)
    nowhere = np.zeros((_POSES, 3))
    points = body.keypoints(BodyParameters(betas, nowhere, pose, nowhere))
    if dimensions == 2:
        azimuth, elevation = (
            rng.uniform(0, 2 * np.pi, _POSES),
            np.arcsin(rng.uniform(-0.2, 0.85, _POSES)),
        )
        ahead = np.stack([np.sin(azimuth), np.zeros(_POSES), np.cos(azimuth)], axis=1)
        right = np.stack([-np.cos(azimuth), np.zeros(_POSES), np.sin(azimuth)], axis=1)
        up = np.sin(elevation)[:, None] * ahead + np.cos(elevation)[:, None] * np.array(
            [0.0, 1.0, 0.0]
        )
        points = points @ np.stack([right, up], axis=2)
    points = points + _NOISE_M * rng.normal(size=points.shape)
    first, second = np.triu_indices(len(BODY_POINTS), 1)
    squared = sum(np.square(x[first] - x[second]) for x in points.T)  # fast along the poses
    logs = np.log(np.maximum(squared, 1e-18)) / 2
    logs -= logs.mean(axis=0)
    mean, sigma = np.zeros((len(BODY_POINTS),) * 2), np.eye(len(BODY_POINTS))
    for matrix, values in ((mean, logs.mean(axis=1)), (sigma, logs.std(axis=1))):
        matrix[first, second] = matrix[second, first] = values
    return _Distances(mean, sigma)


def fit_of_order(people: Array, points: Sequence[str]) -> Array:
    """(N,) fit of people (N, K, 2 or 3), NaN where not seen, under the order `points` (K) of their
    joints.

    It is the mean log-likelihood of their distances, nats per pair; NaN if too few joints are seen.
    A point not in `BODY_POINTS` may be anywhere. Correct orders mostly have more than -0.5, others
    -1 to -2.
    """
    first, second = np.triu_indices(len(points), 1)
    logs = _logs(people, first, second)
    known = np.array([point in BODY_POINTS for point in points])
    place = np.array([BODY_POINTS.index(point) if point in BODY_POINTS else 0 for point in points])
    both, distances = known[first] & known[second], _distances(people.shape[-1])
    mean = np.where(both, distances.mean[place[first], place[second]], 0.0)
    sigma = np.where(both, distances.sigma[place[first], place[second]], _OUTLIER_SIGMA)
    deviation = np.where(both, logs - mean, np.nan)
    count = np.isfinite(logs).sum(axis=1)
    off = logs - mean - _mean(deviation)[:, None]
    # Minimum number of distances for a person to be informative: seven joints.
    return np.where(count >= 20, _mean(_log_density(off, sigma)), np.nan)


def exchanges(
    people: Array, points: Sequence[str], groups: Sequence[Sequence[tuple[int, int]]]
) -> list[int]:
    """Improve the order `points` (K) of the joints of people (N, K, 2 or 3): the order that fits a
    body better.

    Entry k is the index of the joint that should be `points[k]`. Each step exchanges two joints, or
    one of the `groups` of pairs of joints, whichever gains most; the result is `range(K)` if
    nothing gains.
    """
    count = len(points)
    place = np.array([BODY_POINTS.index(point) for point in points])
    distances = _distances(people.shape[-1])
    first, second = np.triu_indices(count, 1)
    mean, sigma = distances.mean[np.ix_(place, place)], distances.sigma[np.ix_(place, place)]
    logs = _logs(people, first, second)
    logs = logs - _mean(logs - mean[first, second])[:, None]
    # Mean log-likelihood over people if joints k and m of the file are a and b of the body: (k, m,
    # a, b).
    likelihood = np.zeros((count, count, count, count))
    for n, (k, m) in enumerate(zip(first.tolist(), second.tolist(), strict=True)):
        seen = logs[np.isfinite(logs[:, n]), n]
        fit = _log_density(seen[:, None, None] - mean, sigma).sum(axis=0) / max(len(logs), 1)
        likelihood[k, m] = likelihood[m, k] = fit
    order = np.arange(count)
    moves = [[pair] for pair in zip(first.tolist(), second.tolist(), strict=True)] + [
        list(each) for each in groups
    ]

    def total(order: Index) -> float:
        return float(likelihood[order[first], order[second], first, second].sum())

    best = total(order)
    for _ in range(4 * count):
        tried = [_exchanged(order, move) for move in moves]
        values = [total(each) for each in tried]
        n = int(np.argmax(values))
        if values[n] <= best + 1e-9:
            break
        order, best = tried[n], values[n]
    return order.tolist()


def _exchanged(order: Index, pairs: Sequence[tuple[int, int]]) -> Index:
    """The order with each pair of places exchanged."""
    order = order.copy()
    for one, other in pairs:
        order[[one, other]] = order[[other, one]]
    return order


def _logs(people: Array, first: Index, second: Index) -> Array:
    """(N, M) logarithms of the distances of M pairs of joints, NaN if either joint is not seen."""
    length = np.linalg.norm(people[:, first] - people[:, second], axis=-1)
    least = np.exp(_mean(np.log(np.where(length > 0, length, np.nan))))
    # Minimum distance, as a share of the mean distance; limits the effect of joints in one pixel.
    return np.log(np.maximum(length, 0.02 * np.nan_to_num(least, nan=1.0)[:, None]))


def _mean(values: Array) -> Array:
    """(N,) mean of the finite values in each row (N, M); NaN if there are none."""
    known = np.isfinite(values)
    total, count = np.where(known, values, 0.0).sum(axis=1), known.sum(axis=1)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def _log_density(off: Array, sigma: Array) -> Array:
    """Log-density of deviations of log-distances: a Gaussian with a wide outlier component."""
    inside = (1 - _OUTLIER) / sigma * np.exp(-0.5 * (off / sigma) ** 2)
    outside = _OUTLIER / _OUTLIER_SIGMA * np.exp(-0.5 * (off / _OUTLIER_SIGMA) ** 2)
    return np.log(np.maximum((inside + outside) / np.sqrt(2 * np.pi), 1e-6))
