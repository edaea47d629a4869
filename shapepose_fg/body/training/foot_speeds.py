"""How feet move: the numbers of `estimation.contact`, from recorded people."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.estimation.contact import feet_of

Array = NDArray[np.float64]

START_M_S = (0.03, 0.15, 1.0)
"""Speeds per axis with which the fit begins."""
ROUNDS = 40
LAG = 3
"""Frames over which the correlation of speeds is taken."""


@dataclass(frozen=True)
class FootSpeeds:
    """A hidden Markov model of K ways to move, each a Gaussian on the velocity around 0."""

    speeds_m_s: Array
    """(K,) sigma per axis."""
    first: Array
    """(K,) how often each is."""
    turns: Array
    """(K, K) what each turns into from one frame to the next."""
    correlation_s: Array
    """(K,) how long a speed lasts within each: exp(-t / this) at `LAG` frames."""

    def lasts_s(self, fps: float) -> Array:
        """(K,) how long each lasts in the mean."""
        return 1.0 / (fps * (1.0 - np.diag(self.turns)))


def foot_speeds(motions: Iterable[tuple[Array, float]]) -> FootSpeeds:
    """From BODY_25's joints (T, 25, 3), metres, and frames a second of recordings of one rate: expectation
    maximisation, every joint of a foot a sequence of its own.
    """
    seen = [
        ((joints[2:] - joints[:-2])[:, feet_of(BODY_25.joints)] * fps / 2, fps)
        for joints, fps in motions
        if len(joints) >= 30
    ]
    K, sigma = len(START_M_S), np.array(START_M_S)
    turns, first = np.full((K, K), 0.02) + (1 - 0.02 * K) * np.eye(K), np.full(K, 1 / K)
    lasting = np.zeros(K)
    for _ in range(ROUNDS):
        energy, count, both, pairs, together = (np.zeros(shape) for shape in (K, K, (K, K), K, K))
        for velocity, _ in seen:
            squared = (velocity**2).sum(axis=-1)[..., None]
            log = -3 * np.log(sigma) - 0.5 * squared / sigma**2
            told = np.exp(log - log.max(axis=-1, keepdims=True))
            share, step = _expected(told, first, turns)
            energy += (share * squared).sum(axis=(0, 1)) / 3
            count += share.sum(axis=(0, 1))
            both += step
            stays = share[:-LAG] * share[LAG:]
            pairs += (stays * (velocity[:-LAG] * velocity[LAG:]).sum(axis=-1)[..., None]).sum(axis=(0, 1)) / 3
            together += stays.sum(axis=(0, 1))
        sigma, first = np.sqrt(energy / count), count / count.sum()
        turns = both / both.sum(axis=1, keepdims=True)
        lasting = pairs / together / sigma**2
    return FootSpeeds(sigma, first, turns, -LAG / seen[0][1] / np.log(np.clip(lasting, 1e-3, 0.999)))


def _expected(told: Array, first: Array, turns: Array) -> tuple[Array, Array]:
    """(T, C, K) how probable each way is in each frame of C sequences, and (K, K) how often one turns into which.

    `told` (T, C, K) are densities of what was seen, but for a factor.
    """
    forward, backward = np.empty_like(told), np.ones_like(told)
    forward[0] = first * told[0]
    for t in range(1, len(told)):
        each = forward[t - 1] @ turns * told[t]
        forward[t] = each / each.sum(axis=1, keepdims=True)
    for t in range(len(told) - 2, -1, -1):
        each = (told[t + 1] * backward[t + 1]) @ turns.T
        backward[t] = each / each.sum(axis=1, keepdims=True)
    share = forward * backward
    step = forward[:-1, :, :, None] * turns * (told[1:] * backward[1:])[:, :, None]
    step /= step.sum(axis=(2, 3), keepdims=True)
    return share / share.sum(axis=2, keepdims=True), step.sum(axis=(0, 1))
