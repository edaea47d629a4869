"""Left-right swaps: in some views, detectors exchange a person's sides for a while, or those of
arms, legs or face only.

A person's sides cannot change between two frames. A 2D person with sides unlike those of the track
is corrected if another view has the sides as predicted, or if all views have them exchanged.
Whether the track itself is right is inferred from the body: with arms, legs or face exchanged no
body fits, and with the whole person exchanged knees, feet and nose point backwards. Detections keep
the probability that they are of the other side (`Detections.mirrored`).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import product

import numpy as np

from shapepose_fg.body.fitting.fitter import BodyFitter, JointTargets
from shapepose_fg.core.arrays import Array, Index, Mask
from shapepose_fg.core.detections import Input
from shapepose_fg.core.hidden_markov import state_probabilities
from shapepose_fg.core.skeleton import Skeleton
from shapepose_fg.estimation.draft import MODEL_SIGMA_M
from shapepose_fg.estimation.gated_views import MIN_DEPTH_M
from shapepose_fg.estimation.mirrored_sides import DOUBTED
from shapepose_fg.proposal.people_2d import group_people
from shapepose_fg.tracking.motion_filter import LOST_M, JointStates
from shapepose_fg.tracking.tracker import SEARCH_S, Tracker, Tracks

_NEAR_M = 0.05
"""Standard deviation of a detection from a perfectly predicted joint, as a length at
its depth, m."""
_FARTHEST = 9.0
"""Upper limit of the squared distance, in variances, of one joint."""
_FITS = 3.0
"""Maximum mean squared distance, in variances, between a 2D person and its predicted person."""
_EXCHANGED = 0.02
"""Probability that a view swaps the sides of a person or a part; on Shelf, 22 of 1,573 times."""
_SURE = 6.0
"""Minimum log-odds for correcting a swap. The mean error of three crowds with three cameras is 43
mm with 6, 54 mm with 0, and 40 mm without any swaps in the data. A memory of each view's earlier
swaps makes it worse."""
_AGREES = 0.99
"""Minimum probability with which another view must have a part's sides as predicted to correct a
swap."""
_LOST = 0.001
"""Probability that a track's sides, or a part's, swap from one comparison to the next."""
_NEVER = 1e-4 * _LOST**2
"""Ratio of probabilities below which a state is impossible in a comparison: one in 10,000, even if
the other state costs two swaps."""


@dataclass(frozen=True)
class _Compared:
    """2D people of a frame, matched with the predicted people."""

    groups: Sequence[Index]
    """(G) indices of the detections of each 2D person."""
    person: Index
    """(G,) number of the person that each 2D person matches; -1 for none."""
    log: Array
    """(G, S) log-probability that this view has swapped the sides of each combination of parts
    (`exchanges`) against the prediction."""

    @classmethod
    def of(cls, given: Input, ids: Index, joints: JointStates, skeleton: Skeleton) -> "_Compared":
        """Match the 2D people of a frame with the people `ids` (A,) of predicted `joints` (A)."""
        found, rig, mirror, part = (
            given.detections,
            given.rig,
            np.array(skeleton.mirror),
            paired_parts(skeleton),
        )
        states = exchanges(skeleton)
        if len(ids) == 0:
            return cls((), ids[:0], np.zeros((0, len(states))))
        groups = [group for group in group_people(found) if len(group) >= len(skeleton.core) // 2]
        rows = np.concatenate([np.zeros(0, dtype=np.intp), *groups])
        count = np.array([len(group) for group in groups], dtype=np.intp)
        view, joint = found.view[rows], found.joint[rows]
        xy, depth = rig.project(joints.position)  # (V, A, J, 2), (V, A, J)
        unit_px = (
            rig.focal_px[:, None, None]
            / np.maximum(depth, MIN_DEPTH_M)
            * np.hypot(_NEAR_M, joints.sigma_m)
        )
        # Sums over the joints of each part (G, parts, A), with the sides as they are, or exchanged.
        same, turned = np.zeros((2, len(groups), states.shape[1] + 1, len(ids)))
        for total, each in ((same, joint), (turned, mirror[joint])):
            squared = (xy[view, :, each] - found.xy[rows, None]) / unit_px[view, :, each][..., None]
            squared = np.square(squared).sum(axis=-1)
            squared = np.minimum(np.nan_to_num(squared, nan=_FARTHEST), _FARTHEST)
            np.add.at(total, (np.repeat(np.arange(len(groups)), count), part[joint]), squared)
        apart_of = np.minimum(same, turned).sum(axis=1) / count[:, None]
        number, best = np.arange(len(groups)), apart_of.argmin(axis=1)
        fits = apart_of[number, best] < _FITS
        log = _prior(len(states)) + (same - turned)[number, 1:, best] @ states.T / 2
        log -= np.logaddexp.reduce(log, axis=1, keepdims=True)
        person, log = np.where(fits, ids[best], -1), np.where(fits[:, None], log, 0.0)
        return cls(groups, person, log)

    def exchanged(self, skeleton: Skeleton) -> Mask:
        """(G, K) parts most probably swapped that may be corrected: another view is right, or all
        are swapped.
        """
        states = exchanges(skeleton)
        right = np.exp(self.log) @ ~states > _AGREES
        same = (self.person[:, None] == self.person) & (self.person >= 0)
        certain = self.log.max(axis=1) > self.log[:, 0] + _SURE
        found = states[np.where(certain, self.log.argmax(axis=1), 0)]
        return found & ((same @ right) | ~(same @ ~found) & (same.sum(axis=1, keepdims=True) > 1))

    def of_person(self, number: int) -> Array:
        """(G', S) `log` of the 2D people of one person."""
        return self.log[self.person == number]

    def corrected(
        self, given: Input, own: Mapping[int, tuple[Mask, Array]], skeleton: Skeleton
    ) -> Input:
        """The frame with left-right swaps corrected.

        `own` has, by number, the people who are swapped themselves: which parts (K,), and the
        probability (K,) that this is wrong. All others are assumed to be right.
        """
        found, mirror, part = given.detections, np.array(skeleton.mirror), paired_parts(skeleton)
        wrong, mirrored, right = (
            np.zeros(len(found), dtype=bool),
            found.mirrored.copy(),
            np.zeros(part.max()),
        )
        for group, person, exchanged in zip(
            self.groups, self.person.tolist(), self.exchanged(skeleton), strict=True
        ):
            if person >= 0 and (person in own or exchanged.any()):
                of, (turned, doubt) = part[found.joint[group]], own.get(person, (right, right))
                if person in own:
                    mirrored[group] = np.append(0.0, doubt)[of]
                change = exchanged != turned
                if change.any() and not _doubtful(doubt, skeleton):
                    wrong[group] = np.append(False, change)[of]
        if not wrong.any() and (mirrored == found.mirrored).all():
            return given
        joint = np.where(wrong, mirror[found.joint], found.joint)
        return replace(given, detections=found.with_sides(joint, mirrored, mirror))


@dataclass(frozen=True)
class _CheckedFrame:
    """State of a person in a frame that was checked for swaps."""

    frame: int
    """Index of the frame."""
    time_s: float
    """Time of the frame, s."""
    joints: JointStates
    """(1) states of the person's joints."""
    views: Array
    """(G', S) log-probabilities of swaps in the views (`_Compared.log`)."""


def correct_swaps(tracker: Tracker, frames: Sequence[Input], people: Tracks) -> list[Input]:
    """Correct left-right swaps in consecutive frames; `people` are the people of the
    frame before.
    """
    tracks, sought_s, count = replace(people, ids=np.arange(len(people))), -np.inf, len(people)
    compared, checked = list[_Compared](), dict[int, list[_CheckedFrame]]()
    for n, each in enumerate(frames):
        time_s, skeleton = float(each.time_s.mean()), tracker.skeleton
        seen = _Compared.of(each, tracks.ids, tracker.ahead(tracks, time_s), skeleton)
        frame = seen.corrected(each, {}, skeleton)
        candidate = np.zeros((0, len(skeleton), len(frame.rig)), dtype=np.intp)
        if len(tracks) > 0:
            tracks, candidate = tracker.step(tracks, frame.detections, frame.rig, time_s)
            alive = tracker.alive(tracks)
            tracks, candidate = tracks.rows(alive), candidate[alive]
        if time_s - sought_s >= SEARCH_S:
            sought_s = time_s
            places, _ = tracker.newcomers(tracks, candidate, frame.detections, frame.rig)
            if len(places) > 0:
                new = count + np.arange(len(places))
                others = tracker.at(places, new, 0 * new, time_s)
                tracks, count = (
                    Tracks.concatenate([replace(tracks, time_s=time_s), others]),
                    count + len(new),
                )
                seen = _Compared.of(each, tracks.ids, tracks.joints, skeleton)
        compared.append(seen)
        for row, number in enumerate(tracks.ids.tolist()):
            views, before = seen.of_person(number), checked.get(number, [])
            if not before or time_s - before[-1].time_s >= SEARCH_S:
                checked[number] = [
                    *before,
                    _CheckedFrame(n, time_s, tracks.joints.rows(np.array([row])), views),
                ]
    own = {
        name: _own_sides(tracker, found, followed=name < len(people))
        for name, found in checked.items()
        if any(entry.views.argmax(axis=1).any() for entry in found)
    }
    held = list[Input]()
    for n, (each, seen) in enumerate(zip(frames, compared, strict=True)):
        now = dict[int, tuple[Mask, Array]]()
        for number, (turned, doubt) in own.items():
            at = max(
                int(np.searchsorted([entry.frame for entry in checked[number]], n, side="right"))
                - 1,
                0,
            )
            now[number] = turned[at], doubt[at]
        held.append(seen.corrected(each, now, tracker.skeleton))
    return held


def correct_swaps_now(
    tracker: Tracker, tracks: Tracks, given: Input, *, followed: bool = True
) -> tuple[Tracks, Input]:
    """Correct left-right swaps in the tracks and the next frame; returns both.

    `followed`: people most probably had their sides right before this frame.
    """
    joints, skeleton = tracker.ahead(tracks, float(given.time_s.mean())), tracker.skeleton
    seen, own = _Compared.of(given, tracks.ids, joints, skeleton), dict[int, tuple[Mask, Array]]()
    mean, covariance = tracks.joints.mean.copy(), tracks.joints.covariance.copy()
    for row, number in enumerate(tracks.ids.tolist()):
        views = seen.of_person(number)
        if views.argmax(axis=1).any():
            entry = _CheckedFrame(given.frame, 0.0, joints.rows(np.array([row])), views)
            (turned,), (doubt,) = _own_sides(tracker, [entry], followed=followed)
            own[number], order = (turned, doubt), _order(turned, skeleton)
            if not _doubtful(doubt, skeleton):
                mean[row], covariance[row] = mean[row, order], covariance[row, order]
    return replace(tracks, joints=JointStates(mean, covariance)), seen.corrected(
        given, own, skeleton
    )


def _own_sides(
    tracker: Tracker, checked: Sequence[_CheckedFrame], *, followed: bool
) -> tuple[Mask, Array]:
    """Parts (N, K) that a person has swapped in each checked frame, and probabilities (N, K) that
    this is wrong.

    A hidden Markov model: in each of these frames the person is compared with a body, and with the
    swaps that each state implies for the views. `followed`: the sides were right before.
    """
    states = exchanges(tracker.skeleton)
    order = np.array([_order(state, tracker.skeleton) for state in states])  # (S, J)
    joints = JointStates.concatenate([entry.joints for entry in checked])
    number = np.arange(len(states))
    prior = _prior(len(states))[number ^ number[:, None]]  # view's swaps given person's
    weight = np.array(
        [np.logaddexp.reduce(entry.views[:, None] + prior, axis=2).sum(axis=0) for entry in checked]
    )
    # A body can only lower a weight: none is fitted in states that are impossible anyway.
    first = number == weight.argmax(axis=1)[:, None]
    for possible in (first, ~first):
        weight[weight < weight[first][:, None] + np.log(_NEVER)] = -np.inf
        n, s = np.nonzero(possible & np.isfinite(weight))
        at, sigma_m = joints.position[n[:, None], order[s]], joints.sigma_m[n[:, None], order[s]]
        weight[n, s] += _likeness(at, sigma_m, tracker.fitter)
    turn = np.where(np.eye(len(states), dtype=bool), 1 - _LOST, _LOST)
    likelihood = np.exp(weight - weight.max(axis=1, keepdims=True))[:, None]
    turns = np.broadcast_to(turn, (len(checked) - 1, *turn.shape))
    before = turn[0] if followed else np.ones(len(states))
    probability = state_probabilities(likelihood, before, turns)[0][:, 0]
    best = states[probability.argmax(axis=1)]
    return best, np.einsum("ns,nsk->nk", probability, best[:, None] != states)


def _likeness(places: Array, sigma_m: Array, fitter: BodyFitter | None) -> Array:
    """(N,) log-likelihood of joints at `places` (N, J, 3), metres, with sigma `sigma_m` (N, J), by
    their distance from a fitted body; 0 without a `fitter`.
    """
    if fitter is None:
        return np.zeros(len(places))
    known = sigma_m < LOST_M
    information = (known / np.square(sigma_m))[..., None, None] * np.eye(3)
    squared = np.square(fitter.fit(JointTargets(places, information)).joints - places).sum(axis=-1)
    squared = np.nan_to_num(squared / (np.square(sigma_m) + MODEL_SIGMA_M**2), nan=_FARTHEST)
    return -np.where(known, np.minimum(squared, _FARTHEST), 0.0).sum(axis=-1) / 2


def _doubtful(doubt: Array, skeleton: Skeleton) -> bool:
    """Whether the sides of most joints are uncertain, given the probability (K,) that a part's are
    wrong.

    Joints in the middle count with the last part; counting them as certain is worse in a crowd
    with three cameras. Such a person may mix views, or people, that contradict each other, and is
    not corrected.
    """
    return bool(np.median(doubt[paired_parts(skeleton) - 1]) > DOUBTED)


def _order(exchanged: Array, skeleton: Skeleton) -> Index:
    """(J,) order of the joints with the sides of some parts (K,) exchanged."""
    mirror = np.array(skeleton.mirror)
    return np.where(
        np.append(False, exchanged)[paired_parts(skeleton)], mirror, np.arange(len(mirror))
    )


def _prior(count: int) -> Array:
    """(S,) log probability of each of the `exchanges` in a view."""
    return np.log(np.where(np.arange(count) == 0, 1 - _EXCHANGED, _EXCHANGED / max(count - 1, 1)))


@cache
def exchanges(skeleton: Skeleton) -> Mask:
    """(S, K) all combinations of parts with exchanged sides; entry n is n in binary."""
    return np.array(list(product([False, True], repeat=paired_parts(skeleton).max())))


@cache
def paired_parts(skeleton: Skeleton) -> Index:
    """(J,) number of the part (arms, legs, face) that each joint belongs to; 0 for joints in the
    middle.
    """
    top = np.arange(len(skeleton))
    for level in skeleton.tree_levels[1:]:
        for j in level.tolist():
            above = skeleton.parents[j]
            if skeleton.mirror[above] != above:
                top[j] = top[above]
    mirror = np.array(skeleton.mirror)
    pair = np.where(mirror == np.arange(len(mirror)), -1, np.minimum(top, mirror[top]))
    return np.unique(np.append(-1, pair), return_inverse=True)[1][1:]
