"""What the alternation brings: the errors of the same joints before stage II and after it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.camera import Rig, Views
from shapepose_fg.core.detections import DetectionSequence
from shapepose_fg.core.observations import Observations
from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.estimation.linearisation import triangulate
from shapepose_fg.evaluation.metrics import match_people
from shapepose_fg.pipeline.pipeline import PipelineConfig, find_people


@dataclass(frozen=True)
class BeforeRefinement:
    """What stage I makes of each frame by itself: N rows, one per person and frame."""

    frame: NDArray[np.intp]
    """(N,) frame of each row."""
    joints: NDArray[np.float64]
    """(N, J, 3) X_0 of Algorithm 1, metres; NaN where no two views agree."""
    confidence: NDArray[np.float64]
    """(N, J) mean confidence of the joint's detections over all views, unseen counting 0."""


@dataclass(frozen=True)
class JointErrors:
    """Distance to the truth of M joints of matched people, before and after."""

    confidence: NDArray[np.float64]
    """(M,) mean confidence over all views, before stage II."""
    before_mm: NDArray[np.float64]
    """(M,) distance of X_0 to the truth, millimetres; NaN where stage I does not place the joint."""
    after_mm: NDArray[np.float64]
    """(M,) distance of the final joint to the truth, millimetres; NaN where it is not known."""

    def groups(self, rho_3d: float) -> dict[str, NDArray[np.bool_]]:
        """Masks (M,) of the joints that the views know well, of the doubtful ones (Eq. 4), and of the others."""
        placed = np.isfinite(self.before_mm)
        low = self.confidence < rho_3d
        return {"seen well": placed & ~low, "seen badly": placed & low, "not seen by two views": ~placed}


def before_refinement(
    detections: DetectionSequence, rig: Rig, config: PipelineConfig | None = None
) -> BeforeRefinement:
    """Run stage I alone, and triangulate what it left open."""
    config = PipelineConfig() if config is None else config
    found = [find_people(detections[t], rig, detections.skeleton, config) for t in range(len(detections))]
    frame = np.repeat(np.arange(len(found)), [len(people) for people in found])
    observations = Observations.concatenate(found)
    joints = triangulate(observations, Views.of(rig), config.observations)
    return BeforeRefinement(frame, joints, observations.confidence.mean(axis=-1))


def alternation_errors(
    before: BeforeRefinement, people: Reconstruction, truth: NDArray[np.floating]
) -> JointErrors:
    """Errors before and after, against `truth` (T, P, J, 3) in metres, of people who are found both times.

    Rows are matched with the truth before and after, each by itself: tracking and re-association may have found
    others than stage I did.
    """
    true = np.asarray(truth, dtype=np.float64)
    row = np.full((2, *true.shape[:2]), -1)
    for table, rows in zip(row, (before, people), strict=True):
        matches = match_people(rows.frame, rows.joints, true)
        table[matches.frame, matches.person] = matches.row
    both = (row >= 0).all(axis=0)
    first, last = row[:, both]
    known = np.isfinite(true[both].sum(axis=-1))
    off = (joints - true[both] for joints in (before.joints[first], people.joints[last]))
    before_mm, after_mm = (1e3 * np.linalg.norm(each, axis=-1)[known] for each in off)
    return JointErrors(before.confidence[first][known], before_mm, after_mm)
