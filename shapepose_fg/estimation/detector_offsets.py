"""Which joints of a recording are known well enough to learn the detector's habits from, and who uses them."""

from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
from annotated_types import Interval

from shapepose_fg.body.fitting.fitter import JointTargets
from shapepose_fg.body.offsets.estimation import OffsetPrior
from shapepose_fg.core.bounds import Count, Metres, Settings, Share
from shapepose_fg.core.camera import Rig, Views
from shapepose_fg.core.observations import Observations
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.estimation.linearisation import ObservationConfig, linearise, observation_sigmas, triangulate


@dataclass(frozen=True)
class OffsetConfig(Settings):
    """Whether, and from what, the difference between the detector's joints and the body's is learnt."""

    source: str = "recording"
    """"recording": learnt from the recording itself; "none": there is none; else a file that holds offsets:
    the run.json of another recording by the same detector, or what `KeypointOffsets.save` wrote."""
    frames: Annotated[int, Interval(ge=1, le=10000)] = 30
    """Frames, spread over the whole recording, that offsets are learnt from."""
    min_views: Count = 3
    """Views that must agree on a joint for it to be learnt from: two that agree may both be wrong."""
    min_confidence: Share = 0.4
    """Confidence that a detection must have to count as one of these views."""
    max_sigma_m: Metres = 0.03
    """A joint whose views leave it less certain than this in some direction is not learnt from."""
    prior: OffsetPrior = field(default_factory=OffsetPrior)
    """What is believed before."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.source == "":
            raise ValueError('source must be "recording", "none" or a file, got nothing')


def spread_frames(length: int, count: int) -> list[int]:
    """At most `count` frames spread evenly over a recording of `length` frames, rising."""
    if length <= count:
        return list(range(length))
    return np.unique(np.linspace(0, length - 1, count).round().astype(int)).tolist()


def confident_targets(
    observations: Observations, rig: Rig, observation_config: ObservationConfig, config: OffsetConfig
) -> JointTargets:
    """Where the views alone put the joints that they know well, information zero for all others.

    Without the body: what it pulled towards its own joint would hide the detector's.
    """
    views = Views.of(rig)
    points = triangulate(observations, views, observation_config)
    sigmas = observation_sigmas(observations, points, views, observation_config, BODY_25.joints)
    evidence = linearise(observations, sigmas, points, views, observation_config)
    evidence = linearise(observations, sigmas, evidence.target, views, observation_config)
    sure = (evidence.inlier & (observations.confidence >= config.min_confidence)).sum(axis=-1) >= config.min_views
    sure &= evidence.sigma_m <= config.max_sigma_m
    return JointTargets(np.nan_to_num(evidence.target), np.where(sure[..., None, None], evidence.information, 0.0))
