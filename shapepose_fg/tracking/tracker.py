"""People are followed from frame to frame: predicted, found again in the views, measured; births and deaths.

A track predicts where its joints are; the detections there are its observations, whether or not stage I would have
found the person in this frame. Stage I looks for new people among the detections that no track took.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from shapepose_fg.bounds import Count, Seconds, Settings
from shapepose_fg.camera import Rig, Views
from shapepose_fg.detections import Detections
from shapepose_fg.estimation.linearisation import ObservationConfig, linearise, observation_sigmas, triangulate
from shapepose_fg.observations import Observations
from shapepose_fg.proposal.association import seen_twice
from shapepose_fg.skeleton import Skeleton
from shapepose_fg.tracking.motion_filter import JointStates
from shapepose_fg.tracking.plausibility import torn_joints
from shapepose_fg.tracking.view_assignment import AssignmentConfig, assign

Array = NDArray[np.float64]
FindPeople = Callable[[Detections, Rig, bool], Observations]
"""Stage I of one frame: detections and rig to people; with True, hips that two views saw are enough."""


_LOST_M = 0.2
"""A joint whose predicted place has a larger sigma is lost: it is sought around its parent on the skeleton."""
_TRUSTED_M = 0.1
"""A joint with a smaller sigma is judged by the length of its bones."""
_FOLLOW_S = 0.25
"""Time constant with which the velocity of an unseen joint becomes that of the person."""
_FOLLOW_SIGMA_M = 0.05
"""Sigma from which on a joint counts as unseen in this sense."""
_ITERATIONS = 3
"""How often gates and linearisation are made anew in one frame."""
_MIN_SEEN_TWICE = 4
"""Core joints that two views must see for a frame to count as evidence of the person."""
_APART_M = 0.25
"""A new person's joints are at least this far from any track's, in the mean: nearer is the same person."""
_DOUBLE_M = 0.15
"""Of two tracks whose core joints are nearer in the mean, the younger gets no more evidence."""
_TRIAL_S = 0.25
"""A new track that has not had evidence for nearly all of this time was a phantom."""
_WEAK_TRIAL_S = 0.5
"""The same for a person whose hips two views saw: only time tells one from a crossing of rays."""
_WALK_MPS = 1.0
"""How far off a person is who comes back into view, per second out of sight: people turn and stop."""
_BIRTH_SIGMA_M = 0.04
"""Sigma of a new person's joints as stage I places them."""
_BIRTH_SPEED_MPS = 2.0
"""Sigma of a new person's velocities along each axis."""


@dataclass(frozen=True)
class TrackingConfig(Settings):
    """How people are followed."""

    assignment: AssignmentConfig = field(default_factory=AssignmentConfig)
    """Which detections are a track's."""
    min_new_joints: Count = 6
    """Core joints that two views must see, by detections that no track has, for a new person."""
    patience_s: Seconds = 0.5
    """A track without evidence for longer has ended."""


@dataclass(frozen=True)
class BodyScale:
    """What is known of all people before anybody is seen, in the order of the skeleton's joints."""

    longest_m: Array
    """(J,) the longest distance of a joint to its parent on the skeleton, metres; the root's counts nothing."""
    psd: Array
    """(J,) power spectral density of each joint's acceleration, m²/s³."""


@dataclass(frozen=True)
class TrackerState:
    """All that is carried from frame to frame; arrays only, so that it can be saved."""

    time_s: float
    """Time of the last frame."""
    ids: NDArray[np.intp]
    """(A,) identity of each track."""
    joints: JointStates
    """Where the A people's joints were."""
    born_s: Array
    """(A,) time of each track's first frame."""
    evident_s: Array
    """(A,) time of the last frame with evidence."""
    misses: NDArray[np.intp]
    """(A,) frames without evidence so far."""
    weak: NDArray[np.bool_]
    """(A,) tracks of people whose hips two views saw only, on trial."""
    next_id: int
    """The identity of the next new person."""

    @classmethod
    def start(cls, skeleton: Skeleton, next_id: int = 0) -> "TrackerState":
        """Nobody yet."""
        J, none = len(skeleton), np.zeros(0)
        joints = JointStates(np.zeros((0, J, 6)), np.zeros((0, J, 6, 6)))
        empty = np.zeros(0, dtype=np.intp)
        return cls(-np.inf, empty, joints, none, none, empty, np.zeros(0, dtype=bool), next_id)

    def rows(self, index: NDArray) -> "TrackerState":
        """Some of the tracks."""
        arrays = ("ids", "born_s", "evident_s", "misses", "weak")
        return replace(
            self, joints=self.joints.rows(index), **{name: getattr(self, name)[index] for name in arrays}
        )


@dataclass(frozen=True)
class TrackedFrame:
    """The A tracks of one frame."""

    ids: NDArray[np.intp]
    """(A,) identities."""
    joints: JointStates
    """Where their joints are."""
    candidate: NDArray[np.intp]
    """(A, J, V) the detections that are theirs, -1 for none."""
    evident: NDArray[np.bool_]
    """(A,) whether the frame is evidence of the person."""
    weak: NDArray[np.bool_]
    """(A,) on trial, with hips that two views saw."""

    @property
    def places(self) -> Array:
        """(A, J, 3) joints, metres in the world."""
        return self.joints.position

    @property
    def sigma_m(self) -> Array:
        """(A, J) how surely they are known."""
        return self.joints.sigma_m


@dataclass(frozen=True)
class Tracker:
    """Follows the people of a recording; `step` is a function of its arguments alone."""

    skeleton: Skeleton
    """The detector's joints."""
    scale: BodyScale
    """How large people are, and how fast they change speed."""
    find: FindPeople
    """Stage I, for new people."""
    config: TrackingConfig
    """How people are followed."""
    observation: ObservationConfig
    """How far detections are trusted."""
    weak_births: bool = True
    """Whether people are sought whose hips two views saw."""

    def step(
        self, state: TrackerState, detections: Detections, rig: Rig, time_s: float, *, births: bool = True
    ) -> tuple[TrackerState, TrackedFrame]:
        """The next frame, at `time_s`; earlier than the last where time runs backwards."""
        if len(state.ids) > 0:
            state = replace(state, joints=self._predict(state.joints, time_s - state.time_s))
        state = replace(state, time_s=time_s)
        lost = state.joints.sigma_m > _LOST_M
        joints = self._beside_neighbours(state.joints, lost)
        candidate = self._assign(joints, lost, state.weak, detections, rig)
        joints, candidate = self._measure(joints, lost, candidate, detections, rig)
        evident = self._evident(candidate) & ~self._doubles(joints, state)
        state = replace(
            state,
            joints=joints,
            evident_s=np.where(evident, time_s, state.evident_s),
            misses=state.misses + ~evident,
        )
        if births:
            state, candidate, evident = self._births(state, candidate, evident, detections, rig)
        frame = TrackedFrame(state.ids, state.joints, candidate, evident, state.weak)
        return self._without_the_ended(state), frame

    def _predict(self, joints: JointStates, step_s: float) -> JointStates:
        """Joints `step_s` later; an unseen joint comes to move as the person does."""
        core = list(self.skeleton.core)
        certainty = 1 / joints.sigma_m[:, core, None] ** 2
        person = (joints.velocity[:, core] * certainty).sum(1) / certainty.sum(1)
        decay = np.exp(-abs(step_s) / _FOLLOW_S)
        unseen = (joints.sigma_m > _FOLLOW_SIGMA_M)[..., None]
        following = person[:, None] + decay * (joints.velocity - person[:, None])
        joints = joints.with_velocity(np.where(unseen, following, joints.velocity))
        return joints.predicted(step_s, self.scale.psd)

    def _beside_neighbours(self, joints: JointStates, lost: NDArray[np.bool_]) -> JointStates:
        """Lost joints are put where their parents are, known to a bone's length; a lost root between its hips."""
        if not lost.any():
            return joints
        mean, covariance = joints.mean.copy(), joints.covariance.copy()
        reach = self.scale.longest_m / 1.5  # the sigma of a direction that is not known
        parent, root = np.array(self.skeleton.parents), self.skeleton.root
        hips, row = list(self.skeleton.hips), np.flatnonzero(lost[:, root])
        mean[row, root] = mean[row][:, hips].mean(axis=1)
        covariance[row, root] = covariance[row][:, hips].mean(axis=1)
        for level in self.skeleton.tree_levels[1:]:
            row, column = np.nonzero(lost[:, level])
            joint = level[column]
            above = parent[joint]
            mean[row, joint] = mean[row, above]
            covariance[row, joint] = covariance[row, above]
            covariance[row, joint, :3, 3:] = covariance[row, joint, 3:, :3] = 0.0
            covariance[row, joint, :3, :3] += (reach[joint] ** 2)[:, None, None] * np.eye(3)
            covariance[row, joint, 3:, 3:] += np.eye(3)
        return JointStates(mean, covariance)

    def _assign(
        self,
        joints: JointStates,
        lost: NDArray[np.bool_],
        weak: NDArray[np.bool_],
        detections: Detections,
        rig: Rig,
    ) -> NDArray[np.intp]:
        """(A, J, V) detections of all tracks; those on trial get what the others leave."""
        chosen = np.full((*lost.shape, len(rig)), -1, dtype=np.intp)
        free = np.ones(len(detections), dtype=bool)
        for some in (~weak, weak):
            if not some.any():
                continue
            left = np.flatnonzero(free)
            part = detections if len(left) == len(free) else detections.only(free)
            picked = assign(
                joints.position[some], joints.sigma_m[some], lost[some],
                part, rig, self.skeleton, self.config.assignment,
            )  # fmt: skip
            picked = np.where(picked >= 0, left[picked] if len(left) > 0 else -1, -1)
            chosen[some] = picked
            free[picked[picked >= 0]] = False
        return chosen

    def _measure(
        self,
        joints: JointStates,
        lost: NDArray[np.bool_],
        candidate: NDArray[np.intp],
        detections: Detections,
        rig: Rig,
    ) -> tuple[JointStates, NDArray[np.intp]]:
        """Joints after this frame's observations, and those of them that were kept."""
        if len(joints) == 0:
            return joints, candidate
        seen = Observations.of(candidate, detections, np.where(lost[..., None], np.nan, joints.position))
        views = Views.of(rig)
        sigmas = observation_sigmas(seen, joints.position, views, self.observation, self.skeleton.joints)
        placed = triangulate(seen, views, self.observation)
        at = np.where(np.isfinite(placed), placed, joints.position)
        measured, inlier = joints, candidate >= 0
        for _ in range(_ITERATIONS):
            said = linearise(seen, sigmas, at, views, self.observation)
            toward = np.einsum("...ij,...j->...i", said.information, at - joints.position) - said.gradient
            measured, inlier = joints.updated(said.information, toward), said.inlier
            at = measured.position
        trusted = measured.sigma_m < _TRUSTED_M
        reach_m = self.config.assignment.farthest_m
        torn = torn_joints(at, trusted, inlier.sum(axis=-1), self.scale.longest_m, self.skeleton, reach_m)
        doubt = np.zeros((6, 6))
        doubt[:3, :3] = reach_m**2 * np.eye(3)
        doubted = JointStates(measured.mean, measured.covariance + doubt)
        measured = measured.replaced(torn, doubted)
        return measured, np.where(inlier & ~torn[..., None], candidate, -1)

    def _evident(self, candidate: NDArray[np.intp]) -> NDArray[np.bool_]:
        """(A,) whether enough core joints are seen by two views."""
        return seen_twice(candidate >= 0, self.skeleton).sum(axis=1) >= _MIN_SEEN_TWICE

    def _doubles(self, joints: JointStates, state: TrackerState) -> NDArray[np.bool_]:
        """(A,) tracks that lie on an older one."""
        core = joints.position[:, list(self.skeleton.core)]
        apart = np.linalg.norm(core[:, None] - core[None], axis=-1).mean(axis=-1)
        older = (state.ids[None] < state.ids[:, None]) & ~(state.weak[None] & ~state.weak[:, None])
        return ((apart < _DOUBLE_M) & older).any(axis=1)

    def _births(
        self,
        state: TrackerState,
        candidate: NDArray[np.intp],
        evident: NDArray[np.bool_],
        detections: Detections,
        rig: Rig,
    ) -> tuple[TrackerState, NDArray[np.intp], NDArray[np.bool_]]:
        """New people among the detections that no track has."""
        for weak in (False, True) if self.weak_births else (False,):
            free = np.ones(len(detections), dtype=bool)
            free[candidate[candidate >= 0]] = False
            if not self._enough(detections, free):
                break
            rest = np.flatnonzero(free)
            people = self.find(detections.only(free), rig, weak)
            if len(people) == 0:
                continue
            theirs = np.where(people.candidate >= 0, rest[people.candidate], -1)
            new = seen_twice(theirs >= 0, self.skeleton).sum(axis=1) >= self.config.min_new_joints
            track, person = self._returned(people.initial, new, state, evident)
            if len(track) > 0:
                state = self._revived(state, track, people.initial[person])
                candidate[track], evident[track], new[person] = theirs[person], True, False
            new &= self._apart(people.initial, state)
            state = self._with_new(state, people.initial[new], weak)
            candidate = np.concatenate([candidate, theirs[new]])
            evident = np.append(evident, np.ones(new.sum(), dtype=bool))
        return state, candidate, evident

    def _returned(
        self, places: Array, found: NDArray[np.bool_], state: TrackerState, evident: NDArray[np.bool_]
    ) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Tracks (K,) that lack evidence, and the people `found` (P,) at `places` (P, J, 3) who are these, (K,).

        One-to-one by the distance of their core joints' centres, within what a person walks meanwhile.
        """
        waiting, people = np.flatnonzero(~evident & ~state.weak), np.flatnonzero(found)
        if len(waiting) == 0 or len(people) == 0:
            return np.zeros(0, dtype=np.intp), np.zeros(0, dtype=np.intp)
        core = list(self.skeleton.core)
        known = np.asarray(np.isfinite(places[people][:, core]).all(axis=-1))[..., None]  # (K, C, 1)
        count = np.maximum(known.sum(axis=1), 1)
        centre = np.where(known, places[people][:, core], 0.0).sum(axis=1) / count
        expected = np.where(known, state.joints.position[waiting][:, None, core], 0.0).sum(axis=2) / count
        distance = np.linalg.norm(centre - expected, axis=-1)  # (W, K)
        waited_s = np.abs(state.time_s - state.evident_s[waiting])
        gate_m = _APART_M + _WALK_MPS * waited_s
        # Any pair within its gate counts more than all that can be gained by the distances of others.
        far_m = 1.0 + len(waiting) * gate_m.max()
        first, second = linear_sum_assignment(np.where(distance < gate_m[:, None], distance, far_m))
        near = distance[first, second] < gate_m[first]
        return waiting[first[near]], people[second[near]]

    def _revived(self, state: TrackerState, track: NDArray[np.intp], places: Array) -> TrackerState:
        """Tracks (K,) that go on at `places` (K, J, 3) with evidence; velocities are as if they were new."""
        fresh = self._states_at(places)
        mean, covariance = state.joints.mean.copy(), state.joints.covariance.copy()
        mean[track], covariance[track] = fresh.mean, fresh.covariance
        evident_s, misses = state.evident_s.copy(), state.misses.copy()
        evident_s[track] = state.time_s
        misses[track] -= 1  # this frame has evidence after all
        return replace(state, joints=JointStates(mean, covariance), evident_s=evident_s, misses=misses)

    def _states_at(self, places: Array) -> JointStates:
        """People at `places` (P, J, 3), whose NaN joints are lost."""
        known = np.asarray(np.isfinite(places).all(axis=-1))
        centre = np.nanmean(places, axis=1, keepdims=True)
        sigma = np.where(known, _BIRTH_SIGMA_M, 2 * _LOST_M)
        return JointStates.at(np.where(known[..., None], places, centre), sigma, _BIRTH_SPEED_MPS)

    def _enough(self, detections: Detections, free: NDArray[np.bool_]) -> bool:
        """Whether the free detections can be a person: enough core joints, each in two views."""
        core = np.zeros(len(self.skeleton), dtype=bool)
        core[list(self.skeleton.core)] = True
        use = free & core[detections.joint]
        views = int(detections.view.max(initial=0)) + 1
        pairs = np.unique(detections.joint[use] * views + detections.view[use])
        twice = np.bincount(pairs // views, minlength=len(self.skeleton)) >= 2
        return int(twice.sum()) >= self.config.min_new_joints

    def _apart(self, places: Array, state: TrackerState) -> NDArray[np.bool_]:
        """(P,) people that stand apart from all tracks; joints that are not placed count nothing."""
        if len(state.ids) == 0 or len(places) == 0:
            return np.ones(len(places), dtype=bool)
        distance = np.linalg.norm(places[:, None] - state.joints.position[None], axis=-1)
        known = np.isfinite(distance)
        mean = np.where(known, distance, 0.0).sum(axis=-1) / np.maximum(known.sum(axis=-1), 1)
        return (mean > _APART_M).all(axis=1)

    def _with_new(self, state: TrackerState, places: Array, weak: bool) -> TrackerState:
        """The tracks and new ones at `places` (P, J, 3), whose NaN joints are lost."""
        count = len(places)
        if count == 0:
            return state
        joints = self._states_at(places)
        now = np.full(count, state.time_s)
        return replace(
            state,
            ids=np.append(state.ids, state.next_id + np.arange(count)),
            joints=JointStates.concatenate(state.joints, joints),
            born_s=np.append(state.born_s, now),
            evident_s=np.append(state.evident_s, now),
            misses=np.append(state.misses, np.zeros(count, dtype=np.intp)),
            weak=np.append(state.weak, np.full(count, weak)),
            next_id=state.next_id + count,
        )

    def _without_the_ended(self, state: TrackerState) -> TrackerState:
        """Tracks go on that had evidence lately; new ones only if hardly a frame lacked it."""
        age_s = np.abs(state.time_s - state.born_s)
        waited_s = np.abs(state.time_s - state.evident_s)
        on_trial = age_s < np.where(state.weak, _WEAK_TRIAL_S, _TRIAL_S)
        ended = (waited_s > self.config.patience_s) | (on_trial & (state.misses >= 3))
        proven = replace(state, weak=state.weak & on_trial)
        return proven.rows(~ended)
