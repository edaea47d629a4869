"""Selects well observed joints of a recording for estimating the detector's offsets."""

from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np
from annotated_types import Interval

from shapepose_fg.body.fitting.fitter import JointTargets
from shapepose_fg.core.bounds import Settings
from shapepose_fg.core.camera import Rig, Views
from shapepose_fg.core.observations import Observations
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.estimation.gated_views import (
    ObservationConfig,
    linearise,
    observation_sigmas,
    triangulate,
)

_MIN_VIEWS = 3
"""Minimum number of views that agree on a joint; two that agree may both be wrong."""
_MIN_CONFIDENCE = 0.4
"""Minimum confidence of a detection from which an offset is estimated."""
_MAX_SIGMA_M = 0.03
"""Maximum standard deviation of a used joint in its worst direction, m."""


@dataclass(frozen=True)
class OffsetConfig(Settings):
    """Source of the detector's joint offsets and noise law.

    Offsets are the difference between the detector's joints and the body's.
    """

    source: str = "recording"
    """"recording" learns both from the recording itself. "none" uses no offsets, and the shipped
    noise law. Otherwise it is a file with offsets: the run.json of another recording with the same
    detector, which also has a noise law, or a file from `KeypointOffsets.save`."""
    frames: Annotated[int, Interval(ge=1, le=10000)] = 30
    """Number of frames, spread over the whole recording, for estimating offsets."""
    replaced: ClassVar[dict[str, str]] = dict.fromkeys(
        ("min_views", "min_confidence", "max_sigma_m", "prior"), "is a constant now"
    )
    """Obsolete settings, and what replaces them."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.source == "":
            raise ValueError('source must be "recording", "none" or a file, got nothing')


def spread_frames(length: int, count: int) -> list[int]:
    """At most `count` frames, ascending, evenly spread over a recording of `length` frames."""
    if length <= count:
        return list(range(length))
    return np.unique(np.linspace(0, length - 1, count).round().astype(int)).tolist()


def confident_targets(
    observations: Observations, rig: Rig, config: ObservationConfig
) -> JointTargets:
    """Estimates of well observed joints from the views only, with zero information for all others.

    The body is not used, because its constraints would hide the detector's offsets.
    """
    views = Views.of(rig, observations.time_s)
    points = triangulate(observations, views, config)
    sigmas = observation_sigmas(observations, points, views, config, BODY_25.joints)
    evidence = linearise(observations, sigmas, points, views, config)
    evidence = linearise(observations, sigmas, evidence.target, views, config)
    confident = (evidence.inlier & (observations.confidence >= _MIN_CONFIDENCE)).sum(
        axis=-1
    ) >= _MIN_VIEWS
    confident &= evidence.sigma_m <= _MAX_SIGMA_M
    return JointTargets(
        np.nan_to_num(evidence.target),
        np.where(confident[..., None, None], evidence.information, 0.0),
    )
