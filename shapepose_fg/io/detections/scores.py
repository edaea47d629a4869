"""Detectors' scores as probabilities: what is not between 0 and 1 is mapped, by one rule for all cameras."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

OVERSHOOT = 1.1
"""Heat maps that are enlarged overshoot a little: scores up to this are cut at 1 without a word."""
_RARE = 0.01
"""Scores are divided by what this share of them exceeds: the highest alone would be decided by one outlier."""
_MOST_LOOKED_AT = 4_000_000
"""Of more scores than this every second, third ... is looked at for that."""
_OCCLUDED = 0.5
"""The score of a keypoint that an annotator marked though it was hidden: COCO's visibility 1 of 2."""


@dataclass
class Scores:
    """What is known of all scores of a recording."""

    count: int = 0
    """How many there are of keypoints that were seen."""
    top: float = 0.0
    """The highest."""
    visibilities: bool = True
    """Whether none is another number than 1 and 2."""

    def add(self, keypoints: NDArray[np.float64]) -> None:
        """Take in keypoints (N, K, 3)."""
        seen = _seen(keypoints)
        self.count += len(seen)
        self.top = max(self.top, float(seen.max(initial=0.0)))
        self.visibilities = self.visibilities and bool(np.isin(seen, (1, 2)).all())


@dataclass(frozen=True)
class ScoreRule:
    """How scores become probabilities."""

    scale: float = 1.0
    """They are divided by it, then cut at 1."""
    visibilities: bool = False
    """They are COCO's instead."""
    note: str | None = None
    """What is said of it; None where they were probabilities before."""

    def applied(self, keypoints: NDArray[np.float64]) -> NDArray[np.float64]:
        """Keypoints (N, K, 3) with scores from 0 to 1."""
        score = keypoints[..., 2]
        if self.visibilities:
            score = np.where(score == 1, _OCCLUDED, score / 2)
        else:
            score = np.minimum(score / self.scale, 1.0)
        return np.concatenate([keypoints[..., :2], score[..., None]], axis=-1)


def as_probabilities(scores: Scores, keypoints: Iterable[NDArray[np.float64]]) -> ScoreRule:
    """The rule for `scores`, which are those of all `keypoints` (N, K, 3), asked for where they matter.

    - COCO's visibilities (only 0, 1 and 2, and a 2 among them): 2 is 1, and 1, hidden, is 0.5.
    - Scores that exceed 1.1: divided by the score that 1 in 100 exceeds, if that is above 1, then cut at 1.
      RTMPose's are heights of two curves and lie mostly under 1; others' are a few units, or per cent.
    """
    if scores.top == 2 and scores.visibilities:
        note = "scores are COCO's visibilities: 2 was read as 1, and 1, a hidden joint, as 0.5"
        return ScoreRule(visibilities=True, note=note)
    if scores.top <= OVERSHOOT:
        return ScoreRule()
    step = -(-scores.count // _MOST_LOOKED_AT)
    looked_at = np.concatenate([_seen(each)[::step] for each in keypoints])
    scale = max(1.0, float(np.quantile(looked_at, 1 - _RARE)))
    divided = f"divided by {scale:.3g}, which 1 in 100 exceeds, and " if scale > 1 else ""
    note = f"scores reach {scores.top:.3g}, so they are no probabilities: they were {divided}cut at 1"
    return ScoreRule(scale, note=note)


def _seen(keypoints: NDArray[np.float64]) -> NDArray[np.float64]:
    """Scores of keypoints that were seen."""
    every = keypoints[..., 2].ravel()
    return every[np.isfinite(every) & (every > 0)]
