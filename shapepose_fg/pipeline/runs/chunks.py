"""Divides a recording into chunks with people tracked in parallel, and joins identities across
borders.
"""

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
from shapepose_fg.tracking.identities import BLOCK_S

WARM_S = 6.0
"""Tracking time before a chunk, s: tracks are established after a second or two, and longer
occlusions are rare. Tracking takes a tenth of the total time."""
_SAME = 0.5
"""Minimum share of the smaller track's detections that both tracks use for them to be
one person."""
_NEAR_M = 0.3
"""Mean distance between joints of two tracks without detections, m, below which they are one
person."""


@dataclass(frozen=True)
class Chunk:
    """Frames that are reconstructed independently of all others."""

    own: range
    """Frames of the chunk's rows."""
    first: int
    """First frame of tracking."""
    until: int
    """Frame before which tracking ends; the chunk's last own window is decided by then."""
    ended: bool
    """Whether the recording ends, or is cut, at `until`."""


def cut_in_chunks(
    frames: range, cuts: Sequence[int], time_s: Array, config: PipelineConfig, chunk_frames: int
) -> list[Chunk]:
    """Chunks of about `chunk_frames`, with borders at those of windows, so that windows are the
    same as without chunks.

    `time_s` (T,) are the times of all frames of the recording. Tracking begins whole windows before
    a chunk, at least `WARM_S`. Each segment between cuts is divided separately.
    """
    batch = config.batch_frames
    step = max(1, round(chunk_frames / batch)) * batch
    found = []
    for segment in segments(frames, cuts):
        # The last window is up to half a window longer (`Engine.follow`).
        borders = [at for at in segment[step::step] if at + batch // 2 < segment.stop]
        for start, stop in zip((segment.start, *borders), (*borders, segment.stop), strict=True):
            first = start
            while first > segment.start and time_s[start] - time_s[first] < WARM_S:
                first -= batch
            until = _until(stop, segment, first, time_s, config)
            found.append(Chunk(range(start, stop), first, until, until == segment.stop))
    return found


def _until(stop: int, segment: range, first: int, time_s: Array, config: PipelineConfig) -> int:
    """Frame up to which people must be tracked for the window that ends at `stop`.

    It adds half a window, the overlap, the tracker's block and look-ahead, and two spare frames, in
    whole batches. The spare frames are needed because `Engine` compares means over the cameras'
    times, which are rounded differently, at two borders.
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
    """The windows of a chunk, with people tracked from `chunk.first` on."""
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
    """Tracks in the frames on both sides of a border: N rows."""

    frame: Annotated[Index, Column("N", np.intp)]
    """(N,) frame of each row."""
    track: Annotated[Index, Column("N", np.intp)]
    """(N,) track of each row, by its number in one of the chunks."""
    candidate: Annotated[Index, Column("N J V", np.intp)]
    """(N, J, V) detections of the row; -1 for none."""
    place: Annotated[Array, Column("N J 3", unit="m")]
    """(N, J, 3) predicted joints, metres; NaN where there is no prediction."""

    @classmethod
    def of(cls, span: Span) -> "Border":
        """The rows of a window, including the frames of its overlap."""
        rows = Observations.concatenate([rows for _, rows in span.decided])
        return cls(rows.frame, rows.track, rows.candidate, rows.initial)


def same_people(before: Border, after: Border) -> dict[int, int]:
    """Match tracks of `after` one-to-one with the same people in `before`.

    Tracks match by common detections in common frames; tracks without detections by their predicted
    joints.
    """
    shared = np.intersect1d(before.frame, after.frame)
    before, after = (each.rows(np.isin(each.frame, shared)) for each in (before, after))
    old, new = np.unique(before.track), np.unique(after.track)
    similarity = np.zeros((len(old), len(new)))
    for i, a in enumerate(old):
        rows_before = before.rows(before.track == a)
        similarity[i] = [_alike(rows_before, after.rows(after.track == b)) for b in new]
    rows, columns = least_cost_pairs(-similarity)
    return {
        int(new[k]): int(old[i]) for i, k in zip(rows, columns, strict=True) if similarity[i, k] > 0
    }


def _alike(a: Border, b: Border) -> float:
    """Similarity of two tracks: 0 for different people, up to 1 for tracks without detections that
    are near each other, and 1 to 2 for tracks with the same detections.
    """
    _, first, second = np.intersect1d(a.frame, b.frame, return_indices=True)
    if len(first) == 0:
        return 0.0
    detections_a, detections_b = a.candidate[first], b.candidate[second]
    count = min(int((detections_a >= 0).sum()), int((detections_b >= 0).sum()))
    if count > 0:
        share = int(((detections_a == detections_b) & (detections_a >= 0)).sum()) / count
        return 1.0 + share if share >= _SAME else 0.0
    distance_m = np.linalg.norm(a.place[first] - b.place[second], axis=-1)
    distance_m = distance_m[np.isfinite(distance_m)]
    return (
        1.0 - float(distance_m.mean()) / _NEAR_M
        if len(distance_m) > 0 and distance_m.mean() < _NEAR_M
        else 0.0
    )


class Identities:
    """Assigns identities to the tracks of consecutive chunks, consistently over chunks."""

    def __init__(self, next_id: int, border: Border | None) -> None:
        """`next_id` is the next free identity, `border` the tracks at the end of the chunk
        before.
        """
        self.next_id = next_id
        self.border = border

    def names(self, begins: Border, *, isolated: bool) -> dict[int, int]:
        """Identities of tracks that continue one of the chunk before; empty if frames
        are `isolated`.
        """
        return {} if isolated or self.border is None else same_people(self.border, begins)

    def name(self, track: int, names: dict[int, int]) -> int:
        """Identity of a track; a track without one gets the next free one."""
        if track not in names:
            names[track] = self.next_id
            self.next_id += 1
        return names[track]

    def remember(self, ends: Border, names: dict[int, int]) -> None:
        """Store the tracks at the end of a chunk."""
        track = [self.name(each, names) for each in ends.track.tolist()]
        self.border = replace(ends, track=np.array(track, dtype=np.intp))
