"""Errors that are correlated over time: what a detector gets wrong in one frame it gets wrong in the next.

Everything here is stationary and runs frame by frame from the first one; each frame has its own generator, made of
the seed and the frame's number, so that skipping frames leaves the later ones as they are.
"""

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.simulation.detector_statistics import JOINT_GROUP, DetectorStatistics

Array = NDArray[np.float64]


class NoiseProcess:
    """Seven standard normal processes for every view, person and joint.

    Each is the sum of a fast and a slow AR(1) process and of white noise.
    """

    ERROR_X, ERROR_Y, CONFIDENCE, SCALE, SWAP, CAPTURE, LOST = range(7)

    def __init__(self, views: int, people: int, fps: float, statistics: DetectorStatistics, seed: int) -> None:
        self._seed = seed
        self._shape = (7, 3, views, people, 25)
        memory = np.stack(
            [statistics.error_memory] * 2 + [statistics.confidence_memory] * 4 + [statistics.lost_memory]
        )
        share, seconds = memory[..., 0], memory[..., 1]
        self._keep = np.exp(-1.0 / (fps * seconds))[..., None, None, None]
        self._amplitude = np.sqrt(share)[..., None, None, None]
        self._white = np.sqrt(np.maximum(1.0 - share.sum(axis=1), 0.0))[:, None, None, None]
        correlations = statistics.error_correlation, statistics.confidence_correlation, statistics.lost_correlation
        self._mix = [_root(each) for each in correlations]
        self._state: Array | None = None

    def next(self, frame: int) -> Array:
        """(7, V, P, 25) for `frame`; to be called for every frame, in order."""
        fresh = np.random.default_rng([self._seed, frame, 0]).standard_normal(self._shape)
        fresh[:2] = fresh[:2] @ self._mix[0]
        fresh[self.CONFIDENCE] = fresh[self.CONFIDENCE] @ self._mix[1]
        fresh[self.LOST] = fresh[self.LOST] @ self._mix[2]
        new = fresh[:, :2]
        if self._state is None:
            self._state = new
        else:
            self._state = self._keep * self._state + np.sqrt(1.0 - self._keep**2) * new
        return (self._amplitude * self._state).sum(axis=1) + self._white * fresh[:, 2]


@dataclass(frozen=True)
class Table:
    """Columns of one length."""

    def take(self, index: NDArray) -> Self:
        """The rows at `index`, or where it holds."""
        return type(self)(**{name: value[index] for name, value in vars(self).items()})

    def join(self, other: Self) -> Self:
        """The rows of both."""
        both = {name: np.concatenate([value, vars(other)[name]]) for name, value in vars(self).items()}
        return type(self)(**both)


@dataclass(frozen=True)
class FalseCandidates(Table):
    """False candidates that are there now: F of them."""

    view: NDArray[np.intp]
    person: NDArray[np.intp]
    """The person that it goes with, or -1."""
    anchor: NDArray[np.intp]
    """The joint that it keeps its distance to."""
    joint: NDArray[np.intp]
    """What it claims to be."""
    offset: Array
    """(F, 2) from the anchor in metres, or a place as a share of the image."""
    rank: Array
    """(F,) probability of a lower confidence."""
    stays: Array
    """(F,) probability to be there in the next frame."""


class FalseCandidateProcess:
    """False candidates: some go along with a person, some stay where they are; some flicker, some last."""

    def __init__(
        self, views: int, people: int, fps: float, statistics: DetectorStatistics, seed: int, rate: float
    ) -> None:
        self._views, self._people, self._statistics, self._seed = views, people, statistics, seed
        near, far = statistics.false_near * people * views * rate, statistics.false_far * views * rate
        share, seconds = statistics.false_memory.T
        # A group's share over its members.
        claims = statistics.false_joints[JOINT_GROUP] / np.bincount(JOINT_GROUP)[JOINT_GROUP]
        self._claims = claims / claims.sum()
        self._stays = np.append(np.exp(-1.0 / (fps * seconds)), 0.0)
        # Of those that are there at any time: born as often as they go.
        self._present = np.append(share, max(1.0 - share.sum(), 0.0))[:, None] * np.array([near, far])
        self._present_now: FalseCandidates | None = None

    def next(self, frame: int) -> FalseCandidates:
        """Those of `frame`; to be called for every frame, in order."""
        rng = np.random.default_rng([self._seed, frame, 1])
        if self._present_now is None:
            self._present_now = self._born(rng, self._present)
        else:
            staying = self._present_now.take(rng.random(len(self._present_now.view)) < self._present_now.stays)
            self._present_now = staying.join(self._born(rng, self._present * (1.0 - self._stays)[:, None]))
        return self._present_now

    def _born(self, rng: np.random.Generator, rate: Array) -> FalseCandidates:
        """Poisson counts of `rate` (3, 2): by how long they stay, near people and far from them."""
        kind = np.repeat(np.arange(6), rng.poisson(rate).ravel())
        stays, far = self._stays[kind // 2], kind % 2 == 1
        count = len(kind)
        distance = self._statistics.quantile(self._statistics.false_near_m, rng.random(count))
        angle = rng.uniform(0.0, 2 * np.pi, count)
        around = distance[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        return FalseCandidates(
            view=rng.integers(0, self._views, count),
            person=np.where(far, -1, rng.integers(0, max(self._people, 1), count)),
            anchor=rng.integers(0, 25, count),
            joint=rng.choice(25, count, p=self._claims),
            offset=np.where(far[:, None], rng.random((count, 2)), around),
            rank=rng.random(count),
            stays=stays,
        )


def _root(correlation: Array) -> Array:
    """What independent rows (..., 25) are multiplied with from the right to correlate so; rounding is forgiven."""
    values, vectors = np.linalg.eigh(correlation)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    return (root / np.linalg.norm(root, axis=1, keepdims=True)).T
