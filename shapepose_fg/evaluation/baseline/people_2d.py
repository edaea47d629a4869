"""Who is in each picture: candidates grouped by their part affinities, greedily, as OpenPose does."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.camera import Rig
from shapepose_fg.core.detections import Detections
from shapepose_fg.proposal.people_2d import group_people


@dataclass(frozen=True)
class People2D:
    """The S people that the views of one frame see, each in one view."""

    found: Detections
    """What they are made of."""
    held: NDArray[np.intp]
    """(S, J) which detection is each joint; -1 for none."""

    def __len__(self) -> int:
        return len(self.held)

    @property
    def view(self) -> NDArray[np.intp]:
        """(S,) which view."""
        return self.found.view[self.held.max(axis=1)]

    @property
    def confidence(self) -> NDArray[np.float64]:
        """(S, J) the detector's scores; 0 where there is none."""
        return np.where(self.held >= 0, self.found.confidence[self.held], 0.0)

    def rays(self, rig: Rig) -> NDArray[np.float64]:
        """(S, J, 3) directions in the world from the cameras to the joints, of length one; 0 for none."""
        return np.where((self.held >= 0)[..., None], rig.rays(self.found.view, self.found.xy)[self.held], 0.0)


def people_in_views(found: Detections, joints: int, min_joints: int) -> People2D:
    """Group the candidates of one frame; groups of fewer than `min_joints` of the `joints` are left out."""
    groups = [members for members in group_people(found) if len(members) >= min_joints]
    held = np.full((len(groups), joints), -1, dtype=np.intp)
    for place, members in enumerate(groups):
        held[place, found.joint[members]] = members
    return People2D(found, held)


def sure_enough(found: Detections, min_confidence: float, min_affinity: float) -> Detections:
    """The candidates that are at least so sure, and the pairs of at least this affinity."""
    sure = found.only(found.confidence >= min_confidence)
    kept = sure.affinity >= min_affinity
    return Detections(sure.view, sure.joint, sure.xy, sure.confidence, sure.pairs[kept], sure.affinity[kept])
