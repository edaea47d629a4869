"""The whole way: triangulate, vote, propose, associate; follow, solve in windows, put bodies on; rows out."""

from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from typing import Any

import numpy as np

from shapepose_fg.body.fitting.fitter import BodyFitter, check_fitter
from shapepose_fg.body.fitting.fitters import make_fitter
from shapepose_fg.body.fitting.weights import fingerprint
from shapepose_fg.body.model.body_model import BodyModel
from shapepose_fg.body.model.keypoint_offsets import KeypointOffsets
from shapepose_fg.body.offsets.estimation import learn_offsets
from shapepose_fg.body.shapes import SubjectShapes
from shapepose_fg.body.threads import torch_threads
from shapepose_fg.core.camera import Rig
from shapepose_fg.core.detections import DetectionSequence
from shapepose_fg.core.frame_times import FrameTimes, check_cuts, spans_of, stretches
from shapepose_fg.core.observation_table import place_in_view
from shapepose_fg.core.observations import Observations
from shapepose_fg.core.provenance import versions
from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.core.skeleton import BODY_25, Skeleton
from shapepose_fg.core.storage.kept_arrays import InMemory, KeptArrays
from shapepose_fg.estimation.detector_offsets import (
    confident_targets,
    spread_frames,
)
from shapepose_fg.estimation.estimator import ExtraFactors
from shapepose_fg.estimation.floor import Floor
from shapepose_fg.pipeline.bodies_over_time import fit_everybody
from shapepose_fg.pipeline.chunk_work import ChunkJob, solve_chunk
from shapepose_fg.pipeline.cluster import Cluster
from shapepose_fg.pipeline.config import PipelineConfig
from shapepose_fg.pipeline.engine import Setup, find_people
from shapepose_fg.pipeline.person_bodies import Person, PersonBodies
from shapepose_fg.pipeline.runs.assembly import Assembly
from shapepose_fg.pipeline.runs.checkpoint import Checkpoint
from shapepose_fg.pipeline.runs.chunks import Chunk, Identities, cut_in_chunks
from shapepose_fg.pipeline.runs.notes import Notebook, Notes
from shapepose_fg.pipeline.runs.parts import Part, Parts, RowsOfPeople
from shapepose_fg.pipeline.runs.standing import floor_of
from shapepose_fg.pipeline.solved_rows import result_rows
from shapepose_fg.pipeline.windows import Engine, Solved, Span
from shapepose_fg.pipeline.workers import Pool, Workers
from shapepose_fg.proposal.thinning import ThinnedFrames
from shapepose_fg.tracking.evidence import probability
from shapepose_fg.tracking.hypotheses import Input
from shapepose_fg.tracking.stitching import Ends, Trace, stitch

Progress = Callable[[int, int], None]
"""Called with the number of frames that are done and the number of all."""


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
    workers: int = 1,
    cluster: str | None = None,
    chunk_frames: int | None = None,
) -> Reconstruction:
    """Reconstruct the people of a recording over time; with `config.temporal` false, every frame by itself.

    `frames` picks frames of the recording (all of them by default). `fitter` replaces the body fitter, and
    `extra_factors` adds factors of your own to every person's window. In the result `person` is an identity over
    time (without time, the number of a person within the frame). `times` says when the frames were taken; without
    it 30 frames a second are assumed, and `run` says so. `cuts` are first frames of what follows a cut: nothing
    carries over to them, identities least of all. `shapes` are people known from other recordings. `workers`
    processes solve (1: this one does); they change no byte of the result. `cluster` is the address of a Dask
    scheduler whose processes do it instead, or `local` for `workers` processes of Dask's own. With `chunk_frames`
    people are followed side by side, too, chunk by chunk of about so many frames, for which identities are joined
    across the borders (`runs/chunks.py`); the result may differ by who was in hiding there. `run` of the result
    holds the configuration, versions, seconds per stage (over all processes), how many people were found and
    dropped, with reasons, and where the detector's joints lie on the body. That is learnt from frames spread over
    the whole recording, whatever `frames` picks; a fitter of your own takes part if it has a `model`.
    """
    return reconstruct_parts(
        InMemory(),
        detections,
        rig,
        config,
        frames=frames,
        fitter=fitter,
        extra_factors=extra_factors,
        times=times,
        cuts=cuts,
        shapes=shapes,
        progress=progress,
        workers=workers,
        cluster=cluster,
        chunk_frames=chunk_frames,
    ).reconstruction(consume=True)


def reconstruct_parts(
    kept: KeptArrays,
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
    workers: int = 1,
    cluster: str | None = None,
    chunk_frames: int | None = None,
    sharing: int = 1,
) -> Assembly:
    """`reconstruct` whose windows leave memory for `kept` as they are solved, and whose result is made of them.

    So many runs are `sharing` the cluster: each keeps its part of the work ready there.
    What an earlier call with the same arguments left in `kept`, wherever it was stopped, is not done again, and
    the result is the same to the byte.
    """
    config = PipelineConfig() if config is None else config
    frames = range(len(detections)) if frames is None else frames
    if frames.step != 1 or not 0 <= frames.start <= frames.stop <= len(detections):
        raise ValueError(f"frames must be a range of step 1 within 0:{len(detections)}, got {frames}")
    times = FrameTimes.assumed(len(detections)) if times is None else times
    times.check(len(detections), len(rig))
    cuts = check_cuts(cuts, len(detections))
    if chunk_frames is not None and not (config.temporal and chunk_frames >= config.batch_frames):
        raise ValueError(
            f"chunk_frames must be at least batch_frames ({config.batch_frames}), for people over time; got"
            f" {chunk_frames}"
        )
    book, skeleton = Notebook(), detections.skeleton
    detections = ThinnedFrames(detections, len(rig), config.candidates)
    with book.stage("load"):
        if fitter is None:
            fitter = make_fitter(config.body, BodyModel.default().with_keypoints(skeleton.joints))
    check_fitter(fitter)
    with torch_threads(config.threads):
        offsets = _kept_offsets(kept, detections, rig, config, fitter, book)
        if offsets is not None:
            fitter = fitter.with_keypoint_offsets(offsets)
        setup = Setup(rig, skeleton, config, fitter, extra_factors)
        parts = Parts(kept)
        read = _inputs(detections, rig, frames, times, book)
        done = parts.notes().frames
        with _pool(cluster, workers, setup, sharing) as pool:
            beginning = book.torn_off()
            begin = parts.checkpoint(read)
            if chunk_frames is None:
                solved = _solved(setup.engine(book), pool, read, begin, frames, cuts, book, config)
            else:
                solved = _solved_in_chunks(setup, pool, read, begin, frames, cuts, times, book, chunk_frames)
            for part in solved:
                rows = _rows(part.solved, rig, detections, config)
                parts.append(Part(rows, part.notes, part.checkpoint))
                done += part.notes.frames
                if progress is not None:
                    progress(done, len(frames))
            result = Assembly(parts, skeleton.joints, rig.names)
            if config.temporal and len(parts) > 0:
                with book.stage("follow"):
                    # Between two frames, where no rounding matters.
                    cuts_s = (times.frame_s[list(cuts)] + times.frame_s[[cut - 1 for cut in cuts]]) / 2
                    result = replace(result, names=_names(parts, skeleton, config, cuts_s.tolist()))
            floor: Floor | str = "frames stand alone" if not config.temporal else "not sought"
            if config.temporal and fitter.model is not None and len(result) > 0:
                with book.stage("bodies over time"):
                    if config.motion.floor:
                        floor = floor_of(parts, skeleton.joints, fitter.model, rig.up_vector)
                    known = SubjectShapes.empty(fingerprint(fitter.model)) if shapes is None else shapes
                    ground = floor if isinstance(floor, Floor) else None
                    bodies = fit_everybody(
                        result.people.counts,
                        lambda number, rows: replace(result.person(number, rows), floor=ground),
                        lambda jobs: pool.map(_bodies, jobs),
                        kept,
                        known,
                    )
                    result = replace(result, bodies=bodies)
        notes = beginning
        for each in (parts.notes(), book.torn_off()):
            notes.add(each)
    more = {"time": times.as_dict(), "cuts": list(cuts)}
    more |= {"floor": floor.as_dict() if isinstance(floor, Floor) else {"found": False, "why": floor}}
    more |= {"keypoint_offsets": None if offsets is None else offsets.as_dict()}
    return result.with_run(**_summary(notes, config, frames, result), **more)


def estimate_offsets(
    detections: DetectionSequence,
    rig: Rig,
    config: PipelineConfig | None = None,
    *,
    fitter: BodyFitter | None = None,
) -> KeypointOffsets:
    """Where the detector of a recording puts its joints on the body, learnt without any truth.

    From frames spread over the recording and joints that at least three views see well; what `reconstruct` does
    by itself. `fitter` says on which body, by default the shipped one. `config.offsets.source` is not looked at.
    """
    config = PipelineConfig() if config is None else config
    fitter = make_fitter(config.body) if fitter is None else fitter
    config = replace(config, offsets=replace(config.offsets, source="recording"))
    with torch_threads(config.threads):
        thinned = ThinnedFrames(detections, len(rig), config.candidates)
        offsets = _offsets(thinned, rig, config, fitter, Notebook())
    if offsets is None:
        raise ValueError(
            f"offsets are known for {BODY_25.name} only, these are joints of {detections.skeleton.name}"
        )
    return offsets


def _inputs(
    detections: ThinnedFrames, rig: Rig, frames: range, times: FrameTimes, book: Notebook
) -> Callable[[int], Input]:
    """What the cameras give of a frame."""
    of_views = times.of_views(len(rig))

    def read(frame: int) -> Input:
        with book.stage("read"):
            book.thin("detections", detections.is_thinned(frame), frame)
            return Input(frame, of_views[frame], detections[frame], rig)

    return read


@dataclass(frozen=True)
class _Window:
    """A window that waits to be solved, or is."""

    span: Span
    """Its frames."""
    notes: Notes
    """What was noted down since the window before."""
    checkpoint: Checkpoint | None
    """From where following goes on behind it, where that is known."""


def _windows(
    engine: Engine,
    config: PipelineConfig,
    read: Callable[[int], Input],
    begin: Checkpoint | None,
    frames: range,
    cuts: Sequence[int],
    book: Notebook,
) -> Iterator[_Window]:
    """The windows of a recording, one after the other, as far as their people have been followed."""
    begin = Checkpoint(frames.start) if begin is None else begin
    next_id = begin.next_id
    for stretch in stretches(frames, cuts):
        if stretch.stop <= begin.frame:
            continue
        state = engine.start(next_id)
        if begin.state is not None and begin.frame > stretch.start:
            state = begin.state
        for start in range(max(stretch.start, begin.frame), stretch.stop, config.batch_frames):
            batch = stretch[start - stretch.start : start - stretch.start + config.batch_frames]
            given, last = [read(frame) for frame in batch], batch.stop == stretch.stop
            with book.stage("follow"):
                if config.temporal:
                    spans, state = engine.follow(state, given, last=last)
                    next_id = state.follow.next_id
                else:
                    spans = [engine.alone(book.watched(given))]
            carried = state if config.temporal and not last else None
            behind = Checkpoint(batch.stop, next_id, carried)
            for n, span in enumerate(spans, start=1):
                yield _Window(span, book.torn_off(), behind if n == len(spans) else None)


@dataclass(frozen=True)
class _Done:
    """A window that is solved."""

    solved: Solved
    """Its rows."""
    notes: Notes
    """What is to be said about it."""
    checkpoint: Checkpoint | None
    """As in `_Window`."""


def _solved(
    engine: Engine,
    pool: Pool[Setup],
    read: Callable[[int], Input],
    begin: Checkpoint | None,
    frames: range,
    cuts: Sequence[int],
    book: Notebook,
    config: PipelineConfig,
) -> Iterator[_Done]:
    """The windows from `begin` on, solved, in order."""
    waiting: deque[_Window] = deque()

    def spans() -> Iterator[Span]:
        for window in _windows(engine, config, read, begin, frames, cuts, book):
            waiting.append(window)
            yield window.span

    for solved in pool.map(_solve, spans()):
        window = waiting.popleft()
        notes = _notes(solved, config)
        notes.add(window.notes)
        yield _Done(solved, notes, window.checkpoint)


def _notes(solved: Solved, config: PipelineConfig) -> Notes:
    """What is to be said about a window; people are tracks, or without time numbers within the frame."""
    rows, problems = solved.observations, list(solved.estimates.problems)
    if not config.temporal:
        problems = [
            replace(each, track=int(((rows.frame == each.frame) & (rows.track < each.track)).sum()))
            for each in problems
        ]
    notes = Notes(solved.frames, dict(solved.seconds), problems=problems)
    if len(solved.nobody) > 0:
        notes.dropped[_NOBODY] = list(solved.nobody)
    said = np.isfinite(rows.evidence)
    if config.temporal:
        for track in np.unique(rows.track[said]).tolist():
            own = rows.evidence[said & (rows.track == track)]
            notes.evidence[track] = [float(own.sum()), len(own)]
    else:
        notes.probable = dict(Counter(f"{tenth / 10:.1f}" for tenth in np.floor(10 * rows.evidence[said])))
    return notes


_NOBODY = "next to no detections of their own, or in somebody else's place"
"""Why people are dropped when detections are given out again."""


def _solve(setup: Setup, span: Span) -> Solved:
    """One window, in whatever process."""
    return setup.solver.solve(span)


def _solved_in_chunks(
    setup: Setup,
    pool: Pool[Setup],
    read: Callable[[int], Input],
    begin: Checkpoint | None,
    frames: range,
    cuts: Sequence[int],
    times: FrameTimes,
    book: Notebook,
    chunk_frames: int,
) -> Iterator[_Done]:
    """The windows from `begin` on, in order, whose people were followed chunk by chunk."""
    begin = Checkpoint(frames.start) if begin is None else begin
    chunks = cut_in_chunks(frames, cuts, times.frame_s, setup.config, chunk_frames)
    waiting: deque[tuple[Chunk, Notes]] = deque()

    def jobs() -> Iterator[ChunkJob]:
        for chunk in chunks:
            if chunk.own.start >= begin.frame:
                given = tuple(read(frame) for frame in range(chunk.first, chunk.until))
                waiting.append((chunk, book.torn_off()))
                yield ChunkJob(chunk, given)

    identities = Identities(begin.next_id, begin.border)
    for found in pool.map(solve_chunk, jobs()):
        chunk, notes = waiting.popleft()
        names = identities.names(found.begins, alone=chunk.first == chunk.own.start)
        identities.remember(found.ends, names)
        for n, solved in enumerate(found.solved, start=1):
            of_window = _notes(solved, setup.config)
            renamed = [replace(each, track=identities.name(each.track, names)) for each in of_window.problems]
            evidence = {identities.name(track, names): each for track, each in of_window.evidence.items()}
            of_window = replace(of_window, problems=renamed, evidence=evidence)
            track = np.array([identities.name(each, names) for each in solved.observations.track.tolist()])
            last = n == len(found.solved)
            if last:
                of_window.add(notes)
                of_window.add(found.notes)
            rows = replace(solved.observations, track=track.astype(np.intp))
            behind = Checkpoint(chunk.own.stop, identities.next_id, border=identities.border) if last else None
            yield _Done(replace(solved, observations=rows), of_window, behind)


def _pool(cluster: str | None, workers: int, setup: Setup, sharing: int) -> "Workers[Setup] | Cluster[Setup]":
    """The processes that take part."""
    if cluster is None:
        return Workers(workers, setup)
    return Cluster(None if cluster == "local" else cluster, workers, setup, sharing=sharing)


def _bodies(setup: Setup, person: Person) -> PersonBodies:
    """One person's bodies, in whatever process."""
    return person.fitted(setup.fitter)


def _kept_offsets(
    kept: KeptArrays,
    detections: DetectionSequence,
    rig: Rig,
    config: PipelineConfig,
    fitter: BodyFitter,
    book: Notebook,
) -> KeypointOffsets | None:
    """Where the detector puts its joints; what a run began with it goes on with."""
    columns = [each.name for each in fields(KeypointOffsets)]
    if len(kept.names(_OFFSETS)) > 0:
        return KeypointOffsets(**{name: kept.array(_OFFSETS, name) for name in columns})
    offsets = _offsets(detections, rig, config, fitter, book)
    if offsets is not None:
        kept.keep(_OFFSETS, {name: getattr(offsets, name) for name in columns})
    return offsets


_OFFSETS = "keypoint-offsets"
"""The name under which they are kept."""


def _offsets(
    detections: DetectionSequence, rig: Rig, config: PipelineConfig, fitter: BodyFitter, book: Notebook
) -> KeypointOffsets | None:
    """Where the detector puts its joints, by frames spread over the recording; None where nothing says it."""
    source = config.offsets.source
    if source == "none":
        return None
    if fitter.model is None or detections.skeleton != BODY_25:
        if source == "recording":
            return None
        raise ValueError(f"offsets of {source} need a fitter with a `model`, and joints of BODY_25")
    if source != "recording":
        return KeypointOffsets.load(source)
    with book.stage("offsets"):
        spread = spread_frames(len(detections), config.offsets.frames)
        # Joints that three views see well are wanted: people whose hips they see are enough, and found faster.
        hips = replace(config, proposals=replace(config.proposals, evidence=False))
        people = [find_people(detections[t], rig, detections.skeleton, hips) for t in spread]
        if len(people) == 0:
            return KeypointOffsets.identity()
        targets = confident_targets(Observations.concatenate(people), rig, config.observations, config.offsets)
        return learn_offsets(targets, fitter.model, config=config.body, prior=config.offsets.prior)


def _rows(solved: Solved, rig: Rig, detections: ThinnedFrames, config: PipelineConfig) -> Reconstruction:
    """Solved rows as rows of the result, by frame and person; bodies that were not fitted are NaN there."""
    order = np.lexsort((solved.observations.track, solved.observations.frame))
    rows, estimates = solved.observations.rows(order), solved.estimates.rows(order)
    person = rows.track if config.temporal else _number_in_frame(rows.frame)
    place = np.full(rows.candidate.shape, -1, dtype=np.int32)
    for frame in np.unique(rows.frame).tolist():
        of_frame = rows.frame == frame
        own = detections.in_recording(frame, rows.candidate[of_frame])
        place[of_frame] = place_in_view(own, detections.frames[frame].view)
    return result_rows(rows, estimates, place, rig, detections.skeleton.joints, person)


def _names(parts: Parts, skeleton: Skeleton, config: PipelineConfig, cuts_s: Sequence[float]) -> dict[int, int]:
    """What tracks are called when those of one person are joined over longer times out of sight."""
    tracks = RowsOfPeople(parts, [parts.column(n, "person") for n in range(len(parts))])
    traces = (
        Trace.concatenate(
            [
                Trace.of(track, time_s, joints, skeleton)
                for time_s, joints in tracks.pieces(track, ("time_s", "joints"))
            ]
        )
        for track in tracks.counts
    )
    return stitch(Ends.of(traces), config.stitching, cuts_s)


def _number_in_frame(frame: np.ndarray) -> np.ndarray:
    """(N,) which of its frame's rows each row is; `frame` (N,) rises."""
    return np.arange(len(frame)) - np.searchsorted(frame, frame)


def _spans_by_name(frames: Mapping[str, Sequence[int]]) -> dict[str, list[list[int]]]:
    """Frames as [start, stop), by what became of them."""
    return {name: [[span.start, span.stop] for span in spans_of(numbers)] for name, numbers in frames.items()}


def _summary(notes: Notes, config: PipelineConfig, frames: range, result: Assembly) -> dict[str, Any]:
    """What run.json says of a run, but for what it was made from."""
    skeleton = result.joint_names
    problems = [
        {
            "person": result.names.get(each.track, each.track),
            "frame": each.frame,
            "joint": skeleton[each.joint],
            "reason": each.reason,
        }
        for each in notes.problems
    ]
    dropped = {reason: frames for reason, frames in notes.dropped.items() if len(frames) > 0}
    named = Notes()
    for track, each in notes.evidence.items():
        named.add(Notes(evidence={result.names.get(track, track): each}))
    probable = [
        {
            "person": name,
            "evidence": round(total / rows, 3),
            "probability": round(probability(total / rows), 3),
        }
        for name, (total, rows) in sorted(named.evidence.items())
    ]
    return {
        "configuration": asdict(config),
        "versions": versions(),
        "frames": [frames.start, frames.stop],
        "seconds": notes.seconds,
        "people": {
            **result.counts(),
            "dropped": {reason: len(frames) for reason, frames in dropped.items()},
            "problems": problems,
        },
        "probability": probable if config.temporal else dict(sorted(notes.probable.items())),
        "dropped_frames": _spans_by_name(dropped),
        "thinned_frames": _spans_by_name(notes.thinned_frames),
    }
