"""Offsets of a detector's joints from those of the body, estimated from frames spread over a recording."""

from dataclasses import fields, replace

import numpy as np

from shapepose_fg.body.fitting.fitter import BodyFitter
from shapepose_fg.body.fitting.fitters import make_fitter
from shapepose_fg.body.model.keypoint_offsets import KeypointOffsets
from shapepose_fg.body.offsets.estimation import learn_offsets
from shapepose_fg.core.camera import Rig
from shapepose_fg.core.detections import DetectionSequence
from shapepose_fg.core.errors import naming
from shapepose_fg.core.frame_times import FrameTimes
from shapepose_fg.core.notes import Notebook
from shapepose_fg.core.observations import Observations
from shapepose_fg.core.repeated_pictures import WithoutRepeats
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.core.storage.kept_arrays import ANEW, KeptArrays
from shapepose_fg.estimation.detector_offsets import confident_targets, spread_frames
from shapepose_fg.pipeline.config import PipelineConfig
from shapepose_fg.pipeline.setup import Setup
from shapepose_fg.proposal.stage_one import StageOne
from shapepose_fg.proposal.thinning import ThinnedFrames

_OFFSETS = "keypoint-offsets"
"""The name under which a run stores them."""


def estimate_offsets(
    detections: DetectionSequence,
    rig: Rig,
    config: PipelineConfig | None = None,
    *,
    times: FrameTimes | None = None,
    fitter: BodyFitter | None = None,
) -> KeypointOffsets:
    """Estimate the offsets of a recording's detector from the joints of the body, without ground truth.

    Uses frames spread over the recording and joints that at least three views see well, as `reconstruct` does by
    itself. `times` are needed where cameras move. `fitter` has the body, by default the shipped one.
    `config.offsets.source` is ignored.
    """
    config = config or PipelineConfig()
    fitter = fitter or make_fitter(config.body)
    config = replace(config, offsets=replace(config.offsets, source="recording"))
    thinned = ThinnedFrames(WithoutRepeats(detections, len(rig)), rig, config.candidates)
    times = FrameTimes.assumed(len(detections)) if times is None else times
    offsets = offsets_of(Setup(rig, thinned.skeleton, config, fitter), thinned, times, Notebook())
    if offsets is None:
        raise ValueError(f"offsets are known for {BODY_25.name} only, not for {detections.skeleton.name}")
    return offsets


def kept_offsets(
    kept: KeptArrays, setup: Setup, frames: ThinnedFrames, times: FrameTimes, book: Notebook
) -> KeypointOffsets | None:
    """The offsets that a run stored when it began; `offsets_of` where it has none yet."""
    columns = [each.name for each in fields(KeypointOffsets)]
    if len(kept.names(_OFFSETS)) > 0:
        with naming(kept.place(_OFFSETS), ANEW):
            return KeypointOffsets(**{name: kept.array(_OFFSETS, name) for name in columns})
    offsets = offsets_of(setup, frames, times, book)
    if offsets is not None:
        kept.keep(_OFFSETS, {name: getattr(offsets, name) for name in columns})
    return offsets


def offsets_of(
    setup: Setup, detections: ThinnedFrames, times: FrameTimes, book: Notebook
) -> KeypointOffsets | None:
    """The offsets of the detector's joints; None where there is no source. ValueError where a file does not
    fit.
    """
    config, rig, fitter = setup.config, setup.rig, setup.fitter
    source = config.offsets.source
    if source == "none":
        return None
    if fitter.model is None or setup.skeleton != BODY_25:
        if source == "recording":
            return None
        raise ValueError(f"offsets of {source} need a fitter with a `model`, and joints of BODY_25")
    if source != "recording":
        return KeypointOffsets.load(source)
    with book.stage("offsets"):
        spread = spread_frames(len(detections) - detections.first, config.offsets.frames)
        # Joints that three views see well are wanted: people whose hips they see are enough, and found faster.
        hips = StageOne(setup.skeleton, config.candidates, config.proposals, Notebook()).of_few()
        people, time_s = list[Observations](), times.of_views(len(rig))
        for frame in (detections.first + t for t in spread):
            found = hips(detections[frame], rig.at(time_s[frame]))
            people.append(replace(found, time_s=np.tile(time_s[frame], (len(found), 1))))
        if len(people) == 0:
            return KeypointOffsets.identity()
        targets = confident_targets(Observations.concatenate(people), rig, config.observations)
        return learn_offsets(targets, fitter.model, config=config.body)
