"""From frames to windows: people are tracked, then solved in overlapping windows of frames.

`Engine.follow` maps (frames, state) to (windows, state): it is fast, and memory does not grow with
the recording. Windows are independent of each other, and are solved here or in other processes
(`Setup.solve`).
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from shapepose_fg.core.arrays import Array, Mask
from shapepose_fg.core.camera import Rig
from shapepose_fg.core.detections import Input
from shapepose_fg.core.observations import Observations, window_rows
from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.estimation.window_solution import WindowSolution
from shapepose_fg.pipeline.config import PipelineConfig
from shapepose_fg.pipeline.config import WindowConfig as WindowConfig
from shapepose_fg.pipeline.keyframes import STRAY_M, strays_m
from shapepose_fg.proposal.thinning import thinned
from shapepose_fg.tracking.identities import Decided, FollowState, finish, follow, isolated_frame
from shapepose_fg.tracking.tracker import Tracker


def window_stop(start: int, end: int, frames: int) -> int:
    """End of the window that begins at `start`, of `frames` frames, in a segment that ends before
    `end`.

    The last one is longer by up to half a window, because a window of a few frames would constrain
    its people less.
    """
    stop = start + frames
    return stop if stop + frames // 2 < end else end


def near_border(times_s: Array, border_s: float, overlap_s: float) -> Mask:
    """(T,) mask of frames, at `times_s` (T,), near enough to the border of two windows to be in
    both.
    """
    return np.abs(times_s - border_s) <= overlap_s


@dataclass(frozen=True)
class Span:
    """Frames with assigned detections, to be solved."""

    decided: tuple[Decided, ...]
    """The frames with their rows, including the overlap before and after."""
    start: int
    """Index of the first of `decided` with rows to return."""
    stop: int
    """Index after the last of `decided` with rows to return."""
    isolated: bool = False
    """Whether every frame is solved separately."""
    rig: Rig | None = None
    """The cameras, if they move and their poses arrive with the frames; None if they are known
    beforehand."""

    @property
    def own(self) -> set[int]:
        """The frames with rows to return."""
        return {frame.frame for frame, _ in self.decided[self.start : self.stop]}


@dataclass(frozen=True)
class StreamState:
    """State carried between calls."""

    follow: FollowState
    """The tracks, and the frames without assigned detections."""
    decided: tuple[Decided, ...] = ()
    """Frames to be solved, and before them those that the next window includes."""
    before: int = 0
    """Number of frames of `decided` that have been returned."""


@dataclass(frozen=True)
class Engine:
    """Tracks people through frames, and divides these into windows."""

    tracker: Tracker
    """Tracks people and finds new ones."""
    config: PipelineConfig
    """Settings of tracks and windows."""

    def start(self, next_id: int = 0) -> StreamState:
        """State before the first frame, or after a cut; identities count from `next_id`."""
        return StreamState(FollowState(self.tracker.nobody(), next_id))

    def follow(
        self, state: StreamState, frames: Iterable[Input], *, last: bool = False
    ) -> tuple[list[Span], StreamState]:
        """Track people through `frames`; returns the windows that can be solved now, independently
        in any process.

        With `last`, the recording ends, or is cut, after them.
        """
        tracking, decided = state.follow, list(state.decided)
        for frame in frames:
            tracking, more = follow(self.tracker, tracking, frame, self.config.following)
            decided += more
        if last:
            tracking, more = finish(self.tracker, tracking)
            decided += more
        before, spans = state.before, list[Span]()
        while (cut := self._next(decided, before, last)) is not None:
            stop, end = cut
            spans.append(Span(tuple(decided[:end]), before, stop))
            keep = self._overlap(decided, stop, -1)
            decided, before = decided[keep:], stop - keep
        return spans, StreamState(tracking, tuple(decided), before)

    def isolated_frames(self, frames: Iterable[Input]) -> Span:
        """Put independent frames into one window, because bodies are fitted fastest in batches."""
        decided, people = list[Decided](), 0
        for frame in frames:
            decided.append(isolated_frame(self.tracker, frame, people))
            people += len(decided[-1][1])
        return Span(tuple(decided), 0, len(decided), isolated=True)

    def _next(self, decided: Sequence[Decided], before: int, last: bool) -> tuple[int, int] | None:
        """End of the next window's own frames, and of the window; None with too few frames."""
        stop = window_stop(before, len(decided), self.config.batch_frames)
        if stop < len(decided):
            end = self._overlap(decided, stop, 1)
            if end < len(decided) or last:
                return stop, end
        return (len(decided), len(decided)) if last and len(decided) > before else None

    def _overlap(self, decided: Sequence[Decided], at: int, direction: int) -> int:
        """Index of the frame `shared_s` before or after the border at `at`."""
        times = np.array([frame.time_s.mean() for frame, _ in decided])
        near = near_border(times, times[min(at, len(times) - 1)], self.config.windows.shared_s)
        return int(np.flatnonzero(near)[0]) if direction < 0 else int(np.flatnonzero(near)[-1]) + 1


def halved(
    span: Span, solved: WindowSolution, between: Reconstruction, config: PipelineConfig
) -> list[Span]:
    """Parts of a span to be solved again, with a further keyframe where a joint deviates from its
    interpolation.

    `solved` are the rows of the span's keyframes, `between` includes the interpolated ones.
    """
    frames, rows = [each for each, _ in span.decided], solved.observations
    number, time_s = (
        np.array([each.frame for each in frames]),
        np.array([each.time_s.mean() for each in frames]),
    )
    key, new = np.array([each.key for each in frames]), np.zeros(len(frames), dtype=bool)
    for rows_of_person in window_rows(rows):
        at = np.searchsorted(number, rows.frame[rows_of_person])
        far = (
            strays_m(solved.joints[rows_of_person], solved.velocity[rows_of_person], time_s[at])
            > STRAY_M
        )
        far &= (np.diff(np.cumsum(key)[at]) == 1) & (np.diff(at) > 1)
        new[(at[1:] + at[:-1])[far] // 2] = True
    new[: span.start] = new[span.stop :] = False
    decided = list[Decided]()
    for n, each in enumerate(frames):
        if new[n]:
            interpolated = between.rows(between.frame == each.frame)
            unseen = np.full((*interpolated.joints.shape[:2], len(each.rig)), -1)
            times = {
                "frame": interpolated.frame,
                "time_s": np.repeat(each.time_s[None], len(interpolated), axis=0),
            }
            found = thinned(each.detections, each.rig, config.candidates)[0]
            decided.append((
                replace(each, detections=found, key=True),
                Observations.of(
                    unseen, found, interpolated.joints, track=interpolated.person, **times
                ),
            ))  # fmt: skip
        else:
            decided.append((each, rows.rows(rows.frame == each.frame)))
    # From the keyframe before to the one after each group of nearby new keyframes.
    keys, near_s, spans = np.flatnonzero(key), config.windows.shared_s, list[Span]()
    every = np.flatnonzero(new)
    gaps = np.flatnonzero(np.diff(time_s[every]) > near_s) + 1
    for part in np.split(every, gaps) if len(every) > 0 else ():
        begin, end = keys[np.searchsorted(keys, part[0]) - 1], keys[np.searchsorted(keys, part[-1])]
        first = int(np.searchsorted(time_s, time_s[begin] - near_s - 1e-6))
        until = int(np.searchsorted(time_s, time_s[end] + near_s + 1e-6))
        start, stop = max(int(begin), span.start), min(int(end) + 1, span.stop)
        spans.append(Span(tuple(decided[first:until]), start - first, stop - first, rig=span.rig))
    return spans
