"""Learns a detector's joint offsets and noise law from frames spread over a recording."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import partial
from typing import Any, TypeVar

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

T = TypeVar("T")

_OFFSETS, _NOISE = "keypoint-offsets", "noise-law"
"""Names under which a run stores the offsets and the noise law."""
NOISE_FRAMES = 60
"""Maximum number of frames for learning the noise law. Shorter recordings use the shipped law."""
_ENOUGH = 10_000
"""Number of detections that suffice for learning the offsets or the noise law; a crowd has them in
about 12 frames."""


@dataclass(frozen=True)
class Sample:
    """People in frames spread over a recording, found when they are first needed."""

    setup: Setup
    """The set-up of the run."""
    detections: ThinnedFrames
    """The recording."""
    times: FrameTimes
    """Times of the recording's frames."""
    _found: list[tuple[Detections, Observations]] = field(default_factory=list, init=False)

    def people(self, most: int) -> Iterator[tuple[Detections, Observations]]:
        """Detections and people of up to `most` frames."""
        setup, first = self.setup, self.detections.first
        config, rig, time_s = setup.config, setup.rig, self.times.of_views(len(setup.rig))
        stage = StageOne(setup.skeleton, config.candidates, config.proposals, Notebook())
        spread = max(NOISE_FRAMES, config.offsets.frames)
        frames = first + np.array(spread_frames(len(self), spread), dtype=np.intp)
        # In golden-ratio order, frames are spread over the whole recording even if it ends early.
        order = np.argsort(np.arange(len(frames)) * ((5**0.5 - 1) / 2) % 1.0, kind="stable")
        for n, frame in enumerate(frames[order[:most]].tolist()):
            if n == len(self._found):
                found = self.detections[frame]
                people = stage(found, rig.at(time_s[frame]))
                time = np.tile(time_s[frame], (len(people), 1))
                self._found.append((found, replace(people, time_s=time)))
            yield self._found[n]

    def __len__(self) -> int:
        return len(self.detections) - self.detections.first


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
    setup = Setup(rig, thinned.skeleton, config, fitter)
    offsets = offsets_of(Sample(setup, thinned, times), Notebook())
    if offsets is None:
        raise ValueError(
            f"offsets are known for {BODY_25.name} only, not for {detections.skeleton.name}"
        )
    return offsets


def kept_offsets(kept: KeptArrays, sample: Sample, notebook: Notebook) -> KeypointOffsets | None:
    """The offsets stored when the run began; `offsets_of` if there are none yet."""
    columns = [each.name for each in fields(KeypointOffsets)]
    make = partial(offsets_of, sample, notebook)
    return _kept(kept, _OFFSETS, columns, make, lambda arrays: KeypointOffsets(**arrays))


def kept_noise(kept: KeptArrays, sample: Sample, notebook: Notebook) -> NoiseLaw:
    """The noise law stored when the run began; `noise_of` if there is none yet."""
    return _kept(
        kept, _NOISE, NoiseLaw.COLUMNS, lambda: noise_of(sample, notebook), NoiseLaw.from_dict
    )


def _kept(
    kept: KeptArrays,
    name: str,
    columns: Sequence[str],
    make: Callable[[], T],
    of: Callable[[dict[str, Any]], T],
) -> T:
    """Return what a run has stored under `name`, converted from its `columns` by `of`. If nothing
    is stored yet, the result of `make` is stored, unless it is None, and returned.
    """
    if len(kept.names(name)) > 0:
        with naming(kept.place(name), ANEW):
            return of({each: kept.array(name, each) for each in columns})
    made = make()
    if made is not None:
        kept.keep(name, {each: np.array(getattr(made, each)) for each in columns})
    return made


def noise_of(sample: Sample, notebook: Notebook) -> NoiseLaw:
    """The detector's noise law, from the same source as the offsets.

    A recording of fewer than `NOISE_FRAMES` frames uses the shipped law.
    """
    setup = sample.setup
    source = setup.config.offsets.source
    if source not in ("none", "recording"):
        return NoiseLaw.load(source)
    if source == "none" or len(sample) < NOISE_FRAMES:
        return NoiseLaw.shipped()
    with notebook.stage("noise"):
        every = _enough(
            Observations.of(whole_people(people.candidate, found), found, people.initial)
            for found, people in sample.people(NOISE_FRAMES)
        )
        rows = Observations.concatenate([people for _, people in sample.people(len(every))])
        whole = Observations.concatenate(every)
        views, config = Views.of(setup.rig, rows.time_s), setup.config.observations
        return Residuals.of(rows, whole, views, config, setup.skeleton.joints).law()


def offsets_of(sample: Sample, notebook: Notebook) -> KeypointOffsets | None:
    """Offsets of the detector's joints; None without a source. Raises ValueError for an unsuitable
    file.
    """
    setup = sample.setup
    config, fitter, source = setup.config, setup.fitter, setup.config.offsets.source
    if source == "none":
        return None
    if fitter.model is None or setup.skeleton != BODY_25:
        if source == "recording":
            return None
        raise ValueError(f"offsets of {source} need a fitter with a `model`, and joints of BODY_25")
    if source != "recording":
        return KeypointOffsets.load(source)
    with notebook.stage("offsets"):
        people = _enough(each for _, each in sample.people(config.offsets.frames))
        if len(people) == 0:
            return KeypointOffsets.identity()
        rows = Observations.concatenate(people)
        targets = confident_targets(rows, setup.rig, config.observations)
        return learn_offsets(targets, fitter.model, config=config.body)


def _enough(frames: Iterable[Observations]) -> list[Observations]:
    """The first of some `frames` that together have `_ENOUGH` detections."""
    found, learnt = list[Observations](), 0
    for each in frames:
        found.append(each)
        learnt += int(each.seen.sum())
        if learnt >= _ENOUGH:
            break
    return found
