"""Whose 2D detections are whose: what stage I and the tracker give, and stage II is solved from."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.detections import Detections


@dataclass(frozen=True)
class Observations:
    """The 2D observations of P people (of one frame or of many)."""

    xy: NDArray[np.float64]
    """(P, J, V, 2) where view v saw joint j of person p, undistorted pixels; 0 where it did not."""
    confidence: NDArray[np.float64]
    """(P, J, V) w_ij of Eq. 1, the detector's score; 0 where the view did not see the joint."""
    initial: NDArray[np.float64]
    """(P, J, 3) X_0: where stage I puts the joints, metres; NaN where it does not know."""
    candidate: NDArray[np.intp] | None = None
    """(P, J, V) which detection of its frame each observation is, -1 where the view did not see the joint; None
    where that is not known."""

    def __post_init__(self) -> None:
        shape = np.shape(self.confidence)
        if np.shape(self.xy) != (*shape, 2) or np.shape(self.initial) != (*shape[:2], 3):
            raise ValueError(
                f"xy must be (P, J, V, 2), confidence (P, J, V), initial (P, J, 3), got {np.shape(self.xy)}, "
                f"{shape}, {np.shape(self.initial)}"
            )

    def __len__(self) -> int:
        return len(self.confidence)

    @property
    def seen(self) -> NDArray[np.bool_]:
        """(P, J, V) whether there is an observation."""
        return self.confidence > 0

    def rows(self, index: NDArray[np.intp]) -> "Observations":
        """Some of the people."""
        candidate = None if self.candidate is None else self.candidate[index]
        return Observations(self.xy[index], self.confidence[index], self.initial[index], candidate)

    @classmethod
    def of(
        cls, candidate: NDArray[np.intp], detections: Detections, initial: NDArray[np.float64]
    ) -> "Observations":
        """The detections `candidate` (P, J, V) of one frame, -1 for none, as observations."""
        seen = candidate >= 0
        xy, confidence = np.zeros((*seen.shape, 2)), np.zeros(seen.shape)
        xy[seen], confidence[seen] = detections.xy[candidate[seen]], detections.confidence[candidate[seen]]
        return cls(xy, confidence, initial, candidate)

    @classmethod
    def concatenate(cls, parts: Sequence["Observations"]) -> "Observations":
        """The people of several frames, one after the other."""
        return cls(
            np.concatenate([part.xy for part in parts]),
            np.concatenate([part.confidence for part in parts]),
            np.concatenate([part.initial for part in parts]),
            np.concatenate([part.candidate for part in parts]) if all(p.candidate is not None for p in parts) else None,
        )
