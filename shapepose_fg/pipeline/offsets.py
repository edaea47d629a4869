"""Learns a detector's joint offsets and noise law from frames spread over a recording."""

from collections.abc import Iterator
from dataclasses import fields, replace

import numpy as np

from shapepose_fg.body.fitting.fitter import BodyFitter
from shapepose_fg.body.fitting.fitters import make_fitter
from shapepose_fg.body.model.keypoint_offsets import KeypointOffsets
from shapepose_fg.body.offsets.estimation import learn_offsets
from shapepose_fg.core.camera import Rig, Views
from shapepose_fg.core.detections import Detections, DetectionSequence
from shapepose_fg.core.errors import naming
from shapepose_fg.core.frame_times import FrameTimes
from shapepose_fg.core.notes import Notebook
from shapepose_fg.core.observations import Observations
from shapepose_fg.core.repeated_pictures import WithoutRepeats
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.core.storage.kept_arrays import ANEW, KeptArrays
from shapepose_fg.estimation.detector_offsets import confident_targets, spread_frames
from shapepose_fg.estimation.noise_law import NoiseLaw, Residuals
from shapepose_fg.pipeline.config import PipelineConfig
from shapepose_fg.pipeline.setup import Setup
from shapepose_fg.proposal.people_2d import whole_people
from shapepose_fg.proposal.stage_one import StageOne
from shapepose_fg.proposal.thinning import ThinnedFrames

_OFFSETS, _NOISE = "keypoint-offsets", "noise-law"
"""Names under which a run stores the offsets and the noise law."""
NOISE_FRAMES = 60
"""Maximum number of frames for learning the noise law. Shorter recordings use the shipped law."""
_ENOUGH = 10_000
"""Number of detections that are enough for the noise law; a crowd has them in about 12 frames."""


def estimate_offsets(
    detections: DetectionSequence,
    rig: Rig,
    config: PipelineConfig | None = None,
    *,
    times: FrameTimes | None = None,
    fitter: BodyFitter | None = None,
) -> KeypointOffsets:
    """Estimate the offsets of a recording's detector from the joints of the body, without ground
    truth.

    Uses frames spread over the recording and joints that at least three views see well, as
    `reconstruct` does by itself. `times` are needed where cameras move. `fitter` has the body, by
    default the shipped one. `config.offsets.source` is ignored.
    """
    config = config or PipelineConfig()
    fitter = fitter or make_fitter(config.body)
    config = replace(config, offsets=replace(config.offsets, source="recording"))
    thinned = ThinnedFrames(WithoutRepeats(detections, len(rig)), rig, config.candidates)
    times = FrameTimes.assumed(len(detections)) if times is None else times
    offsets = offsets_of(Setup(rig, thinned.skeleton, config, fitter), thinned, times, Notebook())
    if offsets is None:
        raise ValueError(
            f"offsets are known for {BODY_25.name} only, not for {detections.skeleton.name}"
        )
    return offsets


def kept_offsets(
    kept: KeptArrays, setup: Setup, frames: ThinnedFrames, times: FrameTimes, book: Notebook
) -> KeypointOffsets | None:
    """The offsets stored when the run began; `offsets_of` if there are none yet."""
    columns = [each.name for each in fields(KeypointOffsets)]
    if len(kept.names(_OFFSETS)) > 0:
        with naming(kept.place(_OFFSETS), ANEW):
            return KeypointOffsets(**{name: kept.array(_OFFSETS, name) for name in columns})
    offsets = offsets_of(setup, frames, times, book)
    if offsets is not None:
        kept.keep(_OFFSETS, {name: getattr(offsets, name) for name in columns})
    return offsets


def kept_noise(
    kept: KeptArrays, setup: Setup, frames: ThinnedFrames, times: FrameTimes, book: Notebook
) -> NoiseLaw:
    """The noise law stored when the run began; `noise_of` if there is none yet."""
    if len(kept.names(_NOISE)) > 0:
        with naming(kept.place(_NOISE), ANEW):
            return NoiseLaw.from_dict(
                {name: kept.array(_NOISE, name).tolist() for name in NoiseLaw.COLUMNS}
            )
    noise = noise_of(setup, frames, times, book)
    if noise != NoiseLaw.shipped():
        kept.keep(_NOISE, {name: np.array(getattr(noise, name)) for name in NoiseLaw.COLUMNS})
    return noise


def noise_of(
    setup: Setup, detections: ThinnedFrames, times: FrameTimes, book: Notebook
) -> NoiseLaw:
    """The detector's noise law, from the same source as the offsets.

    A recording of fewer than `NOISE_FRAMES` frames uses the shipped law.
    """
    source = setup.config.offsets.source
    if source not in ("none", "recording"):
        return NoiseLaw.load(source)
    count = len(detections) - detections.first
    if source == "none" or count < NOISE_FRAMES:
        return NoiseLaw.shipped()
    chosen, every = list[Observations](), list[Observations]()
    with book.stage("noise"):
        stage = StageOne(
            setup.skeleton, setup.config.candidates, setup.config.proposals, Notebook()
        )
        frames, learnt = detections.first + np.array(spread_frames(count, NOISE_FRAMES)), 0
        # In golden-ratio order, frames are spread over the whole recording even if it ends early.
        order = np.argsort(np.arange(len(frames)) * ((5**0.5 - 1) / 2) % 1.0, kind="stable")
        for found, people in _people(stage, setup.rig, detections, frames[order].tolist(), times):
            whole = Observations.of(whole_people(people.candidate, found), found, people.initial)
            chosen.append(people)
            every.append(whole)
            learnt += int(whole.seen.sum())
            if learnt >= _ENOUGH:
                break
        rows, whole = Observations.concatenate(chosen), Observations.concatenate(every)
        views, config = Views.of(setup.rig, rows.time_s), setup.config.observations
        return Residuals.of(rows, whole, views, config, setup.skeleton.joints).law()


def offsets_of(
    setup: Setup, detections: ThinnedFrames, times: FrameTimes, book: Notebook
) -> KeypointOffsets | None:
    """Offsets of the detector's joints; None without a source. Raises ValueError for an unsuitable
    file.
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
        # Joints that three views see well are wanted: people whose hips they see are enough, and
        # found faster.
        hips = StageOne(setup.skeleton, config.candidates, config.proposals, Notebook()).of_few()
        frames = [detections.first + t for t in spread]
        people = [each for _, each in _people(hips, rig, detections, frames, times)]
        if len(people) == 0:
            return KeypointOffsets.identity()
        targets = confident_targets(Observations.concatenate(people), rig, config.observations)
        return learn_offsets(targets, fitter.model, config=config.body)


def _people(
    stage: StageOne, rig: Rig, detections: ThinnedFrames, frames: list[int], times: FrameTimes
) -> Iterator[tuple[Detections, Observations]]:
    """The detections of each of the `frames`, and the people that the `stage` finds in them."""
    time_s = times.of_views(len(rig))
    for frame in frames:
        found = detections[frame]
        people = stage(found, rig.at(time_s[frame]))
        yield found, replace(people, time_s=np.tile(time_s[frame], (len(people), 1)))
