"""The whole way: triangulate, vote, propose, associate, refine; frame by frame, refined in batches of frames."""

import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from shapepose_fg.body.fitting.fitter import BodyFitter
from shapepose_fg.body.fitting.fitters import BodyConfig, make_fitter
from shapepose_fg.body.model.body_model import BodyModel
from shapepose_fg.body.model.keypoint_offsets import KeypointOffsets
from shapepose_fg.body.offsets.estimation import learn_offsets
from shapepose_fg.body.shapes import SubjectShapes
from shapepose_fg.body.threads import torch_threads
from shapepose_fg.camera import Rig
from shapepose_fg.detections import Detections, DetectionSequence
from shapepose_fg.estimation.alternation import ExtraFactors, RefineConfig, Refined, refine
from shapepose_fg.estimation.detector_offsets import (
    AdjustableFitter,
    OffsetConfig,
    confident_targets,
    spread_frames,
)
from shapepose_fg.estimation.linearisation import ObservationConfig
from shapepose_fg.estimation.person_graph import PersonGraphConfig
from shapepose_fg.frame_times import FrameTimes, check_cuts
from shapepose_fg.observation_table import Gate, ObservationTable, place_in_view
from shapepose_fg.observations import Observations
from shapepose_fg.proposal.association import AssociationConfig, associate
from shapepose_fg.proposal.candidates import CandidateConfig, triangulate_pairs, vote
from shapepose_fg.proposal.proposals import ProposalConfig, propose
from shapepose_fg.provenance import versions
from shapepose_fg.reconstruction import Known, Reconstruction
from shapepose_fg.skeleton import BODY_25, Skeleton

Progress = Callable[[int, int], None]
"""Called with the number of frames that are done and the number of all."""


@dataclass(frozen=True)
class PipelineConfig:
    """The settings of every step, and how the work is cut."""

    candidates: CandidateConfig = field(default_factory=CandidateConfig)
    """Stage I (b, c): pairs of views to 3D joint candidates."""
    proposals: ProposalConfig = field(default_factory=ProposalConfig)
    """Stage I (d): candidates to people."""
    association: AssociationConfig = field(default_factory=AssociationConfig)
    """Stage I (e): people to their 2D observations."""
    observations: ObservationConfig = field(default_factory=ObservationConfig)
    """How far a 2D observation is trusted."""
    person_graph: PersonGraphConfig = field(default_factory=PersonGraphConfig)
    """Stage II: the factor graph of a person."""
    body: BodyConfig = field(default_factory=BodyConfig)
    """Stage II: how bodies are fitted."""
    offsets: OffsetConfig = field(default_factory=OffsetConfig)
    """Stage II: where the detector puts its joints on the body."""
    refine: RefineConfig = field(default_factory=RefineConfig)
    """Stage II: the alternation."""
    temporal: bool = True
    """People over time: identities, motion, one shape a person. Without it every frame stands alone."""
    batch_frames: int = 64
    """Frames whose people are refined together: bodies are fitted fastest by the hundred."""
    threads: int = 1
    """Threads of torch while bodies are fitted: the matrices are small, and where cores are busy a second thread
    costs more than it brings."""

    def __post_init__(self) -> None:
        for name in ("batch_frames", "threads"):
            if getattr(self, name) <= 0:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")


def reconstruct(
    detections: DetectionSequence,
    rig: Rig,
    config: PipelineConfig | None = None,
    *,
    frames: range | None = None,
    fitter: BodyFitter | None = None,
    extra_factors: ExtraFactors | None = None,
    times: FrameTimes | None = None,
    cuts: Sequence[int] = (),
    shapes: SubjectShapes | None = None,
    progress: Progress | None = None,
) -> Reconstruction:
    """Reconstruct the people of a recording, every frame by itself.

    `frames` picks frames of the recording (all of them by default). `fitter` replaces the body fitter, and
    `extra_factors` adds factors of your own to every person's graph. In the result a person's number counts the
    people of a frame; it is not an identity over time. `run` of the result holds the configuration, versions,
    seconds per stage, how many people were found and dropped, with reasons, and where the detector's joints lie
    on the body. `times` says when the frames were taken; without it 30 frames a second are assumed, and run.json
    says so. `cuts` are first frames of what follows a cut: nothing carries over to them. `shapes` are people known
    from other recordings. Offsets are learnt from frames of the whole recording, whatever `frames` picks, so that
    a frame comes out the same alone and among others; a fitter of your own takes part if it is an
    `AdjustableFitter`.
    """
    config = PipelineConfig() if config is None else config
    frames = range(len(detections)) if frames is None else frames
    if frames.step != 1 or not 0 <= frames.start <= frames.stop <= len(detections):
        raise ValueError(f"frames must be a range of step 1 within 0:{len(detections)}, got {frames}")
    times = FrameTimes.assumed(len(detections)) if times is None else times
    times.check(len(detections), len(rig))
    cuts = check_cuts(cuts, len(detections))
    run = _Run()
    with run.stage("load"):
        if fitter is None:
            fitter = make_fitter(config.body, BodyModel.default().with_keypoints(detections.skeleton.joints))
    found: dict[int, Observations] = {}
    parts = []
    with torch_threads(config.threads):
        offsets = _offsets(detections, rig, config, frames, fitter, found, run)
        if isinstance(fitter, AdjustableFitter) and offsets is not None:
            fitter = fitter.with_keypoint_offsets(offsets)
        for start in range(0, len(frames), config.batch_frames):
            batch = frames[start : start + config.batch_frames]
            parts.append(_reconstruct_batch(detections, rig, config, batch, fitter, extra_factors, found, run))
            if progress is not None:
                progress(start + len(batch), len(frames))
    people = Reconstruction.concatenate(parts) if parts else Reconstruction.empty(detections.skeleton.joints)
    summary = run.summary(config, frames, people) | {"time": times.as_dict(), "cuts": list(cuts)}
    summary |= {"keypoint_offsets": None if offsets is None else offsets.as_dict()}
    return replace(people, time_s=times.frame_s[people.frame], run=summary)


def estimate_offsets(
    detections: DetectionSequence,
    rig: Rig,
    config: PipelineConfig | None = None,
    *,
    fitter: AdjustableFitter | None = None,
) -> KeypointOffsets:
    """Where the detector of a recording puts its joints on the body, learnt without any truth.

    From frames spread over the recording and joints that at least three views see well; what `reconstruct` does
    by itself. `fitter` says on which body, by default the shipped one. `config.offsets.source` is not looked at.
    """
    config = PipelineConfig() if config is None else config
    fitter = make_fitter(config.body) if fitter is None else fitter
    config = replace(config, offsets=replace(config.offsets, source="recording"))
    with torch_threads(config.threads):
        offsets = _offsets(detections, rig, config, range(0), fitter, {}, _Run())
    if offsets is None:
        raise ValueError(
            f"offsets are known for {BODY_25.name} only, these are joints of {detections.skeleton.name}"
        )
    return offsets


def find_people(
    detections: Detections, rig: Rig, skeleton: Skeleton, config: PipelineConfig, run: "_Run | None" = None
) -> Observations:
    """Stage I, one frame: the people's 2D observations and where their joints are to begin with."""
    run = _Run() if run is None else run
    with run.stage("triangulate"):
        points = triangulate_pairs(detections, rig, config.candidates)
    with run.stage("vote"):
        candidates = vote(points, detections, len(rig), config.candidates)
    with run.stage("propose"):
        proposals = propose(candidates, detections, skeleton, rig.up_vector, config.proposals)
    with run.stage("associate"):
        observations, phantoms = associate(proposals, candidates, detections, rig, skeleton, config.association)
    run.dropped.update(proposals.dropped)
    run.dropped["hardly any joint seen by two views"] += phantoms
    return observations


def _reconstruct_batch(
    detections: DetectionSequence,
    rig: Rig,
    config: PipelineConfig,
    frames: range,
    fitter: BodyFitter,
    extra_factors: ExtraFactors | None,
    found: dict[int, Observations],
    run: "_Run",
) -> Reconstruction:
    """Stage I frame by frame, then stage II for all people of these frames together.

    Frames whose people are `found` already are not looked at again.
    """
    parts = [found.pop(t) if t in found else _look(detections, t, rig, config, run) for t in frames]
    counts = np.array([len(observations) for observations in parts])
    frame = np.repeat(np.array(frames), counts)
    person = np.arange(len(frame)) - np.repeat(np.cumsum(counts) - counts, counts)
    observations = Observations.concatenate(parts)
    with run.stage("refine"):
        refined = refine(
            observations,
            rig,
            fitter,
            config.observations,
            config.person_graph,
            config.refine,
            person=person,
            frame=frame,
            extra_factors=extra_factors,
        )
    people = _rows(refined, frame, person, detections.skeleton)
    with run.stage("refine"):
        starts = np.cumsum(counts)[:-1]
        candidates = zip(frames, np.split(observations.candidate, starts), strict=True)
        table = ObservationTable.of(
            observations,
            np.concatenate([place_in_view(candidate, detections[t].view) for t, candidate in candidates]),
            refined.joints,
            np.where(refined.inlier, Gate.USED, Gate.TOO_FAR),
            rig,
            frame=frame,
            person=person,
            joint_names=detections.skeleton.joints,
        )
    return replace(people, observations=table)


def _look(
    detections: DetectionSequence, frame: int, rig: Rig, config: PipelineConfig, run: "_Run"
) -> Observations:
    """Read a frame, and stage I."""
    with run.stage("read"):
        seen = detections[frame]
    return find_people(seen, rig, detections.skeleton, config, run)


def _offsets(
    detections: DetectionSequence,
    rig: Rig,
    config: PipelineConfig,
    frames: range,
    fitter: BodyFitter,
    found: dict[int, Observations],
    run: "_Run",
) -> KeypointOffsets | None:
    """Where the detector puts its joints; None where nobody asks. Fills `found` with people of `frames`."""
    source = config.offsets.source
    if source == "none":
        return None
    if not isinstance(fitter, AdjustableFitter) or detections.skeleton != BODY_25:
        if source == "recording":
            return None
        raise ValueError(f"offsets of {source} need a fitter with `with_keypoint_offsets` and joints of BODY_25")
    if source != "recording":
        return KeypointOffsets.load(source)
    spread = spread_frames(len(detections), config.offsets.frames)
    for frame in spread:
        if frame in frames:
            found[frame] = _look(detections, frame, rig, config, run)
    with run.stage("offsets"):
        # What was found elsewhere is not this run's: neither its stages nor what it dropped.
        people = [found[t] if t in frames else _look(detections, t, rig, config, _Run()) for t in spread]
        if len(people) == 0:
            return KeypointOffsets.identity()
        targets = confident_targets(Observations.concatenate(people), rig, config.observations, config.offsets)
        return learn_offsets(targets, fitter.model, config=config.body.plain, prior=config.offsets.prior)


def _rows(refined: Refined, frame: np.ndarray, person: np.ndarray, skeleton: Skeleton) -> Reconstruction:
    """The refined people as rows of the result; bodies that were not fitted are NaN there."""
    fit = refined.fit
    body = {name: getattr(fit, name).copy() for name in ("betas", "global_orient", "body_pose", "transl")}
    for values in body.values():
        values[~fit.ok] = np.nan
    known = np.where(refined.inlier.any(axis=-1), Known.SEEN, Known.BODY)
    known = np.where(np.isfinite(refined.joints).all(axis=-1), known, Known.UNKNOWN)
    return Reconstruction(
        frame=frame,
        person=person,
        joint_names=np.array(skeleton.joints),
        joints=refined.joints,
        covariance=refined.covariance,
        confidence=refined.confidence,
        known=known,
        status=refined.status,
        **body,
    )


class _Run:
    """What a run notes down for run.json."""

    def __init__(self) -> None:
        self.seconds: defaultdict[str, float] = defaultdict(float)
        self.dropped: Counter[str] = Counter()

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Add the time of a block to a stage."""
        start = time.perf_counter()
        yield
        self.seconds[name] += time.perf_counter() - start

    def summary(self, config: PipelineConfig, frames: range, people: Reconstruction) -> dict[str, Any]:
        """The contents of `Reconstruction.run`."""
        return {
            "configuration": asdict(config),
            "versions": versions(),
            "frames": [frames.start, frames.stop],
            "seconds": dict(self.seconds),
            "people": {
                **people.counts(),
                "dropped": {reason: count for reason, count in self.dropped.items() if count > 0},
            },
        }
