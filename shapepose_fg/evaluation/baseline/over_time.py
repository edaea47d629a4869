"""The baseline over time: people linked from frame to frame, jumps taken out, gaps closed, joints smoothed."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d, median_filter
from scipy.optimize import linear_sum_assignment

from shapepose_fg.evaluation.baseline.people import FoundPeople

Array = NDArray[np.float64]


@dataclass(frozen=True)
class OverTimeConfig:
    """Settings, chosen on the split `tune`: see docs/evaluation.md."""

    nearest_m: float = 0.6
    """Somebody farther, in the mean over joints, from where a person was last is another one."""
    unseen_s: float = 0.5
    """Somebody who is not seen for longer ends."""
    shortest_s: float = 0.3
    """Who is there for less is a false positive."""
    jump_m: float = 0.15
    """A joint so far from the median of seven frames is missing."""
    gap_s: float = 1.0
    """Longer gaps of a joint are not closed."""
    smooth_s: float = 0.03
    """One sigma of the Gaussian that joints are smoothed with; 0 for none."""


def over_time(people: FoundPeople, fps: float, config: OverTimeConfig | None = None) -> FoundPeople:
    """The same people with identities: rows for every frame from the first to the last of each person."""
    config = OverTimeConfig() if config is None else config
    person = _linked(people, fps, config)
    parts = []
    for who in np.unique(person):
        rows = np.flatnonzero(person == who)
        if len(rows) < config.shortest_s * fps:
            continue
        frames = np.arange(people.frame[rows].min(), people.frame[rows].max() + 1)
        joints = np.full((len(frames), *people.joints.shape[1:]), np.nan)
        joints[people.frame[rows] - frames[0]] = people.joints[rows]
        parts.append((frames, np.full(len(frames), who), _smoothed(joints, fps, config)))
    if len(parts) == 0:
        none = np.zeros(0, dtype=np.int64)
        return FoundPeople(none, none, people.joints[:0], people.joint_names)
    frame, who, joints = (np.concatenate(part) for part in zip(*parts, strict=True))
    order = np.lexsort((who, frame))
    return FoundPeople(frame[order], who[order], joints[order], people.joint_names)


def _linked(people: FoundPeople, fps: float, config: OverTimeConfig) -> NDArray[np.int64]:
    """(N,) an identity for each row: Hungarian from frame to frame, against where each joint was last."""
    person = np.full(len(people), -1, dtype=np.int64)
    last, seen = list[Array](), list[int]()
    for frame in np.unique(people.frame).tolist():
        rows = np.flatnonzero(people.frame == frame)
        going = [who for who in range(len(last)) if frame - seen[who] <= config.unseen_s * fps]
        cost = np.full((len(rows), len(going)), config.nearest_m)
        for column, who in enumerate(going):
            distance = np.linalg.norm(people.joints[rows] - last[who], axis=-1)
            both = np.isfinite(distance)
            mean = np.where(both, distance, 0.0).sum(axis=1) / np.maximum(both.sum(axis=1), 1)
            cost[:, column] = np.where(both.sum(axis=1) >= 3, np.minimum(mean, config.nearest_m), config.nearest_m)
        row, column = linear_sum_assignment(cost)
        for one, other in zip(row.tolist(), column.tolist(), strict=True):
            if cost[one, other] < config.nearest_m:
                person[rows[one]] = going[other]
        for one in rows.tolist():
            joints = people.joints[one]
            if person[one] < 0:
                person[one] = len(last)
                last.append(joints)
                seen.append(frame)
            who = int(person[one])
            last[who], seen[who] = np.where(np.isfinite(joints), joints, last[who]), frame
    return person


def _smoothed(joints: Array, fps: float, config: OverTimeConfig) -> Array:
    """Joints (T, J, 3) of one person without jumps and short gaps."""
    result = joints.copy()
    times = np.arange(len(joints))
    for joint in range(joints.shape[1]):
        known = np.isfinite(joints[:, joint]).all(axis=1)
        if known.sum() < 2:
            continue
        there = times[known]
        median = median_filter(joints[known, joint], size=(7, 1), mode="nearest")
        steady = np.linalg.norm(joints[known, joint] - median, axis=1) <= config.jump_m
        there = there[steady]
        if len(there) < 2:
            continue
        placed = np.stack([np.interp(times, there, joints[there, joint, axis]) for axis in range(3)], axis=1)
        if config.smooth_s > 0:
            placed = gaussian_filter1d(placed, config.smooth_s * fps, axis=0, mode="nearest")
        after = np.searchsorted(there, times)  # the first known frame that is not before
        before = np.maximum(np.searchsorted(there, times, side="right") - 1, 0)
        gap = there[np.minimum(after, len(there) - 1)] - there[before]
        inside = (times >= there[0]) & (times <= there[-1]) & (gap <= config.gap_s * fps)
        result[:, joint] = np.where(inside[:, None], placed, np.nan)
    return result
