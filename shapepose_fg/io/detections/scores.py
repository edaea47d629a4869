"""Detectors' scores as probabilities: what is not between 0 and 1 is mapped, by one rule for all cameras."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

_OVERSHOOT = 1.1
"""Heat maps that are enlarged overshoot a little: scores up to this are cut at 1 without a word."""
_RARE = 0.01
"""Scores are divided by what this share of them exceeds: the highest alone would be decided by one outlier."""
_OCCLUDED = 0.5
"""The score of a keypoint that an annotator marked though it was hidden: COCO's visibility 1 of 2."""


def as_probabilities(views: Sequence[NDArray[np.float64]]) -> tuple[list[NDArray[np.float64]], str | None]:
    """Keypoints (N, K, 3) of all cameras with scores from 0 to 1, and a sentence where they were no such before.

    - COCO's visibilities (only 0, 1 and 2, and a 2 among them): 2 is 1, and 1, hidden, is 0.5.
    - Scores that exceed 1.1: divided by the score that 1 in 100 exceeds, if that is above 1, then cut at 1.
      RTMPose's are heights of two curves and lie mostly under 1; others' are a few units, or per cent.
    """
    every = np.concatenate([view[..., 2].ravel() for view in views])
    seen = every[np.isfinite(every) & (every > 0)]
    top = float(seen.max(initial=0.0))
    if top == 2 and np.isin(seen, (1, 2)).all():
        note = "scores are COCO's visibilities: 2 was read as 1, and 1, a hidden joint, as 0.5"
        return [_with(view, np.where(view[..., 2] == 1, _OCCLUDED, view[..., 2] / 2)) for view in views], note
    scale = 1.0
    note = None
    if top > _OVERSHOOT:
        scale = max(1.0, float(np.quantile(seen, 1 - _RARE)))
        divided = f"divided by {scale:.3g}, which 1 in 100 exceeds, and " if scale > 1 else ""
        note = f"scores reach {top:.3g}, so they are no probabilities: they were {divided}cut at 1"
    return [_with(view, np.minimum(view[..., 2] / scale, 1.0)) for view in views], note


def _with(keypoints: NDArray[np.float64], scores: NDArray[np.float64]) -> NDArray[np.float64]:
    """The same keypoints with other scores."""
    return np.concatenate([keypoints[..., :2], scores[..., None]], axis=-1)
