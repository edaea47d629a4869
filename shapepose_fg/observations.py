"""Whose 2D detections are whose: what stage I and the tracker give, and stage II is solved from."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Observations:
    """The 2D observations of P people (of one frame or of many)."""

    xy: NDArray[np.float64]
    """(P, J, V, 2) where view v saw joint j of person p, undistorted pixels; 0 where it did not."""
    confidence: NDArray[np.float64]
    """(P, J, V) w_ij of Eq. 1, the detector's score; 0 where the view did not see the joint."""
    initial: NDArray[np.float64]
    """(P, J, 3) X_0: where stage I puts the joints, metres; NaN where it does not know."""

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
        return Observations(self.xy[index], self.confidence[index], self.initial[index])

    @classmethod
    def concatenate(cls, parts: Sequence["Observations"]) -> "Observations":
        """The people of several frames, one after the other."""
        return cls(
            np.concatenate([part.xy for part in parts]),
            np.concatenate([part.confidence for part in parts]),
            np.concatenate([part.initial for part in parts]),
        )
