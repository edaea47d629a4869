"""What the alternation brings: the errors of the same joints before stage II and after it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.camera import Rig, Views
from shapepose_fg.detections import DetectionSequence
from shapepose_fg.estimation.linearisation import triangulate
from shapepose_fg.evaluation.matching import match_people
from shapepose_fg.observations import Observations
from shapepose_fg.pipeline import PipelineConfig, find_people
from shapepose_fg.reconstruction import Reconstruction


@dataclass(frozen=True)
class BeforeRefinement:
    """What stage I knows of the people that stage II starts from, row by row as in the reconstruction."""

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
    """Run stage I alone. Its rows are those that `reconstruct` makes of the same input and settings."""
    config = PipelineConfig() if config is None else config
    found = [find_people(detections[t], rig, detections.skeleton, config) for t in range(len(detections))]
    observations = Observations.concatenate(found)
    joints = triangulate(observations, Views.of(rig), config.observations)
    return BeforeRefinement(joints, observations.confidence.mean(axis=-1))


def alternation_errors(
    before: BeforeRefinement, people: Reconstruction, truth: NDArray[np.floating]
) -> JointErrors:
    """Errors before and after, against `truth` (T, P, J, 3) in metres; people who match nobody are left out."""
    if before.joints.shape != people.joints.shape:
        raise ValueError(
            f"before and people must be of one recording and one configuration: {before.joints.shape} joints "
            f"before, {people.joints.shape} after"
        )
    matches = match_people(people.frame, people.joints, truth)
    true = np.asarray(truth)[matches.frame, matches.person]
    known = np.isfinite(true).all(axis=-1)

    def error_mm(joints: NDArray[np.float64]) -> NDArray[np.float64]:
        return 1e3 * np.linalg.norm(joints[matches.row] - true, axis=-1)[known]

    return JointErrors(before.confidence[matches.row][known], error_mm(before.joints), error_mm(people.joints))
