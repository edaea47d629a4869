"""Online tracking, one frame after the other: a pure function of the state and the frame.

Tracking, searching and measuring are those of recordings (`tracking/`). Without the future, track
births and deaths are decided by the same evidence as it comes in.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.arrays import Array, Index, Mask, Whole
from shapepose_fg.core.detections import Input
from shapepose_fg.core.observations import Observations
from shapepose_fg.core.rows import Rows
from shapepose_fg.estimation.in_time import WALK_M_S
from shapepose_fg.proposal.nearby import FrameArrays
from shapepose_fg.tracking.identities import observed
from shapepose_fg.tracking.motion_filter import LOST_M
from shapepose_fg.tracking.sides import correct_swaps_now
from shapepose_fg.tracking.stitching import LEAST_ROWS, Ends, StitchingConfig, Trace, stitch
from shapepose_fg.tracking.track_selection import APPEARS_S, LEAST_S, own_evidence, weighed
from shapepose_fg.tracking.tracker import Tracker, Tracks

ON_TRIAL = -1
"""The identity of a track with insufficient evidence."""
_SURE = 0.3
"""Evidence per second above which a new person is reported at once: probability 0.97
(`track_selection.probability`)."""


@dataclass(frozen=True)
class EndedTracks(Rows):
    """G tracks that ended and may be re-identified."""

    identity: Whole
    """(G,) identities."""
    time_s: Array
    """(G,) times of the last detections, seconds."""
    place: Array
    """(G, 3) centre of the core joints when the track ended, metres."""
    bones: Array
    """(G, B) mean length of each bone between core joints, metres; NaN where unknown."""


@dataclass(frozen=True)
class FilterState:
    """The state after a frame: A tracks, and ended ones. Arrays and numbers only, so that it can be
    saved.
    """

    tracks: Tracks
    """States of the tracks' joints."""
    views: Whole
    """(A, J) number of views with a detection of each joint in the last frame."""
    identity: Whole
    """(A,) permanent identities; `ON_TRIAL` for tracks with insufficient evidence."""
    running_s: Array
    """(A,) evidence since the birth of each track, as seconds in which a whole person is seen by
    all views."""
    peak_s: Array
    """(A,) maximum of `running_s` so far."""
    born_s: Array
    """(A,) times of birth, seconds."""
    place: Array
    """(A, 3) centre of the core joints at birth, metres."""
    length_m: Array
    """(A, B) sum of each bone's measured lengths, metres."""
    count: Array
    """(A, B) number of frames in which each bone was measured."""
    gone: EndedTracks
    """Tracks that ended."""
    sought_s: float = -np.inf
    """Time of the last search for new people, s."""
    next_track: int = 0
    """The number of the next track."""
    next_identity: int = 0
    """The identity of the next new person."""

    @property
    def named(self) -> Mask:
        """(A,) mask of the tracks that have an identity."""
        return self.identity != ON_TRIAL

    def rows(self, index: NDArray) -> "FilterState":
        """The state with some of the tracks."""
        own = {name: getattr(self, name)[index] for name in OF_TRACKS}
        return replace(self, tracks=self.tracks.rows(index), **own)


OF_TRACKS = ("views", "identity", "running_s", "peak_s", "born_s", "place", "length_m", "count")
"""Fields of a `FilterState` with one row per track."""


@dataclass(frozen=True)
class Filter:
    """Updates the state with a frame."""

    tracker: Tracker
    """Tracks people and finds new ones, as in recordings."""
    stitching: StitchingConfig
    """Settings of re-identification."""

    @cached_property
    def nobody(self) -> FilterState:
        """The state before the first frame."""
        J, B = (
            len(self.tracker.skeleton),
            self._trace(np.zeros((0, len(self.tracker.skeleton), 3))).bones.shape[1],
        )
        whole, real = np.zeros(0, np.int64), np.zeros(0)
        ended = EndedTracks(whole, real, np.zeros((0, 3)), np.zeros((0, B)))
        per_bone = np.zeros((0, B)), np.zeros((0, B))
        own = np.zeros((0, J), np.int64), whole, real, real, real, np.zeros((0, 3)), *per_bone
        return FilterState(self.tracker.nobody(), *own, ended)

    def step(self, before: FilterState, given: Input) -> tuple[FilterState, Index, Input]:
        """Process the next frame; returns the state, the detections (A, J, V) of its tracks, -1 for
        none, and the frame with left and right corrected.

        Tracks are predicted, detections assigned to them and their states updated; ten times a
        second new people are searched for in the unassigned detections.
        """
        time_s, last_s, tracker = float(given.time_s.mean()), before.tracks.time_s, self.tracker
        tracks, given = correct_swaps_now(tracker, before.tracks, given)
        tracks, candidate = tracker.step(tracks, given.detections, given.rig, time_s)
        now = replace(before, tracks=replace(tracks, time_s=time_s))
        # Maximum duration of a frame's evidence, s, also after a longer gap between
        # frames.
        now, candidate = self._weighed(now, candidate, given, min(max(time_s - last_s, 0.0), 0.1))
        now, candidate = self._without_ended(now, candidate)
        # Interval between searches for new people, seconds.
        if not abs(time_s - now.sought_s) < 0.1:
            now, candidate = self._with_newcomers(now, candidate, given)
        return self._with_names(now), candidate, given

    def placed(self, now: FilterState) -> Array:
        """(A, J, 3) joints, metres; NaN where their uncertainty is too large."""
        joints = now.tracks.joints
        return np.where((joints.sigma_m < LOST_M)[..., None], joints.position, np.nan)

    def observations(self, now: FilterState, candidate: Index, given: Input) -> Observations:
        """The rows of a frame for stage II: its tracks and their detections."""
        return observed(given, candidate, self.placed(now), now.tracks.ids)

    def _weighed(
        self, now: FilterState, candidate: Index, given: Input, lasts_s: float
    ) -> tuple[FilterState, Index]:
        """Update the evidence for each track, and the lengths of its bones, with a frame."""
        if len(now.tracks) == 0:
            return now, candidate
        places, tracker = self.placed(now), self.tracker
        arrays = FrameArrays.of(given.detections, given.rig, tracker.skeleton)
        weight, cost = weighed(
            candidate, places, arrays, tracker.skeleton, now.tracks.global_hypothesis
        )
        running_s = now.running_s + lasts_s * own_evidence(candidate, weight, cost)
        views = (candidate >= 0).sum(axis=2)
        seen = np.where((views >= 2)[..., None], places, np.nan)
        bones = self._trace(seen).bones
        known = np.isfinite(bones)
        return replace(
            now,
            views=views,
            running_s=running_s,
            peak_s=np.maximum(now.peak_s, running_s),
            length_m=now.length_m + np.where(known, bones, 0.0),
            count=now.count + known,
        ), candidate

    def _without_ended(self, now: FilterState, candidate: Index) -> tuple[FilterState, Index]:
        """Remove tracks without recent evidence, and those whose missing evidence costs more than a
        new birth.
        """
        stays = self.tracker.alive(now.tracks) & (now.running_s >= now.peak_s - 2 * APPEARS_S)
        if stays.all():
            return now, candidate
        left = now.rows(~stays & now.named)
        known = left.count >= LEAST_ROWS
        bones = np.where(known, left.length_m / np.maximum(left.count, 1), np.nan)
        centre = self._trace(self.placed(left)).centre
        recent = now.gone.rows(now.tracks.time_s - now.gone.time_s <= self.stitching.longest_gap_s)
        ended = EndedTracks.concatenate(
            [recent, EndedTracks(left.identity, left.tracks.evident_s, centre, bones)]
        )
        # Maximum number of ended tracks that are remembered.
        return replace(now.rows(stays), gone=ended.rows(slice(-256, None))), candidate[stays]

    def _with_newcomers(
        self, now: FilterState, candidate: Index, given: Input
    ) -> tuple[FilterState, Index]:
        """Add tracks of people found in unassigned detections."""
        tracker, tracks = self.tracker, now.tracks
        tracker.search(given.frame)
        places, own = tracker.newcomers(tracks, candidate, given.detections, given.rig)
        now = replace(now, sought_s=tracks.time_s)
        count = len(places)
        if count == 0:
            return now, candidate
        ids, zero = now.next_track + np.arange(count), np.zeros(count, dtype=np.intp)
        new = tracker.at(places, ids, zero, tracks.time_s)
        trace = self._trace(places)
        blank = np.zeros((count, trace.bones.shape[1]))
        # A person whom one frame makes certain has sufficient evidence at once.
        arrays, hypothesis = (
            FrameArrays.of(given.detections, given.rig, tracker.skeleton),
            np.zeros(count, dtype=np.intp),
        )
        evidence = own_evidence(own, *weighed(own, places, arrays, tracker.skeleton, hypothesis))
        running_s = np.where(evidence >= _SURE, LEAST_S, 0.0)
        columns: dict[str, Any] = {
            "views": (own >= 0).sum(axis=2),
            "identity": np.full(count, ON_TRIAL),
            "running_s": running_s,
            "peak_s": running_s,
            "born_s": np.full(count, tracks.time_s),
            "place": trace.centre,
            "length_m": blank,
            "count": blank,
        }
        both = {name: np.concatenate([getattr(now, name), columns[name]]) for name in OF_TRACKS}
        now = replace(
            now, tracks=Tracks.concatenate([tracks, new]), next_track=now.next_track + count, **both
        )
        return now, np.concatenate([candidate, own])

    def _with_names(self, now: FilterState) -> FilterState:
        """Give identities to tracks with sufficient evidence: that of an ended track that fits in
        place, time and build, or a new one.

        A track that may be a re-identification waits until enough bones are measured.
        """
        ready = np.flatnonzero(~now.named & (now.running_s >= LEAST_S))
        if len(ready) == 0:
            return now
        identity, next_identity, ended = now.identity.copy(), now.next_identity, now.gone
        back = self._returned(now, ready) if len(ended.identity) > 0 else {}
        for row in ready.tolist():
            name = back.get(row, ON_TRIAL)
            if name == ON_TRIAL and self._may_be_back(now, row):
                continue
            if name == ON_TRIAL:
                name, next_identity = next_identity, next_identity + 1
            identity[row] = name
        ended = ended.rows(~np.isin(ended.identity, identity))
        return replace(now, identity=identity, next_identity=next_identity, gone=ended)

    def _may_be_back(self, now: FilterState, row: int) -> bool:
        """Whether too few bones are measured to distinguish the track from ended tracks nearby."""
        # Longest time for which a new track that may be a re-identification waits for its bone
        # lengths, s.
        if (
            now.tracks.time_s - now.born_s[row] > 1.0
            or (now.count[row] >= LEAST_ROWS).mean() >= 0.5
        ):
            return False
        gap_s = now.born_s[row] - now.gone.time_s
        apart_m = np.linalg.norm(now.gone.place - now.place[row], axis=1)
        near = (gap_s >= 0) & (gap_s <= self.stitching.longest_gap_s)
        return bool((near & (apart_m <= self.stitching.reach_m + WALK_M_S * gap_s)).any())

    def _returned(self, now: FilterState, ready: Index) -> dict[int, int]:
        """Identities of the rows among `ready` that continue an ended track, found by
        `tracking.stitching`.
        """
        ended, G, R = now.gone, len(now.gone.identity), len(ready)
        bones = np.where(
            now.count[ready] >= LEAST_ROWS,
            now.length_m[ready] / np.maximum(now.count[ready], 1),
            np.nan,
        )
        begin = np.column_stack([now.born_s[ready], np.full(R, now.tracks.time_s)])
        ends = Ends(
            np.arange(G + R),
            np.concatenate([np.column_stack([ended.time_s, ended.time_s]), begin]),
            np.concatenate([ended.place, now.place[ready]])[:, None].repeat(2, axis=1),
            np.concatenate([ended.bones, bones]),
            np.zeros((G + R, 3)),  # a track has been extrapolated when it ends
        )
        names = stitch(ends, self.stitching)
        return {
            int(row): int(ended.identity[names[G + n]])
            for n, row in enumerate(ready)
            if names[G + n] < G
        }

    def _trace(self, places: Array) -> Trace:
        """Centres and bone lengths of people at `places` (A, J, 3)."""
        return Trace.of(0, np.zeros(len(places)), places, self.tracker.skeleton)
