"""A recording cut into chunks whose people are followed apart, side by side, and who is who across the borders."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from shapepose_fg.frame_times import stretches
from shapepose_fg.observations import Observations
from shapepose_fg.tracking.following import Input
from shapepose_fg.windows import Engine, Span

WARM_S = 6.0
"""Before a chunk people are followed for so long: who is there is known after a second or two, and people who
hide for longer than that are rare. Following takes a tenth of the time."""
_SAME = 0.5
"""Of two tracks the lesser one's detections that the other has too, from which on they are one person."""
_NEAR_M = 0.3
"""Or both are out of sight, and their joints so near to each other in the mean."""


@dataclass(frozen=True)
class Chunk:
    """Frames that are reconstructed apart from all others."""

    own: range
    """The frames whose rows are its own."""
    first: int
    """People are followed from this frame on."""
    last: int
    """The one after the last that may be followed: the recording ends, or is cut, there."""


def cut_in_chunks(
    frames: range, cuts: Sequence[int], time_s: NDArray[np.float64], batch_frames: int, chunk_frames: int
) -> list[Chunk]:
    """Chunks of about `chunk_frames` whose borders are those of windows, so that windows are as without chunks.

    `time_s` (T,) are the times of all frames of the recording. What is followed before a chunk is whole windows of
    `batch_frames`, at least `WARM_S` of them. A stretch between cuts is cut for itself.
    """
    step = max(1, round(chunk_frames / batch_frames)) * batch_frames
    found = []
    for stretch in stretches(frames, cuts):
        # The last window takes up to half a window more than its own frames (`Engine.follow`).
        borders = [at for at in stretch[step::step] if at + batch_frames // 2 < stretch.stop]
        for start, stop in zip((stretch.start, *borders), (*borders, stretch.stop), strict=True):
            first = start
            while first > stretch.start and time_s[start] - time_s[first] < WARM_S:
                first -= batch_frames
            found.append(Chunk(range(start, stop), first, stretch.stop))
    return found


def windows_of(engine: Engine, chunk: Chunk, read: Callable[[int], Input], batch_frames: int) -> Iterator[Span]:
    """The windows of a chunk, whose people are followed from `chunk.first` on."""
    state = engine.start()
    done = chunk.first
    for start in range(chunk.first, chunk.last, batch_frames):
        batch = range(start, min(start + batch_frames, chunk.last))
        spans, state = engine.follow(state, [read(frame) for frame in batch], last=batch.stop == chunk.last)
        for span in spans:
            if done in chunk.own:
                yield span
            done = _frame(span, span.stop - 1) + 1
        if done >= chunk.own.stop:
            return


@dataclass(frozen=True)
class Border:
    """Who is where in the frames on both sides of a border: N rows."""

    frame: NDArray[np.intp]
    """(N,) frame of each row."""
    track: NDArray[np.intp]
    """(N,) whose it is, as one of the chunks has it."""
    candidate: NDArray[np.intp]
    """(N, J, V) its detections; -1 for none."""
    place: NDArray[np.float64]
    """(N, J, 3) where its joints were expected, metres; NaN where nothing was."""

    @classmethod
    def of(cls, span: Span) -> "Border":
        """The rows of a window, and of the frames that it overlaps."""
        rows = Observations.concatenate([rows for _, rows in span.decided])
        return cls(rows.frame, rows.track, rows.candidate, rows.initial)

    def rows(self, index: NDArray[np.intp]) -> "Border":
        """Some of the rows."""
        return Border(self.frame[index], self.track[index], self.candidate[index], self.place[index])


def same_people(before: Border, after: Border) -> dict[int, int]:
    """For tracks of `after` who they are among those of `before`, as far as they are there.

    By the detections that both chunks gave to them in the frames that both know; people out of sight by where they
    were expected. One to one.
    """
    shared = np.intersect1d(before.frame, after.frame)
    before = before.rows(np.flatnonzero(np.isin(before.frame, shared)))
    after = after.rows(np.flatnonzero(np.isin(after.frame, shared)))
    old, new = np.unique(before.track), np.unique(after.track)
    alike = np.zeros((len(old), len(new)))
    for i, a in enumerate(old.tolist()):
        for k, b in enumerate(new.tolist()):
            alike[i, k] = _alike(
                before.rows(np.flatnonzero(before.track == a)), after.rows(np.flatnonzero(after.track == b))
            )
    rows, columns = linear_sum_assignment(-alike)
    return {int(new[k]): int(old[i]) for i, k in zip(rows, columns, strict=True) if alike[i, k] > 0}


def _alike(a: Border, b: Border) -> float:
    """0 for two people; up to 1 for one whom nobody saw, and up to 2 by how many detections both tracks have."""
    _, first, second = np.intersect1d(a.frame, b.frame, return_indices=True)
    if len(first) == 0:
        return 0.0
    mine, theirs = a.candidate[first], b.candidate[second]
    count = min(int((mine >= 0).sum()), int((theirs >= 0).sum()))
    if count > 0:
        share = int(((mine == theirs) & (mine >= 0)).sum()) / count
        return 1.0 + share if share >= _SAME else 0.0
    apart = np.linalg.norm(a.place[first] - b.place[second], axis=-1)
    apart = apart[np.isfinite(apart)]
    return 1.0 - float(apart.mean()) / _NEAR_M if len(apart) > 0 and apart.mean() < _NEAR_M else 0.0


def _frame(span: Span, place: int) -> int:
    """The number of one of a window's frames."""
    return span.decided[place][0].frame
