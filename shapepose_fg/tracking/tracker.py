"""Tracking from frame to frame: prediction, assignment of detections in all views, Kalman update.

The detections around a track's predicted joints are its observations, whether or not stage I would
find the person in this frame. Several global hypotheses are tracked at once
(`global_hypotheses.py`). Each is a set of tracks that share no detection, and is independent of the
others.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from factors import CONSTANT_VELOCITY, Motion
from shapepose_fg.body.fitting.fitter import BodyFitter
from shapepose_fg.core.arrays import Array, Index, Mask
from shapepose_fg.core.bounds import Count, Seconds, Settings
from shapepose_fg.core.camera import Rig
from shapepose_fg.core.detections import Detections
from shapepose_fg.core.observations import Observations
from shapepose_fg.core.rows import Rows
from shapepose_fg.core.skeleton import Skeleton
from shapepose_fg.estimation.gated_views import ObservationConfig
from shapepose_fg.proposal.nearby import FrameArrays
from shapepose_fg.proposal.proposals import ProposalConfig
from shapepose_fg.tracking.measuring import MeasurementNoise, measured
from shapepose_fg.tracking.motion_filter import LOST_M, Bones, JointStates, predicted
from shapepose_fg.tracking.view_assignment import Predicted, assign

FindPeople = Callable[[Detections, Rig], Observations]
"""Stage I of one frame: detections and rig to people."""
NoteDropped = Callable[[str, list[int]], None]
"""Records a reason, and the frames in which a person was dropped for it."""


SEARCH_S = 0.3
"""Interval between searches for new people in each global hypothesis, and between comparisons of a
track with a body, s; half that between searches among all detections. In a global hypothesis that
lacks a person, the others take that person's detections, so every global hypothesis is searched: in
crowds with three cameras this finds two to six more people of a hundred."""
_APART_M = 0.25
"""Minimum mean distance of a new person's joints from any track's, m; nearer is the same person."""
_BIRTH_SIGMA_M = 0.04
"""Standard deviation of a new person's joints from stage I, m."""


@dataclass(frozen=True)
class TrackingConfig(Settings):
    """Settings of the tracker."""

    min_new_joints: Count = 4
    """Minimum number of core joints that two views see, by unassigned detections, for a
    new person."""
    patience_s: Seconds = 0.5
    """A track ends after this time without evidence, s."""


@dataclass(frozen=True)
class BodyScale:
    """Prior knowledge of people's size and motion, in the order of the skeleton's joints."""

    longest_m: Array
    """(J,) maximum distance of each joint from its parent on the skeleton, metres; unused for the
    root."""
    density: Array
    """(J,) density of the noise in each joint's motion (`factors.Motion`): of the acceleration,
    m²/s³."""
    motion: Motion = CONSTANT_VELOCITY
    """Motion model of the joints."""


@dataclass(frozen=True)
class Tracks(Rows):
    """The current tracks of all global hypotheses; arrays only, so that they can be saved."""

    time_s: float
    """Time of the last frame, s."""
    ids: Index
    """(A,) number of each track."""
    global_hypothesis: Index
    """(A,) global hypothesis of each track."""
    joints: JointStates
    """(A, J) states of the joints in the last frame."""
    evident_s: Array
    """(A,) time of the last frame with evidence, s."""

    @classmethod
    def none(cls, skeleton: Skeleton, motion: Motion = CONSTANT_VELOCITY) -> "Tracks":
        """No tracks."""
        shape, empty = (0, len(skeleton)), np.zeros(0, dtype=np.intp)
        joints = JointStates.at(np.zeros((*shape, 3)), np.zeros(shape), motion.start)
        return cls(-np.inf, empty, empty, joints, np.zeros(0))


@dataclass(frozen=True)
class Tracker:
    """Tracks the people of a recording; `step` has no state of its own."""

    skeleton: Skeleton
    """The detector's joints."""
    scale: BodyScale
    """Size of people and noise of their motion."""
    find: Sequence[FindPeople]
    """Variants of stage I for new people; each searches what the earlier ones left."""
    config: TrackingConfig
    """Settings of the tracker."""
    observation: ObservationConfig
    """Noise model of the detections."""
    fitter: BodyFitter | None = None
    """Fits bodies to detect left-right swaps (`sides.py`)."""
    drop: NoteDropped = lambda reason, frames: None
    """Called with the reason and the frames when a person is dropped."""
    search: Callable[[int], None] = lambda frame: None
    """Called with each frame in which new people are searched for."""

    def nobody(self) -> Tracks:
        """Tracks of no people."""
        return Tracks.none(self.skeleton, self.scale.motion)

    def step(
        self, tracks: Tracks, detections: Detections, rig: Rig, time_s: float
    ) -> tuple[Tracks, Index]:
        """Advance the tracks to the frame at `time_s` (earlier than the last if time runs
        backwards); returns them and their detections (A, J, V), -1 for none. No track ends here.
        """
        if len(tracks) == 0:
            return replace(tracks, time_s=time_s), np.zeros(
                (0, len(self.skeleton), len(rig)), dtype=np.intp
            )
        arrays, bones = FrameArrays.of(detections, rig, self.skeleton), self._bones
        step_s = time_s - tracks.time_s
        joints, lost = predicted(
            tracks.joints, step_s, self.scale.motion, self.scale.density, bones
        )
        candidate = assign(
            Predicted(joints.position, joints.sigma_m, lost, tracks.global_hypothesis), arrays
        )
        certain = detections.confidence
        weight = np.where(certain > 0, self.observation.weight(certain), 0.0)
        joints, candidate, evident = measured(
            joints, lost, candidate, weight, arrays, self._trust, bones
        )
        evident_s = np.where(evident, time_s, tracks.evident_s)
        return replace(tracks, time_s=time_s, joints=joints, evident_s=evident_s), candidate

    def ahead(self, tracks: Tracks, time_s: float) -> JointStates:
        """Predicted states of the tracks' joints at `time_s`."""
        if len(tracks) == 0:
            return tracks.joints
        step_s = time_s - tracks.time_s
        return predicted(tracks.joints, step_s, self.scale.motion, self.scale.density, self._bones)[
            0
        ]

    @cached_property
    def _bones(self) -> Bones:
        return Bones.of(self.skeleton, self.scale.longest_m)

    @cached_property
    def _trust(self) -> MeasurementNoise:
        return MeasurementNoise.of(self.observation, self.skeleton.joints)

    def alive(self, tracks: Tracks) -> Mask:
        """(A,) tracks with evidence within the last `patience_s`."""
        return np.abs(tracks.time_s - tracks.evident_s) <= self.config.patience_s

    def at(self, places: Array, ids: Index, global_hypothesis: Index, time_s: float) -> Tracks:
        """Tracks of people at `places` (P, J, 3), metres, at `time_s`; joints that are NaN are
        lost.
        """
        known = np.asarray(np.isfinite(places).all(axis=-1))
        count = np.maximum(known.sum(axis=1), 1)[:, None]
        centre = (np.where(known[..., None], places, 0.0).sum(axis=1) / count)[:, None]
        sigma = np.where(known, _BIRTH_SIGMA_M, 2 * LOST_M)
        joints = JointStates.at(
            np.where(known[..., None], places, centre), sigma, self.scale.motion.start
        )
        return Tracks(time_s, ids, global_hypothesis, joints, np.full(len(places), time_s))

    def newcomers(
        self, tracks: Tracks, candidate: Index, detections: Detections, rig: Rig
    ) -> tuple[Array, Index]:
        """New people among the detections not assigned to the `tracks` of one global hypothesis:
        positions (P, J, 3), metres, NaN where unknown, and detections (P, J, V).
        """
        core, J = list(self.skeleton.core), len(self.skeleton)
        places, found, detections_of = (
            tracks.joints.position,
            [np.zeros((0, J, 3))],
            [np.zeros((0, J, len(rig)), np.intp)],
        )
        free = np.ones(len(detections), dtype=bool)
        free[candidate[candidate >= 0]] = False
        for find in self.find:
            many = sum(map(len, found)) >= ProposalConfig.most_people
            if many or not self.enough(detections, free):
                break
            rest = np.flatnonzero(free)
            people = find(detections.only(free), rig)
            own = np.where(people.candidate >= 0, np.append(rest, -1)[people.candidate], -1)
            twice = (own >= 0).sum(axis=2)[:, core] >= 2
            separate = (mean_distance(people.initial, places) > _APART_M).all(axis=1)
            new = separate & (twice.sum(axis=1) >= self.config.min_new_joints)
            found.append(people.initial[new])
            detections_of.append(own[new])
            places = np.concatenate([places, people.initial[new]])
            free[own[new][own[new] >= 0]] = False
        return np.concatenate(found), np.concatenate(detections_of)

    def enough(self, detections: Detections, free: Mask) -> bool:
        """Whether the unassigned detections suffice for a person: enough core joints, each in two
        views.
        """
        core = np.zeros(len(self.skeleton), dtype=bool)
        core[list(self.skeleton.core)] = True
        use = free & core[detections.joint]
        views = int(detections.view.max(initial=0)) + 1
        pairs = np.unique(detections.joint[use] * views + detections.view[use])
        twice = np.bincount(pairs // views, minlength=len(self.skeleton)) >= 2
        return int(twice.sum()) >= self.config.min_new_joints


def mean_distance(places: Array, others: Array) -> Array:
    """(P, Q) mean distance of the joints of people (P, J, 3) from those of others (Q, J, 3),
    metres.

    Infinite if they have no known joint in common.
    """
    distance = np.linalg.norm(places[:, None] - others[None], axis=-1)
    known = np.isfinite(distance)
    mean = np.where(known, distance, 0.0).sum(axis=-1) / np.maximum(known.sum(axis=-1), 1)
    return np.where(known.any(axis=-1), mean, np.inf)
