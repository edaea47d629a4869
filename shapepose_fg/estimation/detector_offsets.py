"""Which joints of a recording are known well enough to learn the detector's habits from, and who uses them."""

from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np
from annotated_types import Interval

from shapepose_fg.body.fitting.fitter import JointTargets
from shapepose_fg.core.bounds import Settings
from shapepose_fg.core.camera import Rig, Views
from shapepose_fg.core.observations import Observations
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.estimation.linearisation import ObservationConfig, linearise, observation_sigmas, triangulate

_MIN_VIEWS = 3
"""Views that must agree on a joint for it to be learnt from: two that agree may both be wrong."""
_MIN_CONFIDENCE = 0.4
"""Confidence that a detection must have to count as one of these views."""
_MAX_SIGMA_M = 0.03
"""A joint whose views leave it less certain than this in some direction is not learnt from."""


@dataclass(frozen=True)
class OffsetConfig(Settings):
    """Whether, and from what, the difference between the detector's joints and the body's is learnt, and how large
    the detector's errors are (`noise_law`).
    """

    source: str = "recording"
    """"recording": learnt from the recording itself; "none": there is none, and errors are the usual ones; else
    a file that holds offsets: the run.json of another recording by the same detector, from which the errors are
    taken, too, or what `KeypointOffsets.save` wrote."""
    frames: Annotated[int, Interval(ge=1, le=10000)] = 30
    """Frames, spread over the whole recording, that offsets are learnt from."""
    replaced: ClassVar[dict[str, str]] = dict.fromkeys(
        ("min_views", "min_confidence", "max_sigma_m", "prior"), "is a constant now"
    )
    """Settings that there were, and what took their place."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.source == "":
            raise ValueError('source must be "recording", "none" or a file, got nothing')


def spread_frames(length: int, count: int) -> list[int]:
    """At most `count` frames spread evenly over a recording of `length` frames, rising."""
    if length <= count:
        return list(range(length))
    return np.unique(np.linspace(0, length - 1, count).round().astype(int)).tolist()


def confident_targets(observations: Observations, rig: Rig, config: ObservationConfig) -> JointTargets:
    """Where the views alone put the joints that they know well, information zero for all others.

    Without the body: what it pulled towards its own joint would hide the detector's.
    """
    views = Views.of(rig, observations.time_s)
    points = triangulate(observations, views, config)
    sigmas = observation_sigmas(observations, points, views, config, BODY_25.joints)
    evidence = linearise(observations, sigmas, points, views, config)
    evidence = linearise(observations, sigmas, evidence.target, views, config)
    sure = (evidence.inlier & (observations.confidence >= _MIN_CONFIDENCE)).sum(axis=-1) >= _MIN_VIEWS
    sure &= evidence.sigma_m <= _MAX_SIGMA_M
    return JointTargets(np.nan_to_num(evidence.target), np.where(sure[..., None, None], evidence.information, 0.0))
