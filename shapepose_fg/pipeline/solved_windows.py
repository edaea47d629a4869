"""The windows of a recording, solved, in order: its people are followed here, or chunk by chunk in any process."""

from collections import Counter, deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from shapepose_fg.core.arrays import Array, Whole
from shapepose_fg.core.camera import Rig
from shapepose_fg.core.frame_times import FrameTimes, segments
from shapepose_fg.core.observation_table import Gate, ObservationTable, place_in_view
from shapepose_fg.core.reconstruction import BODY, Reconstruction
from shapepose_fg.estimation.window_solution import WindowSolution
from shapepose_fg.pipeline.engine import Setup, Solved
from shapepose_fg.pipeline.execution import Pool
from shapepose_fg.pipeline.runs.chunks import Border, Chunk, Identities, cut_in_chunks, windows_of
from shapepose_fg.pipeline.runs.notes import Notebook, Notes
from shapepose_fg.pipeline.runs.parts import Checkpoint, Part
from shapepose_fg.pipeline.windows import Span
from shapepose_fg.proposal.thinning import ThinnedFrames
from shapepose_fg.tracking.worlds import Input

_FALSE_POSITIVE = "next to no detections of their own, or in somebody else's place"
"""Why people are dropped when detections are reassociated."""


@dataclass(frozen=True)
class SolvedWindows:
    """The windows of a recording: where they come from, and who solves them."""

    setup: Setup
    """What all processes share."""
    detections: ThinnedFrames
    """What the cameras saw."""
    times: FrameTimes
    """When."""
    frames: range
    """The frames that are wanted."""
    cuts: Sequence[int]
    """First frames of what follows a cut."""
    book: Notebook
    """Where this process takes its notes."""

    @cached_property
    def _time_s(self) -> Array:
        """(T, V) when each view took each frame."""
        return self.times.of_views(len(self.setup.rig))

    def read(self, frame: int) -> Input:
        """What the cameras give of a frame."""
        with self.book.stage("read"):
            self.book.thin("detections", self.detections.is_thinned(frame), frame)
            return Input(frame, self._time_s[frame], self.detections[frame], self.setup.rig)

    def after(self, begin: Checkpoint | None, pool: Pool[Setup], chunk_frames: int | None) -> Iterator[Part]:
        """The windows from `begin` on, in order; in chunks of about `chunk_frames`, where that is given."""
        begin = Checkpoint(self.frames.start) if begin is None else begin
        if chunk_frames is not None:
            yield from self._by_chunks(begin, pool, chunk_frames)
            return
        waiting: deque[tuple[Notes, Checkpoint | None]] = deque()

        def spans() -> Iterator[Span]:
            for span, behind in self._followed(begin):
                waiting.append((self.book.torn_off(), behind))
                yield span

        for solved in pool.map(Setup.solve, spans()):
            followed, behind = waiting.popleft()
            notes = self._notes(solved)
            notes.add(followed)
            yield Part(self._rows(solved), notes, behind)

    def _followed(self, begin: Checkpoint) -> Iterator[tuple[Span, Checkpoint | None]]:
        """The windows as far as their people have been followed, and from where following goes on behind some."""
        config, engine = self.setup.config, self.setup.engine(self.book)
        next_id = begin.next_id
        for segment in segments(self.frames, self.cuts):
            if segment.stop <= begin.frame:
                continue
            state = begin.state if begin.frame > segment.start else None
            state = engine.start(next_id) if state is None else state
            for start in range(max(segment.start, begin.frame), segment.stop, config.batch_frames):
                batch = range(start, min(start + config.batch_frames, segment.stop))
                given, last = [self.read(frame) for frame in batch], batch.stop == segment.stop
                with self.book.stage("follow"):
                    if config.temporal:
                        spans, state = engine.follow(state, given, last=last)
                        next_id = state.follow.next_id
                    else:
                        spans = [engine.alone(self.book.watched(given))]
                behind = Checkpoint(batch.stop, next_id, state if config.temporal and not last else None)
                for n, span in enumerate(spans, start=1):
                    yield span, behind if n == len(spans) else None

    def _by_chunks(self, begin: Checkpoint, pool: Pool[Setup], chunk_frames: int) -> Iterator[Part]:
        chunks = cut_in_chunks(self.frames, self.cuts, self.times.frame_s, self.setup.config, chunk_frames)
        waiting: deque[tuple[Chunk, Notes]] = deque()

        def jobs() -> Iterator[tuple[Chunk, Sequence[Input]]]:
            for chunk in chunks:
                if chunk.own.start >= begin.frame:
                    given = tuple(self.read(frame) for frame in range(chunk.first, chunk.until))
                    waiting.append((chunk, self.book.torn_off()))
                    yield chunk, given

        identities = Identities(begin.next_id, begin.border)
        name = identities.name
        for found in pool.map(solve_chunk, jobs()):
            chunk, read = waiting.popleft()
            names = identities.names(found.begins, alone=chunk.first == chunk.own.start)
            identities.remember(found.ends, names)
            for solved in found.solved:
                notes, last = self._notes(solved), solved is found.solved[-1]
                notes.problems = [replace(each, track=name(each.track, names)) for each in notes.problems]
                notes.evidence = {name(of, names): each for of, each in notes.evidence.items()}
                track = [name(each, names) for each in solved.solution.observations.track.tolist()]
                if last:
                    notes.add(read)
                    notes.add(found.notes)
                rows = replace(solved.solution.observations, track=np.array(track, dtype=np.intp))
                behind = Checkpoint(chunk.own.stop, identities.next_id, border=identities.border)
                named = replace(solved, solution=replace(solved.solution, observations=rows))
                yield Part(self._rows(named), notes, behind if last else None)

    def _notes(self, solved: Solved) -> Notes:
        """What is to be said about a window; people are tracks, or frame by frame numbers within the frame."""
        temporal, solution = self.setup.config.temporal, solved.solution
        rows, problems = solution.observations, list(solution.problems)
        if not temporal:
            problems = [
                replace(each, track=int(((rows.frame == each.frame) & (rows.track < each.track)).sum()))
                for each in problems
            ]
        notes = Notes(solved.frames, Counter(solution.seconds), problems=problems)
        if len(solved.false_positives) > 0:
            notes.dropped[_FALSE_POSITIVE] = list(solved.false_positives)
        said = np.isfinite(rows.evidence)
        if temporal:
            for track in np.unique(rows.track[said]).tolist():
                own = rows.evidence[said & (rows.track == track)]
                notes.evidence[track] = [float(own.sum()), len(own)]
        else:
            notes.probable = Counter(f"{tenth / 10:.1f}" for tenth in np.floor(10 * rows.evidence[said]))
        return notes

    def _rows(self, solved: Solved) -> Reconstruction:
        """Solved rows as rows of the result, by frame and person; bodies that were not fitted are NaN there."""
        rows = solved.solution.observations
        solution = solved.solution.rows(np.lexsort((rows.track, rows.frame)))
        rows = solution.observations
        number_in_frame = np.arange(len(rows)) - np.searchsorted(rows.frame, rows.frame)
        person = rows.track if self.setup.config.temporal else number_in_frame
        place = np.full(rows.candidate.shape, -1, dtype=np.int32)
        for frame in np.unique(rows.frame).tolist():
            of_frame = rows.frame == frame
            own = self.detections.in_recording(frame, rows.candidate[of_frame])
            place[of_frame] = place_in_view(own, self.detections.frames[frame].view)
        return result_rows(solution, place, self.setup.rig, self.setup.skeleton.joints, person)


def result_rows(
    solution: WindowSolution, place: Whole, rig: Rig, joint_names: Sequence[str], person: Whole
) -> Reconstruction:
    """N solved rows as a result, in their order; bodies that were not fitted are NaN there.

    `place` (N, J, V) is each detection's place among those of its view (`place_in_view`), `person` (N,) who it is.
    """
    fit, observations = solution.fit, replace(solution.observations, track=person)
    body = {name: getattr(fit, name).copy() for name in BODY}
    for values in body.values():
        values[~fit.ok] = np.nan
    dropped = np.where(solution.contradicts[..., None], Gate.CONTRADICTS_BODY, Gate.TOO_FAR)
    gate = np.where(solution.inlier, Gate.USED, dropped)
    names = ("joints", "covariance", "velocity", "velocity_covariance", "known", "confidence", "status")
    return Reconstruction(
        frame=observations.frame,
        person=person,
        time_s=observations.time_s.mean(axis=1),
        joint_names=np.array(joint_names),
        observations=ObservationTable.of(observations, place, solution.joints, gate, rig, joint_names),
        **{name: getattr(solution, name) for name in names},
        **body,
    )


@dataclass(frozen=True)
class SolvedChunk:
    """A chunk that is done; its tracks count from 0."""

    solved: tuple[Solved, ...]
    """Its windows."""
    notes: Notes
    """What is to be said about following its people."""
    begins: Border
    """Who is where at its beginning."""
    ends: Border
    """And at its end."""


def solve_chunk(setup: Setup, job: tuple[Chunk, Sequence[Input]]) -> SolvedChunk:
    """Follow people through a chunk and solve its windows, in whatever process.

    With the chunk goes what the cameras gave from `chunk.first` on. RuntimeError where these are not the frames
    of the chunk, each once.
    """
    chunk, given = job
    book = Notebook()
    engine = setup.engine(book)
    with book.stage("follow"):
        spans = list(windows_of(engine, chunk, lambda frame: given[frame - chunk.first]))
    frames = [each.frame for span in spans for each, _ in span.decided[span.start : span.stop]]
    if frames != list(chunk.own):
        raise RuntimeError(f"windows of {len(frames)} frames were found for a chunk of {chunk.own}")
    solved = tuple(map(setup.solve, spans))
    notes = book.torn_off()
    notes.dropped = {why: [each for each in of if each in chunk.own] for why, of in notes.dropped.items()}
    return SolvedChunk(solved, notes, Border.of(spans[0]), Border.of(spans[-1]))
