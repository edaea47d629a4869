"""A recording cut into chunks whose people are followed apart, side by side; who is who from chunk to chunk."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from shapepose_fg.core.arrays import Array, Index
from shapepose_fg.core.assignment import least_cost_pairs
from shapepose_fg.core.detections import Input
from shapepose_fg.core.frame_times import segments
from shapepose_fg.core.observations import Observations
from shapepose_fg.core.storage.schema import Column, Table
from shapepose_fg.pipeline.config import PipelineConfig
from shapepose_fg.pipeline.windows import Engine, Span
from shapepose_fg.tracking.following import BLOCK_S

WARM_S = 6.0
"""Time over which people are tracked before a chunk, s: who is present is known after a second or two, and people
who are hidden for longer are rare. Tracking takes a tenth of the time."""
_SAME = 0.5
"""Minimum share of the smaller track's detections that both tracks use, from which on they are one person."""
_NEAR_M = 0.3
"""Mean distance between the joints of two tracks without detections, m, below which they are one person."""


@dataclass(frozen=True)
class Chunk:
    """Frames that are reconstructed independently of all others."""

    own: range
    """The frames whose rows belong to the chunk."""
    first: int
    """The first frame in which people are tracked."""
    until: int
    """The frame before which tracking ends; the last of the chunk's own windows is decided by then."""
    ended: bool
    """Whether the recording ends, or is cut, at `until`."""


def cut_in_chunks(
    frames: range, cuts: Sequence[int], time_s: Array, config: PipelineConfig, chunk_frames: int
) -> list[Chunk]:
    """Chunks of about `chunk_frames` whose borders are those of windows, so that windows are as without chunks.

    `time_s` (T,) are the times of all frames of the recording. What is followed before a chunk is whole windows,
    at least `WARM_S` of them. Each segment between cuts is cut for itself.
    """
    batch = config.batch_frames
    step = max(1, round(chunk_frames / batch)) * batch
    found = []
    for segment in segments(frames, cuts):
        # The last window takes up to half a window more than its own frames (`Engine.follow`).
        borders = [at for at in segment[step::step] if at + batch // 2 < segment.stop]
        for start, stop in zip((segment.start, *borders), (*borders, segment.stop), strict=True):
            first = start
            while first > segment.start and time_s[start] - time_s[first] < WARM_S:
                first -= batch
            until = _until(stop, segment, first, time_s, config)
            found.append(Chunk(range(start, stop), first, until, until == segment.stop))
    return found


def _until(stop: int, segment: range, first: int, time_s: Array, config: PipelineConfig) -> int:
    """How far people must be followed for the window that ends at `stop`: half a window and the overlap beyond it,
    the block in which that is decided, as far as following looks ahead, and two frames to spare, in whole batches.

    `Engine` compares means over the cameras' times, which round differently: a frame more or less, twice.
    """
    beyond = stop + config.batch_frames // 2 + 1
    while beyond < segment.stop and time_s[beyond] - time_s[stop] <= config.windows.shared_s:
        beyond += 1
    if beyond >= segment.stop:
        return segment.stop
    newest = beyond
    ahead_s = BLOCK_S + config.following.look_ahead_s + config.windows.keyframe_s
    while newest < segment.stop and time_s[newest] - time_s[beyond] < ahead_s:
        newest += 1
    newest += 2
    batches = -(-(newest + 1 - first) // config.batch_frames)
    return min(first + batches * config.batch_frames, segment.stop)


def windows_of(engine: Engine, chunk: Chunk, read: Callable[[int], Input]) -> Iterator[Span]:
    """The windows of a chunk, whose people are followed from `chunk.first` on."""
    state, done, step = engine.start(), chunk.first, engine.config.batch_frames
    for start in range(chunk.first, chunk.until, step):
        batch = range(start, min(start + step, chunk.until))
        last = chunk.ended and batch.stop == chunk.until
        spans, state = engine.follow(state, map(read, batch), last=last)
        for span in spans:
            if done in chunk.own:
                yield span
            done = span.decided[span.stop - 1][0].frame + 1


@dataclass(frozen=True)
class Border(Table):
    """Who is where in the frames on both sides of a border: N rows."""

    frame: Annotated[Index, Column("N", np.intp)]
    """(N,) frame of each row."""
    track: Annotated[Index, Column("N", np.intp)]
    """(N,) whose it is, as one of the chunks has it."""
    candidate: Annotated[Index, Column("N J V", np.intp)]
    """(N, J, V) its detections; -1 for none."""
    place: Annotated[Array, Column("N J 3", unit="m")]
    """(N, J, 3) where its joints were expected, metres; NaN where nothing was."""

    @classmethod
    def of(cls, span: Span) -> "Border":
        """The rows of a window, and of the frames that it overlaps."""
        rows = Observations.concatenate([rows for _, rows in span.decided])
        return cls(rows.frame, rows.track, rows.candidate, rows.initial)


def same_people(before: Border, after: Border) -> dict[int, int]:
    """For tracks of `after` who they are among those of `before`, as far as they are there.

    By the detections that both chunks gave to them in the frames that both know; people out of sight by where they
    were expected. One to one.
    """
    shared = np.intersect1d(before.frame, after.frame)
    before, after = (each.rows(np.isin(each.frame, shared)) for each in (before, after))
    old, new = np.unique(before.track), np.unique(after.track)
    alike = np.zeros((len(old), len(new)))
    for i, a in enumerate(old):
        mine = before.rows(before.track == a)
        alike[i] = [_alike(mine, after.rows(after.track == b)) for b in new]
    rows, columns = least_cost_pairs(-alike)
    return {int(new[k]): int(old[i]) for i, k in zip(rows, columns, strict=True) if alike[i, k] > 0}


def _alike(a: Border, b: Border) -> float:
    """0 for two people; up to 1 for one out of sight, and up to 2 by how many detections both tracks have."""
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


class Identities:
    """What the tracks of one chunk after the other are called, so that a person keeps the name."""

    def __init__(self, next_id: int, border: Border | None) -> None:
        """The next new person's identity, and who was where at the end of the chunk before."""
        self.next_id = next_id
        self.border = border

    def names(self, begins: Border, *, alone: bool) -> dict[int, int]:
        """What tracks of a chunk are called that were there in the one before; `alone`: nothing carries over."""
        return {} if alone or self.border is None else same_people(self.border, begins)

    def name(self, track: int, names: dict[int, int]) -> int:
        """What a track is called; a track without a name gets the next."""
        if track not in names:
            names[track] = self.next_id
            self.next_id += 1
        return names[track]

    def remember(self, ends: Border, names: dict[int, int]) -> None:
        """Who is where at the end of a chunk."""
        track = [self.name(each, names) for each in ends.track.tolist()]
        self.border = replace(ends, track=np.array(track, dtype=np.intp))
