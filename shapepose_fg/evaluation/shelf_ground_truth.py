"""The annotation of the Shelf recording: its text file, its 15 joints, and how BODY_25 maps to them."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.evaluation.other_results.skeleton_text import SHELF_JOINTS, read_skeleton_text


@dataclass(frozen=True)
class ShelfGroundTruth:
    """Annotated people, one row per person and frame."""

    frame: NDArray[np.int64]
    """(G,) frame of the recording, counted from 0 in the file."""
    actor: NDArray[np.int64]
    """(G,) id as written: 0, 1, 2 are the actors 1, 2, 3; others are not scored."""
    joints: NDArray[np.float64]
    """(G, 15, 3) metres in the world, in the order of `SHELF_JOINTS`."""
    frame_count: int
    """Frames that the file spans, annotated or not."""

    def __post_init__(self) -> None:
        rows = len(self.frame)
        if self.actor.shape != (rows,) or self.joints.shape != (rows, 15, 3):
            raise ValueError(
                f"actor must be (G,) and joints (G, 15, 3) for frame ({rows},), got {self.actor.shape}, "
                f"{self.joints.shape}"
            )


def read_shelf_ground_truth(path: Path | str) -> ShelfGroundTruth:
    """Read annotated people from the text format of the 4D Association Graph's Shelf data.

    InputError that names file and line for a missing, malformed or truncated file.
    """
    text = read_skeleton_text(Path(path), joints=len(SHELF_JOINTS), unknown=False)
    return ShelfGroundTruth(text.frame, text.person, text.joints, text.frame_count)


_SAME_NAME = [BODY_25.index(name) for name in SHELF_JOINTS[:12]]


def shelf_joints(body25: NDArray[np.float64]) -> NDArray[np.float64]:
    """Map BODY_25 joints (N, 25, 3), metres, z up, to Shelf's (N, 15, 3); NaN stays NaN.

    The hips, limbs and MidHip are the joints of the same name. With s and e the middles of shoulders and
    ears, Neck is s + 0.5 (e - s) and HeadTop is Neck + 0.125 f + 0.145 z, f the unit vector of
    (neck - midhip) x (RShoulder - LShoulder). The mapping is fixed: tuning it on the annotation would lift the
    figure in sample only. Where one ear is unknown, e is the other ear brought into the plane halfway between
    the shoulders, which is where the middle of two mirrored ears lies.
    """
    body25 = np.asarray(body25, dtype=np.float64)
    if body25.ndim != 3 or body25.shape[1:] != (25, 3):
        raise ValueError(f"body25 must be (N, 25, 3), got {body25.shape}")
    right, left = body25[:, BODY_25.index("RShoulder")], body25[:, BODY_25.index("LShoulder")]
    shoulders = 0.5 * (right + left)
    midhip = body25[:, BODY_25.index("MidHip")]
    forward = _unit(np.cross(body25[:, BODY_25.index("Neck")] - midhip, right - left))
    result = np.empty((len(body25), 15, 3))
    result[:, :12] = body25[:, _SAME_NAME]
    result[:, 12] = shoulders + 0.5 * (_ear_middle(body25, shoulders, _unit(right - left)) - shoulders)
    result[:, 13] = result[:, 12] + 0.125 * forward + 0.145 * np.array([0.0, 0.0, 1.0])
    result[:, 14] = midhip
    return result


def _ear_middle(
    body25: NDArray[np.float64], shoulders: NDArray[np.float64], across: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Middle of the ears (N, 3); from one ear and its mirror image where the other is unknown."""
    ears = body25[:, [BODY_25.index("REar"), BODY_25.index("LEar")]]
    known = np.isfinite(ears.sum(axis=2))
    single = np.where(known[:, :1], ears[:, 0], ears[:, 1])
    mirrored = single - np.sum((single - shoulders) * across, axis=1, keepdims=True) * across
    return np.where(known.all(axis=1, keepdims=True), ears.mean(axis=1), mirrored)


def _unit(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Vectors (N, 3) of length one; NaN for one of no length."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors / np.where(length > 0, length, np.nan)
