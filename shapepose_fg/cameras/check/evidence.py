"""Evidence of the check: people seen in some frames of a recording, and the assumed cameras."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from shapepose_fg.cameras.resection import Others, match, possible_matches
from shapepose_fg.cameras.sightings import (
    GATE,
    MOST_FRAMES,
    Groups,
    Pairs,
    Pinhole,
    Sightings,
    distances,
    followed,
    least_of_each,
    median_of,
    median_over,
)
from shapepose_fg.cameras.triangulation import Structure, observed, triangulate
from shapepose_fg.core.arrays import Array, Index
from shapepose_fg.core.camera import Rig, Views
from shapepose_fg.core.detections import DetectionSequence
from shapepose_fg.core.repeated_pictures import WithoutRepeats
from shapepose_fg.core.skeleton import Skeleton

MOST_LAG = 60
"""Maximum time offset searched for, frames; less in a short recording."""
_MOST_PAIRS = 25_000
"""Maximum number of compared pairs of sightings; with more people and cameras fewer frames are
used."""


@dataclass(frozen=True)
class Evidence:
    """The sightings of people, independent of the calibration."""

    anchors: Index
    """(F,) frames used."""
    sightings: Sightings
    """Sightings in the checked frames and their neighbours."""
    around: Index
    """(G,) the frames used whose neighbouring frames have sightings, too."""
    most_lag: int
    """Maximum time offset that can be detected, frames."""
    other_side: Index
    """(J,) core joint on the other side of the body; the joint itself if central."""
    stopped: Array
    """(V,) share of the checked frames in which each camera repeats its previous picture."""

    def thinned(self, frames: int) -> "Evidence":
        """Return the evidence with about `frames` of the frames used."""
        anchors, around = (
            each[:: max(1, len(each) // frames)] for each in (self.anchors, self.around)
        )
        return replace(self, anchors=anchors, around=around)


def gather(detections: DetectionSequence, frames: range, views: int) -> Evidence:
    """Sightings of V cameras, `views`, in frames spread over a recording, without repeated
    pictures.
    """
    count, every = len(frames), 1
    # Maximum number of frames of a recording that is used completely, for time offsets.
    if count <= 600:
        wanted = np.arange(frames.start, frames.stop)
        most = min(MOST_LAG, count // 4)
        spread = np.unique(
            np.linspace(frames.start, frames.stop - 1, min(count, MOST_FRAMES)).astype(np.intp)
        )
    else:
        most = MOST_LAG
        spread = np.unique(
            np.linspace(frames.start + most, frames.stop - 1 - most, MOST_FRAMES).astype(np.intp)
        )
        if (
            sum(len(detections[t]) > 0 for t in spread.tolist()) < MOST_FRAMES // 4
        ):  # people are present only at times
            occupied = np.array(
                [t for t in frames if len(detections[t]) > 0] or [frames.start], dtype=np.intp
            )
            spread = occupied[
                np.unique(np.linspace(0, len(occupied) - 1, MOST_FRAMES).astype(np.intp))
            ]
        # Number of frames of a longer recording with neighbours used.
        every = max(1, MOST_FRAMES // 16)
        near = [np.arange(t - most, t + most + 1) for t in spread[::every]]
        wanted = np.unique(np.concatenate([spread, *near]))
        wanted = wanted[(wanted >= frames.start) & (wanted < frames.stop)]
    around = spread[::every]
    pictures, stopped = WithoutRepeats(detections, views), np.zeros(views)
    sightings = Sightings.of(pictures, wanted.tolist())
    for frame in wanted.tolist():
        stopped[list(pictures.repeated(frame))] += 1 / len(wanted)
    in_frames = sightings.rows(np.isin(sightings.frame, spread))
    _, each = np.unique(in_frames.frame, return_counts=True)
    pairs = int((each * (each - 1) // 2).sum())
    if pairs > _MOST_PAIRS:
        spread = spread[:: -(-pairs // _MOST_PAIRS)]
    return Evidence(spread, sightings, around, most, _other_side(detections.skeleton), stopped)


def _other_side(skeleton: Skeleton) -> Index:
    core, mirror = skeleton.core, skeleton.mirror
    return np.array([core.index(mirror[j]) if mirror[j] in core else n for n, j in enumerate(core)])


@dataclass(frozen=True, eq=False)
class SetupHypothesis:
    """A recording under one hypothesis on its cameras, which changes as mistakes are found."""

    evidence: Evidence
    """The sightings of people."""
    views: Views
    """The V assumed cameras."""
    lag: Index
    """(V,) assumed delay of each camera, frames."""
    _others: dict[tuple[int, ...], Others] = field(init=False, default_factory=dict)

    @classmethod
    def given(cls, evidence: Evidence, rig: Rig) -> "SetupHypothesis":
        """The set-up with the cameras as given by the user."""
        return cls(evidence, Views.of(rig), np.zeros(len(rig), dtype=np.intp))

    def camera(self, view: int) -> Pinhole:
        """One of the assumed cameras."""
        return Pinhole(self.views.K[view], self.views.cTw[view])

    def with_cameras(self, cameras: Mapping[int, Pinhole]) -> "SetupHypothesis":
        """Return the set-up with some cameras replaced."""
        K, cTw = self.views.K.copy(), self.views.cTw.copy()
        for view, camera in cameras.items():
            K[view], cTw[view] = camera.K, camera.cTw
        return replace(self, views=replace(self.views, K=K, cTw=cTw))

    def seeing(self, view: int, change: Callable[[Sightings], Sightings]) -> "SetupHypothesis":
        """Return the set-up with changed detections of one camera."""
        every = self.evidence.sightings
        rows = np.flatnonzero(every.view == view)
        xy, confidence, new = every.xy.copy(), every.confidence.copy(), change(every.rows(rows))
        xy[rows], confidence[rows] = new.xy, new.confidence
        return replace(
            self,
            evidence=replace(self.evidence, sightings=replace(every, xy=xy, confidence=confidence)),
        )

    def later(self, view: int, frames: int) -> "SetupHypothesis":
        """Return the set-up with one camera assumed late by `frames` more."""
        lag = self.lag.copy()
        lag[view] += frames
        return replace(self, lag=lag)

    @cached_property
    def shifted(self) -> Sightings:
        """All sightings, with frames corrected for the delays."""
        every = self.evidence.sightings
        return replace(every, frame=every.frame - self.lag[every.view])

    @cached_property
    def sightings(self) -> Sightings:
        """Sightings in the frames used."""
        return self.shifted.rows(np.isin(self.shifted.frame, self.evidence.anchors))

    @cached_property
    def pairs(self) -> Pairs:
        """Pairs of these sightings that may be one person."""
        return Pairs.of(self.sightings, self.views)

    @property
    def view_count(self) -> int:
        """Number of cameras, V."""
        return len(self.views)

    @property
    def cameras_used(self) -> int:
        """Number of cameras with sightings."""
        return len(np.unique(self.sightings.view))

    def seen_by(self, view: int, every_frame: bool = False) -> Sightings:
        """Sightings of one camera."""
        sightings = self.shifted if every_frame else self.sightings
        return sightings.rows(sightings.view == view)

    def groups(self, without: tuple[int, ...] = ()) -> Groups:
        """People associated without some of the cameras."""
        views = tuple(view for view in range(self.view_count) if view not in without)
        return self.pairs.groups(len(self.sightings), views)

    def structure(self, without: tuple[int, ...] = (), steps: int = 6) -> tuple[Groups, Structure]:
        """People seen by cameras except `without`, with their triangulated joints."""
        groups = self.groups(without)
        return groups, triangulate(*observed(groups, self.sightings), self.views, steps)

    def others(self, *without: int) -> Others:
        """People seen by all cameras except `without`."""
        if without not in self._others:
            groups, structure = self.structure(without, steps=2)
            self._others[without] = Others(groups.frame, structure.points)
        return self._others[without]

    @cached_property
    def scores(self) -> Array:
        """(V,) score of each camera for the people that the others see (`Match.score`)."""
        views = range(self.view_count)
        if self.cameras_used < 3:
            return np.full(self.view_count, self._pair_score)
        return np.array(
            [match(self.others(v), self.seen_by(v), self.camera(v)).score for v in views]
        )

    def score_without_biases(self, view: int) -> float:
        """Score of a camera for the others' people, as `Match.score`, corrected for persistent
        errors of the detector.
        """
        others, seen, camera = self.others(view), self.seen_by(view), self.camera(view)
        person, sighting, error = distances(others.frame, others.points, seen, camera)
        near = least_of_each(person, error)
        near = near[error[near] < 2 * GATE]
        person, sighting = person[near], sighting[near]
        residual = seen.xy[sighting] - camera.project(others.points[person])[0]
        residual /= seen.size_px[sighting][:, None, None]
        identity = followed(others.frame, others.points)[person]
        for each in np.unique(identity).tolist():
            residual[identity == each] -= median_over(residual[identity == each])
        miss = np.linalg.norm(residual, axis=-1)
        left = np.maximum(1 - median_of(miss) / GATE, 0.0)
        return float(left.sum() / max(possible_matches(others.frame, seen.frame), 1))

    @property
    def _pair_score(self) -> float:
        """Score of the only two cameras; 0 for fewer."""
        views = np.unique(self.sightings.view).tolist()
        if len(views) < 2:
            return 0.0
        groups, possible = self.pair(*views)
        return float((1 - groups.error / GATE).sum() / max(possible, 1))

    def pair(self, first: int, second: int) -> tuple[Groups, int]:
        """People seen by two cameras, and the number of possible matches."""
        groups = self.pairs.groups(len(self.sightings), (first, second))
        possible = possible_matches(self.seen_by(first).frame, self.seen_by(second).frame)
        return groups, possible

    @cached_property
    def total(self) -> float:
        """Total score: 1 if every sighting is part of a person without error, 0 if none is."""
        groups, structure = self.structure(steps=3)
        error = np.moveaxis(structure.miss_px / structure.size_px[:, None], 1, 2)
        median = median_of(error)
        quality = np.maximum(1 - median / GATE, 0.0)
        return float(quality[groups.member >= 0].sum() / max(len(self.sightings), 1))
