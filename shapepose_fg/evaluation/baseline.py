"""Methods to compare with: 2D people whose rays meet, triangulated and linked, without bodies; stage I alone."""

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d, median_filter
from scipy.optimize import linear_sum_assignment

from shapepose_fg.core.camera import Rig, Views
from shapepose_fg.core.detections import Detections, DetectionSequence
from shapepose_fg.core.observations import Observations
from shapepose_fg.core.skeleton import Skeleton
from shapepose_fg.estimation.linearisation import ObservationConfig, triangulate
from shapepose_fg.evaluation.metrics import PlainPeople
from shapepose_fg.pipeline.pipeline import PipelineConfig, find_people
from shapepose_fg.proposal.assignment import match_best_first
from shapepose_fg.proposal.candidates import CandidateConfig, triangulate_pairs
from shapepose_fg.proposal.people_2d import group_people

Array = NDArray[np.float64]

MIN_JOINTS_2D, MIN_JOINTS_MEET, MIN_SHARE = 5, 3, 0.5
"""Joints of a 2D person; joints of two of them whose rays meet, and as a share of those that both have."""
MEET_M, GATE_M = 0.02, 0.1
"""Rays that pass each other at more do not meet; a detection farther from the projected joint, as a length at the
joint's depth, is not this person's."""
MIN_JOINTS, DUPLICATE_M = 8, 0.25
"""A person with fewer of the core joints, or so near to one with more views, is a false positive."""
NEAREST_M, UNSEEN_S, SHORTEST_S = 0.6, 0.5, 0.3
"""Over time: who is farther from where a person was last is another one; who is unseen for longer ends; who is
there for less is a false positive."""
JUMP_M, GAP_S, SMOOTH_S = 0.15, 1.0, 0.03
"""A joint so far from the median of seven frames is missing; longer gaps stay; sigma of the smoothing Gaussian."""


def frame_by_frame(detections: DetectionSequence, rig: Rig) -> PlainPeople:
    """The people of every frame by itself."""
    placed = [people_in_frame(detections[t], rig, detections.skeleton) for t in range(len(detections))]
    count = [len(each) for each in placed]
    frame, person = np.repeat(np.arange(len(placed)), count), [np.arange(each) for each in count]
    nothing = np.zeros((0, len(detections.skeleton), 3))
    return PlainPeople(frame, np.concatenate([nothing, *placed]), np.concatenate([np.arange(0), *person]))


def initial_proposals(detections: DetectionSequence, rig: Rig, config: PipelineConfig) -> PlainPeople:
    """What stage I by itself makes of every frame: X_0 of Algorithm 1; NaN where no two views agree."""
    found = [find_people(detections[t], rig, detections.skeleton, config) for t in range(len(detections))]
    frame = np.repeat(np.arange(len(found)), [len(people) for people in found])
    return PlainPeople(frame, triangulate(Observations.concatenate(found), Views.of(rig), config.observations))


def people_in_frame(found: Detections, rig: Rig, skeleton: Skeleton) -> Array:
    """(P, J, 3) joints of the people of one frame, metres; NaN where views do not agree."""
    held = _matched(found, rig, len(skeleton))
    held = _nearest(found, _placed(found, held, rig), held, rig)
    joints = _placed(found, held, rig)
    core = np.isfinite(joints[:, skeleton.core]).all(axis=-1).sum(axis=-1)
    kept = list[int]()
    for one in np.argsort(-(held >= 0).sum(axis=(1, 2)), kind="stable").tolist():
        least = _apart(joints[kept], joints[one]).min(initial=np.inf)
        if core[one] >= min(MIN_JOINTS, len(skeleton.core)) and least >= DUPLICATE_M:
            kept.append(one)
    return joints[sorted(kept)]


def _matched(found: Detections, rig: Rig, joints: int) -> NDArray[np.intp]:
    """(P, J, V) detections of people, -1 for none: 2D people merged, those first of whom most rays meet."""
    groups = [members for members in group_people(found) if len(members) >= MIN_JOINTS_2D]
    owner, held = np.full(len(found), -1), np.full((len(groups), joints), -1, dtype=np.intp)
    for number, members in enumerate(groups):
        owner[members], held[number, found.joint[members]] = number, members
    points = triangulate_pairs(found, rig, CandidateConfig(gate_m=MEET_M))
    ends = np.sort(owner[points.pair], axis=1)
    meeting = np.zeros((len(groups), len(groups)))
    np.add.at(meeting, tuple(ends[ends[:, 0] >= 0].T), 1)
    has = (held >= 0).astype(np.float64)
    share = meeting / np.maximum(has @ has.T, 1)
    first, second = np.nonzero((meeting >= MIN_JOINTS_MEET) & (share >= MIN_SHARE))
    view = found.view[held.max(axis=1)] if len(groups) > 0 else np.zeros(0, dtype=np.intp)
    person = np.arange(len(groups))
    order = np.argsort(-(meeting * share)[first, second], kind="stable")
    for a, b in np.column_stack([first, second])[order].tolist():
        one, other = person == person[a], person == person[b]
        if person[a] != person[b] and not np.isin(view[one], view[other]).any():
            person[other] = person[a]
    names, count = np.unique(person, return_counts=True)
    chosen = np.full((len(names), joints, len(rig)), -1, dtype=np.intp)
    chosen[np.searchsorted(names, person), :, view] = held
    return chosen[count >= 2]


def _placed(found: Detections, held: NDArray[np.intp], rig: Rig) -> Array:
    """(P, J, 3) robust triangulation of what people hold (P, J, V)."""
    unknown = np.full((*held.shape[:2], 3), np.nan)
    return triangulate(Observations.of(held, found, unknown), Views.of(rig), ObservationConfig())


def _nearest(found: Detections, joints: Array, held: NDArray[np.intp], rig: Rig) -> NDArray[np.intp]:
    """(P, J, V) the detection nearest to each projected joint, one-to-one; of unplaced joints what is `held`."""
    (P, J, V), (xy, depth) = held.shape, rig.project(joints)
    if P == 0:
        return held
    metres = depth[found.view, :, found.joint] / rig.focal_px[found.view, None]
    distance = np.linalg.norm(xy[found.view, :, found.joint] - found.xy[:, None], axis=-1) * metres
    detection, person = np.nonzero(distance < GATE_M)
    slot = (person * J + found.joint[detection]) * V + found.view[detection]
    picked = match_best_first(slot, detection, -distance[detection, person])
    given = np.where(np.isfinite(joints).all(axis=-1, keepdims=True), -1, held).ravel()
    given[np.isin(given, detection[picked])] = -1
    given[slot[picked]] = detection[picked]
    return given.reshape(held.shape)


def _apart(people: Array, one: Array) -> Array:
    """(P,) mean distance of `one` (J, 3) from each of `people` (P, J, 3); infinite for under three joints."""
    distance = np.linalg.norm(people - one, axis=-1)
    both = np.isfinite(distance)
    mean = np.where(both, distance, 0.0).sum(axis=-1) / np.maximum(both.sum(axis=-1), 1)
    return np.where(both.sum(axis=-1) >= 3, mean, np.inf)


def over_time(people: PlainPeople, fps: float) -> PlainPeople:
    """The same people with identities: rows for every frame from the first to the last of each person."""
    person, parts = _linked(people, fps), list[PlainPeople]()
    for who in np.unique(person):
        rows = np.flatnonzero(person == who)
        if len(rows) < SHORTEST_S * fps:
            continue
        frames = np.arange(people.frame[rows].min(), people.frame[rows].max() + 1)
        joints = np.full((len(frames), *people.joints.shape[1:]), np.nan)
        joints[people.frame[rows] - frames[0]] = people.joints[rows]
        parts.append(PlainPeople(frames, _smoothed(joints, fps), np.full(len(frames), who)))
    parts.append(PlainPeople(people.frame[:0], people.joints[:0], person[:0]))
    names = ("frame", "joints", "person")
    frame, joints, who = (np.concatenate([getattr(part, name) for part in parts]) for name in names)
    order = np.lexsort((who, frame))
    return PlainPeople(frame[order], joints[order], who[order])


def _linked(people: PlainPeople, fps: float) -> NDArray[np.int64]:
    """(N,) an identity for each row: Hungarian from frame to frame, against where each joint was last."""
    person = np.full(len(people.frame), -1, dtype=np.int64)
    last, seen = list[Array](), list[int]()
    for frame in np.unique(people.frame).tolist():
        rows = np.flatnonzero(people.frame == frame)
        going = [who for who in range(len(last)) if frame - seen[who] <= UNSEEN_S * fps]
        cost = np.array([_apart(people.joints[rows], last[who]) for who in going]).reshape(len(going), len(rows))
        for one, other in zip(*linear_sum_assignment(np.minimum(cost, NEAREST_M)), strict=True):
            if cost[one, other] < NEAREST_M:
                person[rows[other]] = going[one]
        for row in rows.tolist():
            if person[row] < 0:
                person[row] = len(last)
                last.append(people.joints[row])
                seen.append(frame)
            who = int(person[row])
            last[who] = np.where(np.isfinite(people.joints[row]), people.joints[row], last[who])
            seen[who] = frame
    return person


def _smoothed(joints: Array, fps: float) -> Array:
    """Joints (T, J, 3) of one person without jumps and short gaps."""
    result, times = joints.copy(), np.arange(len(joints))
    for joint in range(joints.shape[1]):
        there = np.flatnonzero(np.isfinite(joints[:, joint]).all(axis=1))
        if len(there) == 0:
            continue
        median = median_filter(joints[there, joint], size=(7, 1), mode="nearest")
        there = there[np.linalg.norm(joints[there, joint] - median, axis=1) <= JUMP_M]
        placed = np.stack([np.interp(times, there, joints[there, joint, axis]) for axis in range(3)], axis=1)
        placed = gaussian_filter1d(placed, SMOOTH_S * fps, axis=0, mode="nearest")
        after = np.minimum(np.searchsorted(there, times), len(there) - 1)
        before = np.maximum(np.searchsorted(there, times, side="right") - 1, 0)
        inside = (times >= there[0]) & (times <= there[-1]) & (there[after] - there[before] <= GAP_S * fps)
        result[:, joint] = np.where(inside[:, None], placed, np.nan)
    return result
