"""Solved windows of a recording, in order: people are tracked in this process, or by chunk in
others.
"""

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from shapepose_fg.core.arrays import Array, Index
from shapepose_fg.core.camera import Rig
from shapepose_fg.core.detections import Input
from shapepose_fg.core.frame_times import FrameTimes, segments
from shapepose_fg.core.notes import Notebook, Notes
from shapepose_fg.core.repeated_pictures import WithoutRepeats
from shapepose_fg.pipeline.runs.chunks import Border, Chunk, Identities, cut_in_chunks, windows_of
from shapepose_fg.pipeline.runs.parts import Checkpoint, Part
from shapepose_fg.pipeline.setup import Setup
from shapepose_fg.pipeline.windows import Span
from shapepose_fg.pipeline.workers import Pool
from shapepose_fg.proposal.thinning import ThinnedFrames


@dataclass(frozen=True)
class SolvedWindows:
    """Tracks people through a recording, and solves its windows."""

    setup: Setup
    """Data shared by all processes."""
    detections: ThinnedFrames
    """Detections of the recording."""
    pictures: WithoutRepeats
    """The recording before thinning, without repeated pictures."""
    times: FrameTimes
    """Times of the frames."""
    frames: range
    """The wanted frames."""
    cuts: Sequence[int]
    """First frames after cuts."""
    keyframes: Index
    """(K,) keyframes, in which people are searched for, ascending."""
    notebook: Notebook
    """Collects the notes of this process."""
    _rigs: dict[tuple[tuple[int, ...], ...], Rig] = field(default_factory=dict, init=False)
    """Rigs, by views without a picture and doubted views."""

    @cached_property
    def _time_s(self) -> Array:
        """(T, V) exposure times of the frames by view, seconds."""
        return self.times.of_views(len(self.setup.rig))

    def read(self, frame: int) -> Input:
        """Input of a frame; it is not thinned between keyframes."""
        key = _among(frame, self.keyframes)
        with self.notebook.stage("read"):
            thinned = self.detections.is_thinned(frame)
            repeated, trust = self.pictures.repeated(frame), self.pictures.trust
            if key:
                self.notebook.thin("detections", thinned, frame)
                self.notebook.repeat([self.setup.rig.names[view] for view in repeated], frame)
            found = self.detections[frame] if key else self.pictures[frame]
            # With more detections than people could explain, associations are chance.
            doubted = tuple(range(len(self.setup.rig))) if thinned else trust.in_doubt(frame)
            views = tuple(sorted({*repeated, *trust.excluded(frame)})), doubted
            if self.setup.rig.moves:
                rig = replace(
                    self.setup.rig.at(self._time_s[frame]), excluded=views[0], doubted=views[1]
                )
                return Input(frame, self._time_s[frame], found, rig, key)
            if views not in self._rigs:
                self._rigs[views] = replace(self.setup.rig, excluded=views[0], doubted=views[1])
            return Input(frame, self._time_s[frame], found, self._rigs[views], key)

    def after(
        self, begin: Checkpoint | None, pool: Pool[Setup], chunk_frames: int | None
    ) -> Iterator[Part]:
        """The windows from `begin` on, in order; in chunks of about `chunk_frames` if given."""
        begin = Checkpoint(self.frames.start) if begin is None else begin
        if chunk_frames is not None:
            yield from self._by_chunks(begin, pool, chunk_frames)
            return
        waiting: deque[tuple[Notes, Checkpoint | None]] = deque()

        def spans() -> Iterator[Span]:
            for span, behind in self._followed(begin):
                waiting.append((self.notebook.flush(), behind))
                yield span

        for part in pool.map(Setup.solve, spans()):
            followed, behind = waiting.popleft()
            part.notes.add(followed)
            yield replace(part, checkpoint=behind)

    def _followed(self, begin: Checkpoint) -> Iterator[tuple[Span, Checkpoint | None]]:
        """Windows with tracked people, some with the state for continuing tracking."""
        config, engine = self.setup.config, self.setup.engine(self.notebook)
        next_id = begin.next_id
        for segment in segments(self.frames, self.cuts):
            if segment.stop <= begin.frame:
                continue
            state = begin.state if begin.frame > segment.start else None
            state = engine.start(next_id) if state is None else state
            for start in range(max(segment.start, begin.frame), segment.stop, config.batch_frames):
                batch = range(start, min(start + config.batch_frames, segment.stop))
                given, last = [self.read(frame) for frame in batch], batch.stop == segment.stop
                with self.notebook.stage("follow"):
                    if config.temporal:
                        spans, state = engine.follow(state, given, last=last)
                        next_id = state.follow.next_id
                    else:
                        spans = [engine.isolated_frames(self.notebook.watched(given))]
                behind = Checkpoint(
                    batch.stop, next_id, state if config.temporal and not last else None
                )
                for n, span in enumerate(spans, start=1):
                    yield span, behind if n == len(spans) else None

    def _by_chunks(self, begin: Checkpoint, pool: Pool[Setup], chunk_frames: int) -> Iterator[Part]:
        chunks = cut_in_chunks(
            self.frames, self.cuts, self.times.frame_s, self.setup.config, chunk_frames
        )
        waiting: deque[tuple[Chunk, Notes]] = deque()

        def jobs() -> Iterator[tuple[Chunk, Sequence[Input]]]:
            for chunk in chunks:
                if chunk.own.start >= begin.frame:
                    given = tuple(self.read(frame) for frame in range(chunk.first, chunk.until))
                    waiting.append((chunk, self.notebook.flush()))
                    yield chunk, given

        identities = Identities(begin.next_id, begin.border)
        name = identities.name
        for found in pool.map(solve_chunk, jobs()):
            chunk, read = waiting.popleft()
            names = identities.names(found.begins, isolated=chunk.first == chunk.own.start)
            identities.remember(found.ends, names)
            for part in found.parts:
                notes, rows, behind = part.notes, part.rows, None
                notes.problems = [
                    replace(each, track=name(each.track, names)) for each in notes.problems
                ]
                notes.evidence = {name(of, names): each for of, each in notes.evidence.items()}
                rows = rows.relabelled(
                    np.array([name(each, names) for each in rows.person.tolist()], np.int64)
                )
                if part is found.parts[-1]:
                    notes.add(read)
                    notes.add(found.notes)
                    behind = Checkpoint(
                        chunk.own.stop, identities.next_id, border=identities.border
                    )
                yield Part(rows.rows(np.lexsort((rows.person, rows.frame))), notes, behind)


def _among(frame: int, frames: Index) -> bool:
    """Whether `frame` is in the ascending `frames`."""
    at = int(np.searchsorted(frames, frame))
    return at < len(frames) and frames[at] == frame


@dataclass(frozen=True)
class SolvedChunk:
    """A solved chunk; its tracks are numbered from 0."""

    parts: tuple[Part, ...]
    """Windows of the chunk."""
    notes: Notes
    """Notes about tracking the chunk's people."""
    begins: Border
    """Tracks at the beginning of the chunk."""
    ends: Border
    """Tracks at the end of the chunk."""


def solve_chunk(setup: Setup, job: tuple[Chunk, Sequence[Input]]) -> SolvedChunk:
    """Track people through a chunk and solve its windows, in any process.

    The job has the input of all frames from `chunk.first` on. Raises RuntimeError if the solved
    frames are not those of the chunk, each once.
    """
    chunk, given = job
    notebook = Notebook()
    engine = setup.engine(notebook)
    with notebook.stage("follow"):
        spans = list(windows_of(engine, chunk, lambda frame: given[frame - chunk.first]))
    frames = [each.frame for span in spans for each, _ in span.decided[span.start : span.stop]]
    if frames != list(chunk.own):
        raise RuntimeError(
            f"{len(frames)} frames were solved in the windows of the chunk {chunk.own}, which must "
            "be all of its frames, each once; please report this error"
        )
    parts = tuple(map(setup.solve, spans))
    notes = notebook.flush()
    notes.dropped = {
        why: [each for each in of if each in chunk.own] for why, of in notes.dropped.items()
    }
    return SolvedChunk(parts, notes, Border.of(spans[0]), Border.of(spans[-1]))
