"""Whether an order of joints fits people: how far joints lie from each other, against how far a body's do.

Distances between joints of a person are compared with those of bodies in many poses from many sides. They are
relative to the person's own size, so neither a unit nor a calibration is needed, and in space as in a picture.
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
"""Bodies that are drawn: means and sigmas of distances are then known to 3 per cent."""
_NOISE_M = 0.015
"""Error of a joint along each axis, m: a good detector's."""
_OUTLIER, _OUTLIER_SIGMA = 0.1, 1.0
"""Share of distances that are not a body's, and the sigma of their logarithm: a detector puts a joint that it does
not find anywhere on the person."""
_NEAREST = 0.02
"""Least distance that counts, as a part of the mean distance: joints in one pixel are no nearer."""
LIKE_A_BODY = -1.0
"""Least fit in pictures of what looks like a body at all, nats a pair; gowned people at a table have -1."""
_LEAST_PAIRS = 20
"""With fewer distances a person does not tell an order: seven joints."""


@dataclass(frozen=True)
class _Distances:
    """Logarithms of distances between `BODY_POINTS`, relative to the mean over all pairs of a body."""

    mean: Array
    """(P, P)."""
    sigma: Array
    """(P, P) standard deviation over poses, builds and sides."""


@cache
def _distances(dimensions: int) -> _Distances:
    """Those in space (3), or in pictures of upright cameras (2)."""
    rng = np.random.default_rng(0)
    betas, pose = np.clip(rng.normal(size=(_POSES, 10)), -2, 2), PosePrior.default().sample(rng, _POSES)
    body = BodyModel.default().with_keypoints(BODY_POINTS)
    nowhere = np.zeros((_POSES, 3))
    points = body.keypoints(BodyParameters(betas, nowhere, pose, nowhere))
    if dimensions == 2:
        azimuth, elevation = rng.uniform(0, 2 * np.pi, _POSES), np.arcsin(rng.uniform(-0.2, 0.85, _POSES))
        ahead = np.stack([np.sin(azimuth), np.zeros(_POSES), np.cos(azimuth)], axis=1)
        right = np.stack([-np.cos(azimuth), np.zeros(_POSES), np.sin(azimuth)], axis=1)
        up = np.sin(elevation)[:, None] * ahead + np.cos(elevation)[:, None] * np.array([0.0, 1.0, 0.0])
        points = np.einsum("npx,nyx->npy", points, np.stack([right, up], axis=1))
    points = points + _NOISE_M * rng.normal(size=points.shape)
    apart = np.linalg.norm(points[:, :, None] - points[:, None], axis=-1)
    first, second = np.triu_indices(len(BODY_POINTS), 1)
    logs = np.log(np.maximum(apart, 1e-9))
    logs -= logs[:, first, second].mean(axis=1)[:, None, None]
    sigma = logs.std(axis=0)
    np.fill_diagonal(sigma, 1.0)
    return _Distances(logs.mean(axis=0), sigma)


def fit_of_order(people: Array, points: Sequence[str]) -> Array:
    """(N,) how well people (N, K, 2 or 3), NaN where not seen, fit if their joints are the `points` (K).

    It is the mean log likelihood of their distances, nats a pair; NaN where too few joints are seen. A point that
    is not of `BODY_POINTS` may be anywhere. Right orders have more than -0.5, mostly, and others -1 to -2.
    """
    first, second = np.triu_indices(len(points), 1)
    logs = _logs(people, first, second)
    known = np.array([point in BODY_POINTS for point in points])
    place = np.array([BODY_POINTS.index(point) if point in BODY_POINTS else 0 for point in points])
    both, distances = known[first] & known[second], _distances(people.shape[-1])
    mean = np.where(both, distances.mean[place[first], place[second]], 0.0)
    sigma = np.where(both, distances.sigma[place[first], place[second]], _OUTLIER_SIGMA)
    said = np.where(both, logs - mean, np.nan)
    count = np.isfinite(logs).sum(axis=1)
    off = logs - mean - _mean(said)[:, None]
    return np.where(count >= _LEAST_PAIRS, _mean(_log_density(off, sigma)), np.nan)


def exchanges(people: Array, points: Sequence[str], groups: Sequence[Sequence[tuple[int, int]]]) -> list[int]:
    """The order in which people (N, K, 2 or 3) fit a body better, found from the order of the `points` (K) on.

    Entry k is the place of the joint that `points[k]` should be. Each step exchanges two joints, or one of the
    `groups` of pairs of joints, whichever gains most; it is `range(K)` where none gains.
    """
    count = len(points)
    place = np.array([BODY_POINTS.index(point) for point in points])
    distances = _distances(people.shape[-1])
    first, second = np.triu_indices(count, 1)
    mean, sigma = distances.mean[np.ix_(place, place)], distances.sigma[np.ix_(place, place)]
    logs = _logs(people, first, second)
    logs = logs - _mean(logs - mean[first, second])[:, None]
    # What joints k and m of the file say if they are a and b of the body, mean over people: (k, m, a, b).
    worth = np.zeros((count, count, count, count))
    for n, (k, m) in enumerate(zip(first.tolist(), second.tolist(), strict=True)):
        seen = logs[np.isfinite(logs[:, n]), n]
        said = _log_density(seen[:, None, None] - mean, sigma).sum(axis=0) / max(len(logs), 1)
        worth[k, m] = worth[m, k] = said
    order = np.arange(count)
    moves = [[pair] for pair in zip(first.tolist(), second.tolist(), strict=True)] + [
        list(each) for each in groups
    ]

    def total(order: Index) -> float:
        return float(worth[order[first], order[second], first, second].sum())

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
    """(N, M) logarithms of the distances of M pairs of joints, NaN where one was not seen."""
    apart = np.linalg.norm(people[:, first] - people[:, second], axis=-1)
    least = np.exp(_mean(np.log(np.where(apart > 0, apart, np.nan))))
    return np.log(np.maximum(apart, _NEAREST * np.nan_to_num(least, nan=1.0)[:, None]))


def _mean(values: Array) -> Array:
    """(N,) means over the finite ones of each row (N, M); NaN where there is none."""
    there = np.isfinite(values)
    total, count = np.where(there, values, 0.0).sum(axis=1), there.sum(axis=1)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def _log_density(off: Array, sigma: Array) -> Array:
    """The log density of deviations of logarithms: Gaussian, and some anywhere."""
    inside = (1 - _OUTLIER) / sigma * np.exp(-0.5 * (off / sigma) ** 2)
    outside = _OUTLIER / _OUTLIER_SIGMA * np.exp(-0.5 * (off / _OUTLIER_SIGMA) ** 2)
    return np.log(np.maximum((inside + outside) / np.sqrt(2 * np.pi), 1e-6))
