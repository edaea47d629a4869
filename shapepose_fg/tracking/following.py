"""From tracked frames to rows: who is real, from when to when; with a short look ahead, in bounded memory."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.bounds import Count, Seconds, Settings
from shapepose_fg.camera import Rig
from shapepose_fg.detections import Detections
from shapepose_fg.observations import Observations
from shapepose_fg.tracking.tracker import TrackedFrame, Tracker, TrackerState


@dataclass(frozen=True)
class FollowingConfig(Settings):
    """What becomes of tracks."""

    look_ahead_s: Seconds = 1.0
    """A frame is decided when this much more has been seen, and `least_frames` with it: whether a new track was a
    phantom, whether a person out of sight comes back, and since when a new person had been there."""
    least_frames: Count = 5
    """Frames with evidence that a track needs; fewer only where the recording ends."""


@dataclass(frozen=True)
class Input:
    """What the cameras give of one frame."""

    frame: int
    """Its number in the recording."""
    time_s: NDArray[np.float64]
    """(V,) when each view was exposed, seconds."""
    detections: Detections
    """What the detector saw."""
    rig: Rig
    """Where the cameras were."""


Decided = tuple[Input, Observations]
"""A frame and the rows of its people."""


@dataclass(frozen=True)
class FollowState:
    """What is carried from frame to frame: the tracks, and the frames that are not decided yet."""

    tracker: TrackerState
    """The tracks at the last frame."""
    pending: tuple[tuple[Input, TrackedFrame], ...] = ()
    """Frames that wait for what comes after them, oldest first."""
    evident: dict[int, int] = field(default_factory=dict)
    """Frames with evidence so far of each track that may still appear."""
    real: frozenset[int] = frozenset()
    """Tracks that are people, of those that may still appear."""


def follow(
    tracker: Tracker, state: FollowState, new: Input, config: FollowingConfig
) -> tuple[FollowState, list[Decided]]:
    """Take in the next frame; returns the rows of the frames that are decided by it, oldest first."""
    carried, tracked = tracker.step(state.tracker, new.detections, new.rig, float(new.time_s.mean()))
    evident = dict(state.evident)
    for track in tracked.ids[tracked.evident].tolist():
        evident[track] = evident.get(track, 0) + 1
    pending = (*state.pending, (new, tracked))
    proven = [
        track
        for track in tracked.ids[~tracked.weak].tolist()
        if track not in state.real and evident.get(track, 0) >= config.least_frames
    ]
    for track in proven:
        pending = _since_when(tracker, pending, track)
    state = FollowState(carried, pending, evident, state.real | frozenset(proven))
    return _decide(state, config, ended=False)


def finish(state: FollowState, config: FollowingConfig) -> tuple[FollowState, list[Decided]]:
    """The rows of all frames that are still open: the recording ends here, or is cut.

    Tracks that had no time to prove themselves count as people where stage I found them by itself.
    """
    last = state.pending[-1][1] if state.pending else None
    untried = set() if last is None else set(last.ids[~last.weak & last.evident].tolist())
    return _decide(replace(state, real=state.real | untried), config, ended=True)


def _decide(state: FollowState, config: FollowingConfig, *, ended: bool) -> tuple[FollowState, list[Decided]]:
    """Rows of the frames at the head of `pending` that are old enough, or of all."""
    pending, rows = list(state.pending), list[Decided]()
    while pending:
        (given, tracked), newest = pending[0], pending[-1][0]
        recent = (newest.time_s - given.time_s).mean() < config.look_ahead_s
        # At three frames a second the look ahead is over before a track can have had its frames with evidence.
        if not ended and (recent or len(pending) < config.least_frames):
            break
        to_come = set[int]()
        for _, later in pending[1:]:
            to_come |= set(later.ids[later.evident].tolist())
        ids = tracked.ids
        kept = np.array([i in state.real for i in ids.tolist()], dtype=bool)
        kept &= tracked.evident | np.isin(ids, list(to_come))
        rows.append((given, _rows(given, tracked, kept)))
        pending.pop(0)
    alive = {i for _, tracked in pending for i in tracked.ids.tolist()} | set(state.tracker.ids.tolist())
    return FollowState(
        state.tracker,
        tuple(pending),
        {track: count for track, count in state.evident.items() if track in alive},
        state.real & alive,
    ), rows


def _rows(given: Input, tracked: TrackedFrame, kept: NDArray[np.bool_]) -> Observations:
    """The tracks `kept` (A,) of a frame as observations; what is not known well is left open."""
    known = np.isfinite(tracked.places).all(axis=-1) & (tracked.sigma_m < _PLACED_M)
    initial = np.where(known[..., None], tracked.places, np.nan)[kept]
    rows = Observations.of(tracked.candidate[kept], given.detections, initial)
    count = int(kept.sum())
    return replace(
        rows,
        track=tracked.ids[kept],
        frame=np.full(count, given.frame),
        time_s=np.repeat(given.time_s[None], count, axis=0),
    )


_PLACED_M = 0.2
"""Sigma of a track's joint that counts as placed: larger, and the views or the body place it."""


def _since_when(
    tracker: Tracker, pending: Sequence[tuple[Input, TrackedFrame]], track: int
) -> tuple[tuple[Input, TrackedFrame], ...]:
    """`pending` with the track followed back in time from its first frame, by detections that nobody has."""
    frames = list(pending)
    first = next(k for k, (_, tracked) in enumerate(frames) if track in tracked.ids)
    if first == 0:
        return tuple(frames)
    given, tracked = frames[-1]
    state = _alone(tracker, tracked, track, float(given.time_s.mean()))
    found: list[tuple[int, TrackedFrame]] = []
    for k in range(len(frames) - 2, -1, -1):
        given, tracked = frames[k]
        others = tracked.candidate[tracked.ids != track]
        free = np.ones(len(given.detections), dtype=bool)
        free[others[others >= 0]] = False
        state, alone = tracker.step(
            state, given.detections.only(free), given.rig, float(given.time_s.mean()), births=False
        )
        if len(state.ids) == 0:
            break
        if k < first:
            left = np.flatnonzero(free)
            candidate = np.where(alone.candidate >= 0, np.append(left, -1)[alone.candidate], -1)
            found.append((k, replace(alone, candidate=candidate)))
    while found and not found[-1][1].evident[0]:
        found.pop()
    for k, alone in found:
        given, tracked = frames[k]
        frames[k] = (given, _joined(tracked, alone))
    return tuple(frames)


def _alone(tracker: Tracker, tracked: TrackedFrame, track: int, time_s: float) -> TrackerState:
    """A state with one track, as it is in a frame."""
    row = tracked.ids == track
    start = TrackerState.start(tracker.skeleton)
    now = np.array([time_s])
    return replace(
        start,
        time_s=time_s,
        ids=tracked.ids[row],
        joints=tracked.joints.rows(row),
        born_s=now,
        evident_s=now,
        misses=np.zeros(1, dtype=np.intp),
        weak=np.zeros(1, dtype=bool),
    )


def _joined(first: TrackedFrame, second: TrackedFrame) -> TrackedFrame:
    """The tracks of both in one frame."""
    return TrackedFrame(
        np.append(first.ids, second.ids),
        type(first.joints).concatenate(first.joints, second.joints),
        np.concatenate([first.candidate, second.candidate]),
        np.append(first.evident, second.evident),
        np.append(first.weak, second.weak),
    )
