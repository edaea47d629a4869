"""People are followed from frame to frame: predicted, found again in the views, measured.

A track predicts where its joints are; the detections there are its observations, whether or not stage I would have
found the person in this frame. Several worlds are followed at once (`worlds.py`): a world is a set of people,
of whom each detection has one; worlds know nothing of each other.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from factors import CONSTANT_VELOCITY, Motion
from shapepose_fg.core.arrays import Array, Index, Mask
from shapepose_fg.core.bounds import Count, Seconds, Settings
from shapepose_fg.core.camera import Rig
from shapepose_fg.core.compiled import kernel
from shapepose_fg.core.detections import Detections
from shapepose_fg.core.observations import Observations
from shapepose_fg.core.skeleton import Skeleton
from shapepose_fg.estimation.linearisation import ObservationConfig
from shapepose_fg.proposal.association import seen_twice
from shapepose_fg.tracking.measuring import measured
from shapepose_fg.tracking.motion_filter import JointStates
from shapepose_fg.tracking.plausibility import torn_joints
from shapepose_fg.tracking.view_assignment import FARTHEST_M, Predicted, assign

FindPeople = Callable[[Detections, Rig], Observations]
"""Stage I of one frame: detections and rig to people."""
NoteDropped = Callable[[str, list[int]], None]
"""Notes down a reason, and the frames in which somebody was not kept for it."""


_LOST_M = 0.2
"""A joint whose predicted place has a larger sigma is lost: it is sought around its parent on the skeleton. A
joint that one view sees is not, however far along the ray it may be."""
_TRUSTED_M = 0.1
"""A joint with a smaller sigma is judged by the length of its bones, and is not lost in the next frame, however
long that is in coming: at 10 frames a second the velocity of a new person's joints alone makes it uncertain by 20
cm."""
_FOLLOW_S = 0.25
"""Time constant with which the velocity of an unseen joint becomes that of the person."""
_FOLLOW_SIGMA_M = 0.05
"""Sigma from which on a joint counts as unseen in this sense."""
_MIN_SEEN_TWICE = 4
"""Core joints that two views must see for a frame to count as evidence of the person."""
_MIN_IN_A_VIEW = 9
"""Core joints of which one view sees enough for the same: more than half of a body is no chance."""
_APART_M = 0.25
"""A new person's joints are at least this far from any track's, in the mean: nearer is the same person."""
_BIRTH_SIGMA_M = 0.04
"""Sigma of a new person's joints as stage I places them."""


@dataclass(frozen=True)
class TrackingConfig(Settings):
    """How people are followed."""

    min_new_joints: Count = 4
    """Core joints that two views must see, by detections that no track has, for a new person."""
    patience_s: Seconds = 0.5
    """A track without evidence for longer has ended."""


@dataclass(frozen=True)
class BodyScale:
    """What is known of all people before anybody is seen, in the order of the skeleton's joints."""

    longest_m: Array
    """(J,) the longest distance of a joint to its parent on the skeleton, metres; the root's counts nothing."""
    density: Array
    """(J,) of the noise in each joint's motion (`factors.Motion`): of the acceleration, m²/s³."""
    motion: Motion = CONSTANT_VELOCITY
    """How joints move."""


@dataclass(frozen=True)
class Tracks:
    """The people who are followed, of all worlds; arrays only, so that they can be saved."""

    time_s: float
    """Time of the last frame."""
    ids: Index
    """(A,) number of each track."""
    world: Index
    """(A,) the world that it is in."""
    joints: JointStates
    """Where the A people's joints were."""
    evident_s: Array
    """(A,) time of the last frame with evidence."""

    @classmethod
    def none(cls, skeleton: Skeleton, motion: Motion = CONSTANT_VELOCITY) -> "Tracks":
        """Nobody."""
        shape, empty = (0, len(skeleton)), np.zeros(0, dtype=np.intp)
        joints = JointStates.at(np.zeros((*shape, 3)), np.zeros(shape), motion.start)
        return cls(-np.inf, empty, empty, joints, np.zeros(0))

    def __len__(self) -> int:
        return len(self.ids)

    def rows(self, index: NDArray) -> "Tracks":
        """Some of the tracks."""
        return Tracks(
            self.time_s, self.ids[index], self.world[index], self.joints.rows(index), self.evident_s[index]
        )

    def joined(self, others: "Tracks") -> "Tracks":
        """These tracks and others, at the time of these."""
        return Tracks(
            self.time_s,
            np.append(self.ids, others.ids),
            np.append(self.world, others.world),
            JointStates.concatenate([self.joints, others.joints]),
            np.append(self.evident_s, others.evident_s),
        )


@dataclass(frozen=True)
class Tracker:
    """Follows the people of a recording; `step` is a function of its arguments alone."""

    skeleton: Skeleton
    """The detector's joints."""
    scale: BodyScale
    """How large people are, and how fast they change speed."""
    find: Sequence[FindPeople]
    """Stage I, for new people: one way after the other, among what those before left over."""
    config: TrackingConfig
    """How people are followed."""
    observation: ObservationConfig
    """How far detections are trusted."""
    drop: NoteDropped = lambda reason, frames: None
    """Is told why somebody was not kept, and in which frames."""
    search: Callable[[int], None] = lambda frame: None
    """Is told in which frame new people are sought."""

    def nobody(self) -> Tracks:
        """Tracks of no people."""
        return Tracks.none(self.skeleton, self.scale.motion)

    def step(self, tracks: Tracks, detections: Detections, rig: Rig, time_s: float) -> tuple[Tracks, Index]:
        """The next frame, at `time_s` (earlier than the last where time runs backwards), and the detections of
        each track (A, J, V), -1 for none. No track ends here.
        """
        before = tracks.joints.across_m
        joints = self.predict(tracks.joints, time_s - tracks.time_s) if len(tracks) > 0 else tracks.joints
        lost = (joints.across_m > _LOST_M) & (before > _TRUSTED_M)
        lost &= ~lost[:, list(self.skeleton.core)].all(axis=1, keepdims=True)  # beside whom would they be sought?
        joints = self.beside_neighbours(joints, lost)
        predicted = Predicted(joints.position, joints.sigma_m, lost, tracks.world)
        candidate = assign(predicted, detections, rig, self.skeleton)
        joints, candidate = self._measure(joints, lost, candidate, detections, rig)
        evident_s = np.where(self.evident(candidate), time_s, tracks.evident_s)
        return replace(tracks, time_s=time_s, joints=joints, evident_s=evident_s), candidate

    def alive(self, tracks: Tracks) -> Mask:
        """(A,) tracks that had evidence lately."""
        return np.abs(tracks.time_s - tracks.evident_s) <= self.config.patience_s

    def at(self, places: Array, ids: Index, world: Index, time_s: float) -> Tracks:
        """People at `places` (P, J, 3), metres, at `time_s`; joints that are NaN are lost."""
        known = np.asarray(np.isfinite(places).all(axis=-1))
        count = np.maximum(known.sum(axis=1), 1)[:, None]
        centre = (np.where(known[..., None], places, 0.0).sum(axis=1) / count)[:, None]
        sigma = np.where(known, _BIRTH_SIGMA_M, 2 * _LOST_M)
        joints = JointStates.at(np.where(known[..., None], places, centre), sigma, self.scale.motion.start)
        return Tracks(time_s, ids, world, joints, np.full(len(places), time_s))

    def newcomers(self, tracks: Tracks, candidate: Index, detections: Detections, rig: Rig) -> tuple[Array, Index]:
        """New people among the detections that the `tracks` of one world do not have: places (P, J, 3), metres,
        with NaN where unknown, and their detections (P, J, V).
        """
        core, J = list(self.skeleton.core), len(self.skeleton)
        there, found, theirs = tracks.joints.position, [np.zeros((0, J, 3))], [np.zeros((0, J, len(rig)), np.intp)]
        free = np.ones(len(detections), dtype=bool)
        free[candidate[candidate >= 0]] = False
        for find in self.find:
            if not self.enough(detections, free):
                break
            rest = np.flatnonzero(free)
            people = find(detections.only(free), rig)
            own = np.where(people.candidate >= 0, np.append(rest, -1)[people.candidate], -1)
            new = (own >= 0).sum(axis=2)[:, core] >= 2
            new = (new.sum(axis=1) >= self.config.min_new_joints) & standing_apart(people.initial, there)
            found.append(people.initial[new])
            theirs.append(own[new])
            there = np.concatenate([there, people.initial[new]])
            free[own[new][own[new] >= 0]] = False
        return np.concatenate(found), np.concatenate(theirs)

    def predict(self, joints: JointStates, step_s: float) -> JointStates:
        """Joints `step_s` later; an unseen joint comes to move as the person does, straight on."""
        core = list(self.skeleton.core)
        certainty = 1 / joints.sigma_m[:, core, None] ** 2
        at_rest = 1 / _TRUSTED_M**2  # what nothing is known of stands still: it must not drift along a ray
        person = (joints.velocity[:, core] * certainty).sum(1) / (certainty.sum(1) + at_rest)
        decay = np.exp(-abs(step_s) / _FOLLOW_S)
        unseen = (joints.sigma_m > _FOLLOW_SIGMA_M)[..., None]
        following = person[:, None] + decay * (joints.velocity - person[:, None])
        fading = np.where(unseen, decay, 1.0) * joints.mean[..., 6:]
        joints = joints.with_derivatives(np.where(unseen, following, joints.velocity), fading)
        return joints.predicted(step_s, self.scale.motion, self.scale.density)

    def beside_neighbours(self, joints: JointStates, lost: Mask) -> JointStates:
        """Lost joints are put where their parents are, known to a bone's length; a lost root between its hips."""
        if not lost.any():
            return joints
        mean, covariance = joints.mean.copy(), joints.covariance.copy()
        reach_m = self.scale.longest_m / 1.5  # the sigma of a direction that is not known
        order, parents = np.concatenate(self.skeleton.tree_levels), np.array(self.skeleton.parents)
        _put_beside(mean, covariance, lost, order, parents, *self.skeleton.hips, reach_m)
        return JointStates(mean, covariance)

    def _measure(
        self, joints: JointStates, lost: Mask, candidate: Index, detections: Detections, rig: Rig
    ) -> tuple[JointStates, Index]:
        """Joints after this frame's observations, and those of them that were kept."""
        joints, inlier = measured(joints, lost, candidate, detections, rig, self.observation, self.skeleton.joints)
        trusted, views = joints.sigma_m < _TRUSTED_M, inlier.sum(axis=-1)
        torn = torn_joints(joints.position, trusted, views, self.scale.longest_m, self.skeleton, FARTHEST_M)
        joints.covariance[torn, :3, :3] += FARTHEST_M**2 * np.eye(3)
        return joints, np.where(inlier & ~torn[..., None], candidate, -1)

    def evident(self, candidate: Index) -> Mask:
        """(A,) whether enough core joints are seen by two views, or by one."""
        seen = candidate >= 0
        in_a_view = seen[:, list(self.skeleton.core)].sum(axis=1).max(axis=1, initial=0)
        return (seen_twice(seen, self.skeleton).sum(axis=1) >= _MIN_SEEN_TWICE) | (in_a_view >= _MIN_IN_A_VIEW)

    def enough(self, detections: Detections, free: Mask) -> bool:
        """Whether the free detections can be a person: enough core joints, each in two views."""
        core = np.zeros(len(self.skeleton), dtype=bool)
        core[list(self.skeleton.core)] = True
        use = free & core[detections.joint]
        views = int(detections.view.max(initial=0)) + 1
        pairs = np.unique(detections.joint[use] * views + detections.view[use])
        twice = np.bincount(pairs // views, minlength=len(self.skeleton)) >= 2
        return int(twice.sum()) >= self.config.min_new_joints


def standing_apart(places: Array, others: Array) -> Mask:
    """(P,) people at `places` (P, J, 3) who stand apart from all `others` (A, J, 3); NaN joints count nothing."""
    distance = np.linalg.norm(places[:, None] - others[None], axis=-1)
    known = np.isfinite(distance)
    mean = np.where(known, distance, 0.0).sum(axis=-1) / np.maximum(known.sum(axis=-1), 1)
    return (mean > _APART_M).all(axis=1)


@kernel
def _put_beside(mean, covariance, lost, order, parents, right, left, reach_m):
    """`Tracker.beside_neighbours` of states (A, J, S), with all joints in `order` (J,), parents first."""
    people, size = len(mean), mean.shape[2]
    for a in range(people):
        for j in order:
            if not lost[a, j]:
                continue
            above = parents[j]
            for i in range(size):
                mean[a, j, i] = mean[a, above, i] if above >= 0 else (mean[a, right, i] + mean[a, left, i]) / 2
                for k in range(size):
                    if above < 0:
                        covariance[a, j, i, k] = (covariance[a, right, i, k] + covariance[a, left, i, k]) / 2
                    else:
                        apart = (i < 3) != (k < 3)
                        covariance[a, j, i, k] = 0.0 if apart else covariance[a, above, i, k]
                if above >= 0:
                    covariance[a, j, i, i] += reach_m[j] ** 2 if i < 3 else 1.0
