"""What the check looks at: people seen at some frames of a recording, and the cameras as they are taken to be."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.camera import Rig, Views
from shapepose_fg.core.detections import DetectionSequence
from shapepose_fg.setup_check.fit import Others, Pinhole, match, possible_matches
from shapepose_fg.setup_check.matching import GATE, Groups, Pairs, errors_of, group, median_of, pair_up
from shapepose_fg.setup_check.sightings import Sightings, sightings_of
from shapepose_fg.setup_check.structure import Structure, observed, triangulate

Array = NDArray[np.float64]

ANCHORS = 100
"""Frames that are looked at, spread over the recording."""
_WHOLE = 600
"""A recording of so many frames is looked at whole, for offsets in time."""
_LAG_ANCHORS = 16
"""Of a longer one the neighbours of so many frames are."""
MOST_LAG = 60
"""Largest offset in time that is looked for, frames; less in a short recording."""
_MOST_PAIRS = 25_000
"""Pairs of sightings that are compared at most: with more people and cameras fewer frames are looked at."""


@dataclass(frozen=True)
class Evidence:
    """The people that were seen, whatever the calibration."""

    anchors: NDArray[np.intp]
    """(F,) frames that are looked at."""
    sightings: Sightings
    """At these frames, and at their neighbours."""
    most_lag: int
    """Largest offset in time that can be told."""

    def thinned(self, frames: int) -> "Evidence":
        """The same with fewer frames that are looked at."""
        return replace(self, anchors=self.anchors[:: max(1, len(self.anchors) // frames)])


@dataclass(frozen=True)
class Setup:
    """What the cameras and their detections are thought to be; changed as mistakes are found."""

    views: Views
    """The cameras."""
    lag: NDArray[np.intp]
    """(V,) frames by which each is late."""

    @classmethod
    def given(cls, rig: Rig) -> "Setup":
        """The cameras as the user gives them."""
        return cls(Views.of(rig), np.zeros(len(rig), dtype=np.intp))

    def camera(self, view: int) -> Pinhole:
        """One of the cameras."""
        return Pinhole(self.views.K[view], self.views.cTw[view])

    def with_cameras(self, cameras: Mapping[int, Pinhole]) -> "Setup":
        """The same with other cameras in the place of some."""
        K, cTw = self.views.K.copy(), self.views.cTw.copy()
        for view, camera in cameras.items():
            K[view], cTw[view] = camera.K, camera.cTw
        return replace(self, views=Views(K, cTw))

    def later(self, view: int, frames: int) -> "Setup":
        """The same with one camera known to be late."""
        lag = self.lag.copy()
        lag[view] += frames
        return replace(self, lag=lag)


def gather(detections: DetectionSequence, frames: range) -> Evidence:
    """The people seen at frames spread over a recording."""
    count = len(frames)
    if count <= _WHOLE:
        wanted = np.arange(frames.start, frames.stop)
        most = min(MOST_LAG, count // 4)
        spread = np.unique(np.linspace(frames.start, frames.stop - 1, min(count, ANCHORS)).astype(np.intp))
    else:
        most = MOST_LAG
        spread = np.unique(np.linspace(frames.start + most, frames.stop - 1 - most, ANCHORS).astype(np.intp))
        around = spread[:: max(1, ANCHORS // _LAG_ANCHORS)]
        wanted = np.unique(np.concatenate([spread, *(np.arange(t - most, t + most + 1) for t in around)]))
    sightings = sightings_of(detections, wanted.tolist())
    here = sightings.only(np.isin(sightings.frame, spread))
    _, each = np.unique(here.frame, return_counts=True)
    pairs = int((each * (each - 1) // 2).sum())
    if pairs > _MOST_PAIRS:
        spread = spread[:: -(-pairs // _MOST_PAIRS)]
    return Evidence(spread, sightings, most)


class Look:
    """A recording looked at with one idea of its cameras."""

    def __init__(self, evidence: Evidence, setup: Setup) -> None:
        self.evidence, self.setup = evidence, setup
        self._others: dict[tuple[int, ...], Others] = {}

    def with_views(self, views: Views) -> "Look":
        """The same recording with other cameras."""
        return Look(self.evidence, replace(self.setup, views=views))

    @cached_property
    def shifted(self) -> Sightings:
        """All sightings, at the frames at which they would have been taken without the offsets."""
        every = self.evidence.sightings
        return replace(every, frame=every.frame - self.setup.lag[every.view])

    @cached_property
    def sightings(self) -> Sightings:
        """Those at the frames that are looked at."""
        return self.shifted.only(np.isin(self.shifted.frame, self.evidence.anchors))

    @cached_property
    def pairs(self) -> Pairs:
        """Which of them may be one person."""
        return pair_up(self.sightings, self.setup.views)

    @property
    def view_count(self) -> int:
        """V."""
        return len(self.setup.views)

    @property
    def cameras_used(self) -> int:
        """How many cameras saw anybody."""
        return len(np.unique(self.sightings.view))

    def seen_by(self, view: int, every_frame: bool = False) -> Sightings:
        """What one camera saw."""
        sightings = self.shifted if every_frame else self.sightings
        return sightings.only(sightings.view == view)

    def groups(self, without: tuple[int, ...] = ()) -> Groups:
        """People as they are found without some of the cameras."""
        views = tuple(view for view in range(self.view_count) if view not in without)
        return group(self.pairs, len(self.sightings), views)

    def structure(self, without: tuple[int, ...] = (), steps: int = 6) -> tuple[Groups, Structure]:
        """These people, and where they are."""
        groups = self.groups(without)
        return groups, triangulate(*observed(groups, self.sightings), self.setup.views, steps)

    def others(self, *without: int) -> Others:
        """The people that all cameras but these see."""
        if without not in self._others:
            groups, structure = self.structure(without, steps=2)
            self._others[without] = Others(groups.frame, structure.points)
        return self._others[without]

    @cached_property
    def scores(self) -> Array:
        """(V,) how well each camera fits the people that the others see (`Match.score`)."""
        views = range(self.view_count)
        if self.cameras_used < 3:
            return np.full(self.view_count, self._pair_score)
        return np.array([match(self.others(v), self.seen_by(v), self.setup.camera(v)).score for v in views])

    @property
    def _pair_score(self) -> float:
        """How well two cameras fit each other, where there are no more."""
        views = np.unique(self.sightings.view).tolist()
        if len(views) < 2:
            return 0.0
        _, error, possible = self.pair(*views)
        return float((1 - error / GATE).sum() / max(possible, 1))

    def pair(self, first: int, second: int) -> tuple[Groups, Array, int]:
        """P people that two cameras see, by how much their rays miss (P,), and how many could be matched."""
        groups = group(self.pairs, len(self.sightings), (first, second))
        possible = possible_matches(self.seen_by(first).frame, self.seen_by(second).frame)
        return groups, errors_of(self.pairs, groups, first, second), possible

    @cached_property
    def total(self) -> float:
        """How well everything fits: 1 if every sighting is a person without error, 0 if none is anybody."""
        groups, structure = self.structure(steps=3)
        error = np.linalg.norm(structure.residual, axis=-1) / structure.size_px[:, None]
        median = median_of(np.moveaxis(error, 1, 2), ~np.isnan(np.moveaxis(error, 1, 2)))
        worth = np.maximum(1 - median / GATE, 0.0)
        return float(worth[groups.member >= 0].sum() / max(len(self.sightings), 1))
