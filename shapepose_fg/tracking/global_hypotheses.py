"""Multiple-hypothesis tracking through a block of frames: global hypotheses, each tracked from one
frame to both ends.

A global hypothesis is a set of tracks that share no detection. People are
searched for in several frames, tracked from there forwards and backwards, and the tracks that
explain most are selected (`track_selection.py`). The selected people are then joined in one global
hypothesis in the frames that show them best, and tracked again from there, so that they no longer
take each other's detections. Alternatives are sought in the detections that people with evidence
throughout do not use.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import islice

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from shapepose_fg.core.detections import Input
from shapepose_fg.proposal.nearby import FrameArrays
from shapepose_fg.tracking.motion_filter import LOST_M, JointStates
from shapepose_fg.tracking.track_selection import EvidenceTable, SelectedTracks, weighed
from shapepose_fg.tracking.tracker import SEARCH_S, Tracker, Tracks

Array = NDArray[np.float64]

_DUPLICATES_S = 0.1
"""Interval between checks for duplicate global hypotheses, s."""
_RESTART_S = 1.3
"""Interval between the frames from which the selected people are tracked again, s."""
_ROUNDS = 2
"""Maximum number of rounds of tracking again."""
_ALIKE = 0.95
"""Agreement of detections above which two selections count as one. The best selection is tracked
again, and the best different one: on ten simulated recordings, most with three cameras, IDF1 is
95.0 (92.8 without; 95.2 with two others, at twice the time)."""
_PLAIN = 0.25
"""Minimum evidence per second, over any window of `SEARCH_S`, of a person for whom no alternatives
are sought; in simulated crowds, they are found only for people with less."""
_SAME_M = 0.02
"""Maximum distance between joints of two global hypotheses with the same detections for these to
be merged, m."""


@dataclass(frozen=True)
class Hypotheses:
    """H track hypotheses through T frames."""

    carried: NDArray[np.intp]
    """(H,) index of the person of the previous frame that each track continues; -1 for none."""
    global_hypothesis: NDArray[np.intp]
    """(H,) global hypothesis to which each track belongs."""
    tracked: NDArray[np.bool_]
    """(H, T) frames in which each track hypothesis is tracked."""
    candidate: NDArray[np.int32]
    """(H, T, J, V) detections of each track hypothesis, -1 for none."""
    places: Array
    """(H, T, J, 3) positions of the joints, metres; NaN where uncertain."""
    weight: NDArray[np.float32]
    """(H, T, J, V) weight of each detection as evidence (`weighed`)."""
    cost: NDArray[np.float32]
    """(H, T) cost of presence (`weighed`)."""
    joints: JointStates
    """(H, J) states of the joints in the frame from which tracking continues."""
    counts: NDArray[np.intp]
    """(T,) number of detections in each frame."""
    lasts_s: Array
    """(T,) duration that each frame represents, s (`lasting`)."""

    @cached_property
    def account(self) -> EvidenceTable:
        """The hypotheses as weighted detections for the selection."""
        return EvidenceTable.of(
            self.candidate, self.weight, self.cost, self.tracked, self.counts, self.lasts_s
        )

    def __len__(self) -> int:
        return len(self.carried)

    @classmethod
    def concatenate(cls, parts: Sequence["Hypotheses"]) -> "Hypotheses":
        """Concatenate hypotheses; their global hypotheses are renumbered and stay separate."""
        names = ("carried", "tracked", "candidate", "places", "weight", "cost")
        columns = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
        first = np.cumsum([0, *(int(part.global_hypothesis.max(initial=-1)) + 1 for part in parts)])
        columns["global_hypothesis"] = np.concatenate(
            [part.global_hypothesis + n for part, n in zip(parts, first, strict=False)]
        )
        return replace(
            parts[0], **columns, joints=JointStates.concatenate([part.joints for part in parts])
        )


@dataclass(frozen=True)
class Seed:
    """Start of a global hypothesis: its first people and their frame."""

    frame: int
    """Index of the frame; -1 for the one before the first."""
    tracks: Tracks
    """States of the people."""
    candidate: NDArray[np.intp]
    """(A, J, V) detections of the people in this frame."""
    forwards: bool = True
    """Whether to track forwards."""
    backwards: bool = True
    """Whether to track backwards."""
    births: bool = True
    """Whether to search for further people."""


def explained(
    tracker: Tracker, frames: Sequence[Input], carried: Tracks, keep: int
) -> tuple[Hypotheses, SelectedTracks]:
    """Track hypotheses of T frames, and the best selection of them.

    `carried` are the people of the frame before; `keep` is the index of the frame from which
    tracking continues later.
    """
    times, unseen = (
        times_of(frames),
        np.full((len(carried), len(tracker.skeleton), len(frames[0].rig)), -1),
    )
    on, everything = Seed(-1, carried, unseen, backwards=False), RemainingDetections.of(frames)
    found = follow_hypotheses(tracker, everything, [on], keep)
    plain = _plain(found, times)
    if plain.all():
        return found, found.account.choose(found.global_hypothesis)
    remaining = RemainingDetections.of(frames, found.candidate[plain], found.places[plain])
    found = Hypotheses.concatenate(
        [found, follow_hypotheses(tracker, remaining, _seeds(tracker, remaining.frames), keep)]
    )
    before = 0.0
    for _ in range(_ROUNDS):
        best, *others = found.account.ways(found.global_hypothesis, on_trial=True)
        if best.evidence_s.sum() <= before:
            break
        before = float(best.evidence_s.sum())
        unlike = (way for way in others if found.account.agreement(best, way) < _ALIKE)
        ways = (best, *islice(unlike, 1))
        again = [seed for way in ways for seed in _restarts(tracker, frames, times, found, way)]
        found = Hypotheses.concatenate([found, follow_hypotheses(tracker, everything, again, keep)])
    return found, found.account.choose(found.global_hypothesis)


def _plain(found: Hypotheses, times: Array) -> NDArray[np.bool_]:
    """(H,) hypotheses that span all frames with high evidence throughout; all of them, if there is
    only one frame.
    """
    if len(times) == 1:
        return np.ones(len(found), dtype=bool)
    evidence = found.weight.sum(axis=(2, 3)) - found.cost
    frames = min(len(times), max(1, round(SEARCH_S / float(np.median(np.diff(times))))))
    high = sliding_window_view(evidence, frames, axis=1).mean(axis=-1) >= _PLAIN
    return np.asarray(found.tracked.all(axis=1) & high.all(axis=1))


@dataclass(frozen=True)
class RemainingDetections:
    """T frames without the detections of K people, who are tracked already."""

    whole: Sequence[Input]
    """The frames with all detections."""
    frames: Sequence[Input]
    """The frames without the people's detections."""
    index: Sequence[NDArray[np.intp]]
    """Indices, among all detections of each frame, of those that are left; -1 at the end."""
    places: Array
    """(K, T, J, 3) joints of the people, who occlude others, metres; NaN where uncertain."""

    @classmethod
    def of(
        cls,
        frames: Sequence[Input],
        candidate: NDArray[np.int32] | None = None,
        places: Array | None = None,
    ) -> "RemainingDetections":
        """Remove the detections `candidate` (K, T, J, V), -1 for none, of people at `places` from
        the frames; by default, nobody is tracked already.
        """
        if candidate is None or places is None or len(candidate) == 0:
            index = [np.append(np.arange(len(frame.detections)), -1) for frame in frames]
            return cls(frames, frames, index, np.zeros((0, len(frames), 1, 3)))
        left = [
            np.setdiff1d(np.arange(len(frame.detections)), candidate[:, t])
            for t, frame in enumerate(frames)
        ]
        remaining = [
            replace(frame, detections=frame.detections.rows(own))
            for frame, own in zip(frames, left, strict=True)
        ]
        return cls(frames, remaining, [np.append(own, -1) for own in left], places)


def times_of(frames: Sequence[Input]) -> Array:
    """(T,) times of frames, seconds."""
    return np.array([float(frame.time_s.mean()) for frame in frames])


def lasting(times_s: Array) -> Array:
    """(T,) duration that each frame represents, s: up to halfway to its neighbours; 1 for a single
    frame.
    """
    return np.gradient(times_s) if len(times_s) > 1 else np.ones(len(times_s))


def _seeds(tracker: Tracker, frames: Sequence[Input]) -> list[Seed]:
    """Further global hypotheses: one tracked backwards from the last frame, and one from each of
    several frames.
    """
    times, nobody = times_of(frames), tracker.nobody()
    none = np.zeros((0, len(tracker.skeleton), len(frames[0].rig)), dtype=np.intp)
    back = Seed(len(frames) - 1, nobody, none, forwards=False)
    parts = np.array_split(
        np.arange(len(frames)), max(1, round((times[-1] - times[0]) / (2 * SEARCH_S)))
    )
    keys = [int(part[len(part) // 2]) for part in parts if len(part) > 0]
    found = [(key, *_newcomers(tracker, nobody, none, frames[key])) for key in keys]
    return [
        back,
        *(
            _seed(tracker, frames, key, places, own)
            for key, places, own in found
            if len(places) > 0
        ),
    ]


def _newcomers(
    tracker: Tracker, tracks: Tracks, candidate: NDArray[np.intp], frame: Input
) -> tuple[Array, NDArray[np.intp]]:
    """New people in a frame; calls the tracker's `search`."""
    tracker.search(frame.frame)
    return tracker.newcomers(tracks, candidate, frame.detections, frame.rig)


def _seed(
    tracker: Tracker, frames: Sequence[Input], key: int, places: Array, candidate: NDArray[np.intp]
) -> Seed:
    """A global hypothesis of people at `places` (A, J, 3) with their detections in a frame."""
    zero = np.zeros(len(places), dtype=np.intp)
    return Seed(key, tracker.at(places, zero, zero, float(frames[key].time_s.mean())), candidate)


def _restarts(
    tracker: Tracker,
    frames: Sequence[Input],
    times: Array,
    found: Hypotheses,
    chosen: SelectedTracks,
) -> list[Seed]:
    """Global hypotheses of all selected people, each from the frame of a `_RESTART_S` interval that
    shows them best.
    """
    T = len(frames)
    placed = np.isfinite(found.places[chosen.hypothesis]).all(axis=-1).any(axis=-1)
    present = np.array([chosen.during(t) for t in range(T)]).T & placed
    share = found.weight[chosen.hypothesis].sum(axis=(2, 3))
    visibility = np.where(present, share, -0.5).sum(axis=0)
    parts = np.array_split(np.arange(T), min(T, max(1, round((times[-1] - times[0]) / _RESTART_S))))
    seeds = []
    for part in parts:
        key = int(part[visibility[part].argmax()])
        hypotheses = chosen.hypothesis[present[:, key]]
        if len(hypotheses) > 0:
            own = found.candidate[hypotheses, key].astype(np.intp)
            seeds.append(_seed(tracker, frames, key, found.places[hypotheses, key], own))
    return seeds


Followed = tuple[int, Seed, NDArray[np.intp]]
"""A global hypothesis's number, its seed, and the numbers of the people in it."""


def follow_hypotheses(
    tracker: Tracker, remaining: RemainingDetections, seeds: Sequence[Seed], keep: int
) -> Hypotheses:
    """Track all `seeds` forwards and backwards through T frames, in parallel.

    People found on the forward pass are also tracked backwards.
    """
    log, frames = _Log(tracker, remaining, keep), remaining.frames
    given, born = list[Followed](), list[Followed]()
    for hypothesis, seed in enumerate(seeds):
        carried = seed.tracks.ids if seed.frame < 0 else None
        given.append((hypothesis, seed, log.more(len(seed.tracks), hypothesis, carried)))
    for forwards in (True, False):
        part = [each for each in given if (each[1].forwards if forwards else each[1].backwards)]
        born = _follow(tracker, frames, part + born, log, forwards=forwards)
    return log.hypotheses()


def _follow(
    tracker: Tracker,
    frames: Sequence[Input],
    seeds: Iterable[Followed],
    log: "_Log",
    *,
    forwards: bool,
) -> list[Followed]:
    """One pass through the frames, each seed from its frame on; returns the people found on the
    way.
    """
    tracks, births = tracker.nobody(), dict[int, int]()
    born = list[Followed]()
    begins = dict[int, list[tuple[Tracks, NDArray[np.intp]]]]()
    for hypothesis, seed, numbers in seeds:
        place = np.full(len(numbers), hypothesis, dtype=np.intp)
        own = Tracks(seed.tracks.time_s, numbers, place, seed.tracks.joints, seed.tracks.evident_s)
        if seed.births:
            births[hypothesis] = seed.frame
        if seed.frame >= 0:
            begins.setdefault(seed.frame, []).append((own, seed.candidate))
        elif len(own) > 0:
            tracks = own
    looked_s = sought_s = -np.inf
    for t in range(len(frames)) if forwards else range(len(frames) - 1, -1, -1):
        frame = frames[t]
        time_s, candidate = float(frame.time_s.mean()), np.zeros((0, *log.shape), dtype=np.intp)
        if len(tracks) > 0:
            tracks, candidate = tracker.step(tracks, frame.detections, frame.rig, time_s)
            alive = tracker.alive(tracks)
            tracks, candidate = tracks.rows(alive), candidate[alive]
            log.add(t, tracks, candidate)
        tracks = replace(tracks, time_s=time_s)
        for own, detections in begins.get(t, []):
            log.add(t, own, detections)
            tracks, candidate = (
                Tracks.concatenate([tracks, own]),
                np.concatenate([candidate, detections]),
            )
        if abs(time_s - looked_s) < _DUPLICATES_S:
            continue
        looked_s = time_s
        duplicates, same = _duplicates(tracks, candidate)
        if len(duplicates) > 0:
            log.duplicates.append(
                (
                    slice(t + 1, None) if forwards else slice(0, t),
                    tracks.ids[duplicates],
                    tracks.ids[same],
                )
            )
            births = {
                hypothesis: since
                for hypothesis, since in births.items()
                if hypothesis not in tracks.global_hypothesis[duplicates]
            }
            remaining = np.setdiff1d(np.arange(len(tracks)), duplicates)
            tracks, candidate = tracks.rows(remaining), candidate[remaining]
        if abs(time_s - sought_s) < SEARCH_S:
            continue
        sought_s = time_s
        for hypothesis in [
            hypothesis
            for hypothesis, since in births.items()
            if (since <= t if forwards else since >= t)
        ]:
            of_hypothesis = tracks.global_hypothesis == hypothesis
            places, detections = _newcomers(
                tracker, tracks.rows(of_hypothesis), candidate[of_hypothesis], frame
            )
            if len(places) > 0:
                new = tracker.at(
                    places,
                    log.more(len(places), hypothesis),
                    np.full(len(places), hypothesis, dtype=np.intp),
                    time_s,
                )
                log.add(t, new, detections)
                born.append((hypothesis, Seed(t, new, detections, births=False), new.ids))
                tracks, candidate = (
                    Tracks.concatenate([tracks, new]),
                    np.concatenate([candidate, detections]),
                )
    return born


def _duplicates(
    tracks: Tracks, candidate: NDArray[np.intp]
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Rows of `tracks` (A) of duplicate global hypotheses, and the rows of the same people in the
    one that is kept.

    Duplicate global hypotheses have the same detections (A, J, V) and the same positions of placed
    joints.
    """
    duplicates, same = np.zeros(0, dtype=np.intp), np.zeros(0, dtype=np.intp)
    known, kept = tracks.joints.sigma_m < LOST_M, dict[tuple[bytes, ...], NDArray[np.intp]]()
    for hypothesis in np.unique(tracks.global_hypothesis).tolist():
        rows = np.flatnonzero(tracks.global_hypothesis == hypothesis)
        names = [candidate[row].tobytes() for row in rows.tolist()]
        rows = rows[sorted(range(len(names)), key=names.__getitem__)]
        other = kept.setdefault(tuple(sorted(names)), rows)
        distance_m = np.linalg.norm(
            tracks.joints.position[rows] - tracks.joints.position[other], axis=-1
        )
        if other is not rows and (distance_m[known[rows] & known[other]] < _SAME_M).all():
            duplicates, same = np.append(duplicates, rows), np.append(same, other)
    return duplicates, same


class _Log:
    """Collects the states of all tracks in all frames."""

    def __init__(self, tracker: Tracker, remaining: RemainingDetections, keep: int) -> None:
        self.tracker, self.remaining, self.frames, self.keep = (
            tracker,
            remaining,
            remaining.whole,
            keep,
        )
        self.shape = (len(tracker.skeleton), len(remaining.whole[0].rig))
        self.carried, self.global_hypothesis = list[int](), list[int]()
        self.parts = list[tuple[int, NDArray[np.intp], NDArray[np.intp], Array, Array, Array]]()
        self.kept = list[tuple[NDArray[np.intp], JointStates]]()
        self.duplicates = list[
            tuple[slice, NDArray[np.intp], NDArray[np.intp]]
        ]()  # frames, duplicates, kept

    def more(
        self, count: int, hypothesis: int, carried: NDArray[np.intp] | None = None
    ) -> NDArray[np.intp]:
        """Numbers for `count` new people of a global hypothesis."""
        first = len(self.carried)
        self.global_hypothesis += [hypothesis] * count
        self.carried += [-1] * count if carried is None else carried.tolist()
        return np.arange(first, first + count)

    def add(self, t: int, tracks: Tracks, candidate: NDArray[np.intp]) -> None:
        """Record the tracks in frame `t`, with their detections (A, J, V) among the rest."""
        if len(tracks) == 0:
            return
        frame, joints, A = self.frames[t], tracks.joints, len(tracks)
        candidate = self.remaining.index[t][candidate]
        places = np.where((joints.sigma_m < LOST_M)[..., None], joints.position, np.nan)
        arrays = FrameArrays.of(frame.detections, frame.rig, self.tracker.skeleton)
        # The people who are tracked already occlude those of every hypothesis.
        others = self.remaining.places[:, t]
        hypotheses = (
            np.unique(tracks.global_hypothesis) if len(others) > 0 else tracks.global_hypothesis[:0]
        )
        weight, cost = weighed(
            np.concatenate([candidate, np.full((len(hypotheses) * len(others), *self.shape), -1)]),
            np.concatenate([places, *[others] * len(hypotheses)]),
            arrays,
            self.tracker.skeleton,
            np.concatenate([tracks.global_hypothesis, hypotheses.repeat(len(others))]),
        )
        self.parts.append((t, tracks.ids, candidate, places, weight[:A], cost[:A]))
        if t == self.keep:
            self.kept.append((tracks.ids, joints))

    def hypotheses(self) -> Hypotheses:
        """All recorded tracks, as hypotheses."""
        H, T, (J, V) = len(self.carried), len(self.frames), self.shape
        present = np.zeros((H, T), dtype=bool)
        candidate, cost = (
            np.full((H, T, J, V), -1, dtype=np.int32),
            np.zeros((H, T), dtype=np.float32),
        )
        places, weight = np.full((H, T, J, 3), np.nan), np.zeros((H, T, J, V), dtype=np.float32)
        for t, ids, own, at, counts, costs in self.parts:
            present[ids, t], candidate[ids, t], places[ids, t] = True, own, at
            weight[ids, t], cost[ids, t] = counts, costs
        size = 3 * self.tracker.scale.motion.order
        mean, covariance = np.zeros((H, J, size)), np.zeros((H, J, size, size))
        for ids, joints in self.kept:
            mean[ids], covariance[ids] = joints.mean, joints.covariance
        for span, ids, others in reversed(self.duplicates):
            for each in (present, candidate, cost, places, weight):
                each[ids, span] = each[others, span]
            if self.keep in range(T)[span]:
                mean[ids], covariance[ids] = mean[others], covariance[others]
        carried, global_hypothesis = (
            np.array(each, dtype=np.intp) for each in (self.carried, self.global_hypothesis)
        )
        joints = JointStates(mean, covariance)
        counts = np.array([len(frame.detections) for frame in self.frames], dtype=np.intp)
        lasts_s = lasting(times_of(self.frames))
        return Hypotheses(
            carried,
            global_hypothesis,
            present,
            candidate,
            places,
            weight,
            cost,
            joints,
            counts,
            lasts_s,
        )
