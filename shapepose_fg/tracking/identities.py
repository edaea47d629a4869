"""Decides which people are present in each frame, and their identities over time. Frames are
processed in blocks with a short look-ahead, in bounded memory.

In each block, `global_hypotheses.py` tracks hypotheses of people, `track_selection.py` selects the
tracks that explain most detections, and `_identities` here continues the identities of the last
block. Afterwards `stitching.py` joins tracks of people who were out of sight.
"""

from dataclasses import dataclass, field, replace

import numpy as np

from shapepose_fg.core.arrays import Array, Index
from shapepose_fg.core.assignment import least_cost_pairs
from shapepose_fg.core.bounds import Seconds, Settings
from shapepose_fg.core.detections import Input
from shapepose_fg.core.observations import Observations
from shapepose_fg.core.skeleton import Skeleton
from shapepose_fg.tracking.global_hypotheses import Hypotheses, explained, times_of
from shapepose_fg.tracking.motion_filter import JointStates
from shapepose_fg.tracking.sides import correct_swaps, correct_swaps_now
from shapepose_fg.tracking.track_selection import SelectedTracks, own_evidence
from shapepose_fg.tracking.tracker import Tracker, Tracks, mean_distance

BLOCK_S = 3.0
"""Length of a block, s; long enough that each person is well visible in some of its frames."""
MOST_FRAMES = 256
"""Maximum number of frames in a block at any frame rate; bounds memory."""
_SAME_M = 0.35
"""Mean distance of core joints, m, below which two hypotheses in a frame are the same person."""
_ROUNDS = 3
"""Maximum number of searches for people in an isolated frame, repeated while sides are
exchanged."""


@dataclass(frozen=True)
class FollowingConfig(Settings):
    """Settings of track births and deaths."""

    look_ahead_s: Seconds = 1.0
    """A frame is decided after this much look-ahead, s; until then a lost person may return, and a
    new person may turn out to have been present earlier."""


_UNLIKELY = "too few detections of their own, or present for too short a time"
"""Reason for dropping a person over time."""

Decided = tuple[Input, Observations]
"""A frame and the rows of its people."""


@dataclass(frozen=True)
class FollowState:
    """State carried from frame to frame: people of the last decided keyframe, and the undecided
    frames.
    """

    people: Tracks
    """People of the last decided keyframe; their numbers are identities."""
    next_id: int = 0
    """The identity of the next new person."""
    pending: tuple[Input, ...] = field(default=())
    """Undecided frames, oldest first."""


def follow(
    tracker: Tracker, state: FollowState, new: Input, config: FollowingConfig
) -> tuple[FollowState, list[Decided]]:
    """Add the next frame; returns the frames that are now decided, with their rows,
    oldest first.
    """
    pending = (*state.pending, new)
    keys = [frame for frame in pending if frame.key]
    if not new.key or len(keys) < 2:
        return replace(state, pending=pending), []
    full, lasts_s = len(pending) > MOST_FRAMES, float(new.time_s.mean() - keys[0].time_s.mean())
    if not full and lasts_s < BLOCK_S + config.look_ahead_s:
        return replace(state, pending=pending), []
    times = times_of(keys)
    ends_s = times[-1] - config.look_ahead_s if full else times[0] + BLOCK_S - 1e-6
    own = max(int(np.searchsorted(times, ends_s)), len(keys) // 2 if full else 1)
    return _decide(tracker, replace(state, pending=pending), min(own, len(keys) - 1))


def finish(tracker: Tracker, state: FollowState) -> tuple[FollowState, list[Decided]]:
    """Decide all pending frames, at the end or a cut of the recording; returns them with their
    rows.
    """
    keys = sum(frame.key for frame in state.pending)
    return _decide(tracker, state, keys) if keys > 0 else (state, [])


def _decide(tracker: Tracker, state: FollowState, own: int) -> tuple[FollowState, list[Decided]]:
    """Decide the first `own` pending keyframes; the frames between keyframes get no
    rows for now.
    """
    keys = [n for n, frame in enumerate(state.pending) if frame.key]
    frames, until = [state.pending[n] for n in keys], [*keys, len(state.pending)][own]
    frames = correct_swaps(tracker, frames, state.people)
    found, chosen = explained(tracker, frames, state.people, own - 1)
    rest = found.account.left_over(chosen)
    for start, stop in zip(rest.start.tolist(), rest.stop.tolist(), strict=True):
        tracker.drop(_UNLIKELY, [frame.frame for frame in frames[start : min(stop, own)]])
    chosen = _with_detections(found, chosen, first=len(state.people) == 0, last=own == len(frames))
    identity, next_id = _identities(found, chosen, state.next_id, own, tracker.skeleton)
    rows = {
        keys[t]: _rows(frame, t, found, chosen, identity) for t, frame in enumerate(frames[:own])
    }
    nobody = next(iter(rows.values())).rows(slice(0, 0))
    held = dict(zip(keys, frames, strict=True))
    decided = [
        (held.get(n, frame), rows.get(n, nobody)) for n, frame in enumerate(state.pending[:until])
    ]
    last = chosen.during(own - 1) & (identity >= 0)
    hypothesis = chosen.hypothesis[last]
    time_s = float(frames[own - 1].time_s.mean())
    people = people_at(time_s, identity[last], found.joints.rows(hypothesis))
    return FollowState(people, next_id, state.pending[until:]), decided


def people_at(time_s: float, ids: Index, joints: JointStates) -> Tracks:
    """Tracks of the people `ids` (A,) of the last decided keyframe, at `time_s`, with the states of
    their joints.
    """
    zero = np.zeros(len(ids), dtype=np.intp)
    return Tracks(time_s, ids, zero, joints, np.full(len(ids), time_s))


def _with_detections(
    found: Hypotheses, chosen: SelectedTracks, *, first: bool, last: bool
) -> SelectedTracks:
    """Trim people to their first detection, if nobody precedes the `first` frame, and to their last
    detection, if nothing follows the `last` frame: at these ends, unseen frames would cost less
    than a birth or death.
    """
    frame = np.arange(found.tracked.shape[1])
    seen = (found.candidate[chosen.hypothesis] >= 0).any(axis=(2, 3))
    seen &= (chosen.start[:, None] <= frame) & (frame < chosen.stop[:, None])
    start = np.where(first, seen.argmax(axis=1), chosen.start)
    stop = np.where(last, len(frame) - seen[:, ::-1].argmax(axis=1), chosen.stop)
    return replace(chosen, start=start, stop=stop)


def isolated_frame(tracker: Tracker, given: Input, next_id: int) -> Decided:
    """Process an isolated frame: people found by stage I, numbered from `next_id` on."""
    nobody, none = (
        tracker.nobody(),
        np.zeros((0, len(tracker.skeleton), len(given.rig)), dtype=np.intp),
    )
    for _ in range(_ROUNDS):
        places, candidate = tracker.newcomers(nobody, none, given.detections, given.rig)
        index = np.arange(len(places))
        found = tracker.at(places, index, 0 * index, float(given.time_s.mean()))
        before, given = given, correct_swaps_now(tracker, found, given, followed=False)[1]
        if given is before:
            break
    return given, observed(given, candidate, places, next_id + np.arange(len(places)))


def _rows(
    given: Input, t: int, found: Hypotheses, chosen: SelectedTracks, identity: Index
) -> Observations:
    """The people of a frame as observations; uncertain joints are NaN."""
    index = np.flatnonzero(chosen.during(t) & (identity >= 0))
    hypothesis = chosen.hypothesis[index]
    own = found.candidate[hypothesis, t].astype(np.intp)
    evidence = own_evidence(own, found.weight[hypothesis, t], found.cost[hypothesis, t])
    return observed(given, own, found.places[hypothesis, t], identity[index], evidence)


def observed(
    given: Input, candidate: Index, places: Array, track: Index, evidence: Array | None = None
) -> Observations:
    """Observations of people at `places` (P, J, 3), m, in a frame, with detections (P, J, V), -1
    for none.
    """
    frame, time_s = (
        np.full(len(track), given.frame),
        np.repeat(given.time_s[None], len(track), axis=0),
    )
    columns = {"track": track, "frame": frame, "time_s": time_s, "evidence": evidence}
    return Observations.of(candidate, given.detections, places, **columns)


def _identities(
    found: Hypotheses, chosen: SelectedTracks, next_id: int, own: int, skeleton: Skeleton
) -> tuple[Index, int]:
    """(K,) identity of each chosen person, -1 if present only in later frames; and the next unused
    identity.

    People present in the first frame take the identity of the carried person at the same place,
    others get a new one; `stitching` finds those who return.
    """
    identity = np.full(len(chosen), -1, dtype=np.intp)
    early = np.flatnonzero(chosen.start == 0)
    carried = np.flatnonzero((found.carried >= 0) & found.tracked[:, 0])
    distance_m = core_distance(
        found.places[chosen.hypothesis[early], 0], found.places[carried, 0], skeleton
    )
    for row, column in zip(*least_cost_pairs(np.minimum(distance_m, 2 * _SAME_M)), strict=True):
        if distance_m[row, column] < _SAME_M:
            identity[early[row]] = found.carried[carried[column]]
    new = np.argsort(chosen.start, kind="stable")
    new = new[(chosen.start[new] < own) & (identity[new] < 0)]
    identity[new] = next_id + np.arange(len(new))
    return identity, next_id + len(new)


def core_distance(places: Array, others: Array, skeleton: Skeleton) -> Array:
    """(P, Q) `mean_distance` over core joints only, m."""
    core = list(skeleton.core)
    return mean_distance(places[:, core], others[:, core])
