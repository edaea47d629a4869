"""Refinement behind the newest frame: windows solved by stage II, in order, here or in other
processes.
"""

from collections import Counter, deque
from concurrent.futures import Future
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from shapepose_fg.core.arrays import Index, Whole
from shapepose_fg.core.camera import Rig
from shapepose_fg.core.detections import Detections, Input
from shapepose_fg.core.observations import Observations
from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.live.cameras import CameraWatch
from shapepose_fg.live.clock import CommonClock
from shapepose_fg.live.filtering import ON_TRIAL, Filter, FilterState
from shapepose_fg.live.views import ViewsInStep
from shapepose_fg.pipeline.runs.parts import Part
from shapepose_fg.pipeline.setup import Setup
from shapepose_fg.pipeline.windows import Span
from shapepose_fg.pipeline.workers import Pool, naming_lost_work


@dataclass
class Slot:
    """A frame, and the state after it."""

    given: Input
    """The input that is used; its number counts frames in order of arrival."""
    state: FilterState
    """The state after the frame."""
    candidate: Index
    """(A, J, V) detections of the tracks; -1 for none."""
    settled: bool = False
    """Whether the rows of the frame are refined, or being refined."""
    refined: Reconstruction | None = None
    """Rows refined by the newest window that ends here; later frames are tracked from these."""

    @property
    def time_s(self) -> float:
        """Time of the frame, mean over its views, s."""
        return float(self.given.time_s.mean())


@dataclass
class LiveState:
    """All state that frames change, except windows in progress."""

    rig: Rig
    """The cameras, with recent poses of moving ones."""
    watch: CameraWatch
    """Statuses of the cameras."""
    views: ViewsInStep
    """Views that wait for the others of their frame."""
    clock: CommonClock[tuple[Any, ...]]
    """Views that wait until other cameras confirm their time."""
    begin: FilterState
    """The state before the first frame: no tracks, and the next identity."""
    without_pose: Counter[int] = field(default_factory=Counter)
    """By view: the excess of views without a pose over those with one."""
    slots: list[Slot] = field(default_factory=list)
    """The last frames, by time: those not settled, and those that a window includes before them."""
    before: Detections | None = None
    """All detections of the newest frame."""
    settled: deque[Reconstruction] = field(default_factory=deque)
    """Settled rows that were not collected yet."""
    frames: int = 0
    """Number of processed frames; this field and the following are those of `LiveReport`."""
    late: int = 0
    dropped: int = 0
    unrefined: int = 0
    not_taken: int = 0
    jumps: int = 0


@dataclass(frozen=True)
class Refined:
    """A solved window."""

    rows: Reconstruction
    """Rows that the window settles."""
    newest: Reconstruction
    """Rows of the newest frame of the window, from which tracking restarts."""


@dataclass(frozen=True)
class _Sent:
    """A window in progress."""

    part: "Future[Part]"
    frames: Whole
    """(T,) numbers of the frames."""
    names: dict[int, int]
    """Identities of the tracks."""
    own: int
    """Number of frames, from `start` on, that the window settles."""
    start: int


class WindowQueue:
    """Submits windows, and returns their solutions in order."""

    def __init__(self, pool: Pool[Setup], following: Filter) -> None:
        self._pool, self._filter = pool, following
        self._sent = deque[_Sent]()

    @property
    def waiting(self) -> int:
        """Number of windows in progress."""
        return len(self._sent)

    def send(self, window: list[Slot], start: int, own: int, rig: Rig) -> None:
        """Submit a window that settles `own` slots from `start` on, with the cameras of `rig`."""
        names = dict[int, int]()
        for slot in window:
            ids, identities = slot.state.tracks.ids.tolist(), slot.state.identity.tolist()
            names |= {
                track: name for track, name in zip(ids, identities, strict=True) if name != ON_TRIAL
            }
        decided, tracks = [], np.array(sorted(names), dtype=np.int64)
        for n, slot in enumerate(window):
            # Frames are numbered by time, not by arrival.
            given = replace(slot.given, frame=n)
            rows = self._filter.observations(slot.state, slot.candidate, given)
            rows = rows.rows(np.isin(rows.track, tracks))
            # Each window numbers its tracks from 0: graph keys have a limited range, a service may
            # run without end.
            decided.append((given, replace(rows, track=np.searchsorted(tracks, rows.track))))
        rows = Observations.concatenate([each for _, each in decided])
        if len(rows) == 0:
            return
        frames = np.array([slot.given.frame for slot in window])
        part = self._pool.submit(
            Setup.solve, Span(tuple(decided), start, len(decided), rig=rig if rig.moves else None)
        )
        names = {n: names[track] for n, track in enumerate(tracks.tolist())}
        self._sent.append(_Sent(part, frames, names, own, start))

    def came(self, *, wait: bool = False) -> list[Refined]:
        """Windows that were solved since the last call, oldest first; with `wait`, all submitted
        windows.
        """
        found = []
        while len(self._sent) > 0 and (wait or self._sent[0].part.done()):
            sent = self._sent.popleft()
            with naming_lost_work():
                rows = sent.part.result().rows
            at = rows.frame
            person = np.array([sent.names[track] for track in rows.person.tolist()], dtype=np.int64)
            # If two tracks in a frame have one identity (re-identified while still tracked), keep
            # the first.
            _, first = np.unique(np.column_stack([at, person]), axis=0, return_index=True)
            keep, frame = np.sort(first), sent.frames[at]
            table = rows.observations
            if table is not None:
                table = replace(table, frame=frame, person=person)
            rows = replace(rows, frame=frame, person=person, observations=table)
            own, newest = at[keep] < sent.start + sent.own, at[keep] == len(sent.frames) - 1
            found.append(Refined(rows.rows(keep[own]), rows.rows(keep[newest])))
        return found
