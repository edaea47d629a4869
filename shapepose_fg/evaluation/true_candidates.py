"""The truth's own choice of detections: what any method could make of them, at the most."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.camera import Rig
from shapepose_fg.core.detections import DetectionSequence
from shapepose_fg.core.observations import Observations
from shapepose_fg.evaluation.opponent.giving_out import nearest_given

NEAR_M = 0.12
"""A detection is a true joint's if it lies within this length of its projection, at the joint's depth."""


def true_observations(
    detections: DetectionSequence, rig: Rig, truth: NDArray[np.float64], frames: Sequence[int] | range
) -> Observations:
    """Rows (frame by frame, everybody in `truth` (T, P, J, 3) metres) with the detections that are theirs.

    Of each view the nearest within `NEAR_M`, one-to-one. Where the joints are is not told: X_0 is NaN.
    """
    parts = []
    for frame in frames:
        found, joints = detections[frame], truth[frame]
        nobody = np.full((*joints.shape[:2], len(rig)), -1, dtype=np.intp)
        held = nearest_given(found, joints, nobody, rig, NEAR_M)
        parts.append((frame, Observations.of(held, found, np.full(joints.shape, np.nan))))
    rows = Observations.concatenate([part for _, part in parts])
    frame = np.repeat([frame for frame, _ in parts], [len(part) for _, part in parts])
    return Observations(
        rows.xy, rows.confidence, rows.initial, np.arange(len(rows)), frame, candidate=rows.candidate
    )
