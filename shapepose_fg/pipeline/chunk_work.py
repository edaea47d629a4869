"""One chunk of a recording, from what the cameras gave to solved windows, in whatever process."""

from dataclasses import dataclass

from shapepose_fg.pipeline.engine import Setup
from shapepose_fg.pipeline.runs.borders import Border
from shapepose_fg.pipeline.runs.chunks import Chunk, windows_of
from shapepose_fg.pipeline.runs.notes import Notebook, Notes
from shapepose_fg.pipeline.windows import Solved
from shapepose_fg.tracking.hypotheses import Input


@dataclass(frozen=True)
class ChunkJob:
    """What is to be done; plain data, which can be sent to another process."""

    chunk: Chunk
    """Which frames."""
    given: tuple[Input, ...]
    """What the cameras gave, from `chunk.first` on."""


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


def solve_chunk(setup: Setup, job: ChunkJob) -> SolvedChunk:
    """Follow people through a chunk and solve its windows.

    RuntimeError where these are not the frames of the chunk, each once.
    """
    book = Notebook()
    engine = setup.engine(book)
    with book.stage("follow"):
        spans = list(windows_of(engine, job.chunk, lambda frame: job.given[frame - job.chunk.first]))
    frames = [given.frame for span in spans for given, _ in span.decided[span.start : span.stop]]
    if frames != list(job.chunk.own):
        raise RuntimeError(f"windows of {len(frames)} frames were found for a chunk of {job.chunk.own}")
    solved = tuple(setup.solver.solve(span) for span in spans)
    notes = book.torn_off()
    notes.dropped = {why: [each for each in of if each in job.chunk.own] for why, of in notes.dropped.items()}
    return SolvedChunk(solved, notes, Border.of(spans[0]), Border.of(spans[-1]))
