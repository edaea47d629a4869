"""Whose 2D detections are whose: what stage I and the tracker give, and stage II is solved from."""

from collections.abc import Sequence
from dataclasses import dataclass, field, fields

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.detections import Detections


@dataclass(frozen=True)
class Observations:
    """The 2D observations of N rows: a row is one person (track) in one frame."""

    xy: NDArray[np.float64]
    """(N, J, V, 2) where view v saw joint j of the person, undistorted pixels; 0 where it did not."""
    confidence: NDArray[np.float64]
    """(N, J, V) w_ij of Eq. 1, the detector's score; 0 where the view did not see the joint."""
    initial: NDArray[np.float64]
    """(N, J, 3) X_0: where stage I, or a track, puts the joints, metres; NaN where it does not know."""
    track: NDArray[np.intp] = field(default=None)  # type: ignore[assignment]
    """(N,) who it is, over time; 0 to N - 1 where it is not said."""
    frame: NDArray[np.intp] = field(default=None)  # type: ignore[assignment]
    """(N,) frame of the row; 0 where it is not said."""
    time_s: NDArray[np.float64] = field(default=None)  # type: ignore[assignment]
    """(N, V) when each view was exposed, seconds: equal in a row if cameras are synchronised. 0 by default."""
    candidate: NDArray[np.intp] = field(default=None)  # type: ignore[assignment]
    """(N, J, V) which detection of the row's frame each observation is; -1 for none, or not said."""
    probability: NDArray[np.float64] = field(default=None)  # type: ignore[assignment]
    """(N, J, V) how probable it is that the observation is this person's; 1 where it is not said."""
    evidence: NDArray[np.float64] = field(default=None)  # type: ignore[assignment]
    """(N,) what speaks for the person being there at all: over time `tracking/evidence.py`, `own_evidence`, in
    frames that stand alone a probability; NaN where it is not said."""

    def __post_init__(self) -> None:
        shape = np.shape(self.confidence)
        if np.shape(self.xy) != (*shape, 2) or np.shape(self.initial) != (*shape[:2], 3):
            raise ValueError(
                f"xy must be (N, J, V, 2), confidence (N, J, V), initial (N, J, 3), got {np.shape(self.xy)}, "
                f"{shape}, {np.shape(self.initial)}"
            )
        N, V = shape[0], shape[2]
        defaults = {
            "track": np.arange(N, dtype=np.intp),
            "frame": np.zeros(N, dtype=np.intp),
            "time_s": np.zeros((N, V)),
            "candidate": np.full(shape, -1, dtype=np.intp),
            "probability": np.ones(shape),
            "evidence": np.full(N, np.nan),
        }
        for name, default in defaults.items():
            if getattr(self, name) is None:
                object.__setattr__(self, name, default)
            elif np.shape(getattr(self, name)) != default.shape:
                raise ValueError(f"{name} must be {default.shape}, got {np.shape(getattr(self, name))}")

    def __len__(self) -> int:
        return len(self.confidence)

    @classmethod
    def of(
        cls, candidate: NDArray[np.intp], detections: Detections, initial: NDArray[np.float64]
    ) -> "Observations":
        """The detections `candidate` (N, J, V) of one frame, -1 for none, as observations."""
        seen = candidate >= 0
        xy, confidence = np.zeros((*seen.shape, 2)), np.zeros(seen.shape)
        xy[seen], confidence[seen] = detections.xy[candidate[seen]], detections.confidence[candidate[seen]]
        return cls(xy, confidence, initial, candidate=candidate)

    @property
    def seen(self) -> NDArray[np.bool_]:
        """(N, J, V) whether there is an observation."""
        return self.confidence > 0

    def rows(self, index: NDArray[np.intp]) -> "Observations":
        """Some of the rows."""
        return Observations(**{each.name: getattr(self, each.name)[index] for each in fields(self)})

    @classmethod
    def concatenate(cls, parts: Sequence["Observations"]) -> "Observations":
        """The rows of several parts, one after the other."""
        return cls(
            **{each.name: np.concatenate([getattr(part, each.name) for part in parts]) for each in fields(cls)}
        )
