"""People around those whom a scene is about: recorded walks along any path, recorded gestures without end."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.body.model.body_model import BodyModel
from shapepose_fg.simulation.gait import left_of
from shapepose_fg.simulation.mocap import Clip, Mocap, blend
from shapepose_fg.simulation.performance import Figure, Performance, about_z, grounded, perform

Array = NDArray[np.float64]

_SEAM_S = 0.5
"""Length of the crossfade from the end of a clip to its beginning."""
_STILL = (
    "basketball signal",
    "directing traffic",
    "washwindow",
    "wash self",
    "laugh",
    "bend over",
    "arms held high",
)
"""What people do who stay where they are, as the recordings name it."""
_STILL_M, _WALK_M = 0.75, 2.5
"""Who stays keeps within this; who walks goes farther."""


def standing_clips(mocap: Mocap, *, without: frozenset[str]) -> list[int]:
    """Clips of people who stand and gesture, of subjects other than `without`."""
    return [
        index
        for index in _long_enough(mocap, 90, without)
        if any(word in mocap.actions[index].lower() for word in _STILL)
        and np.ptp(_floor_plan(mocap, index), axis=0).max() < _STILL_M
    ]


def walking_clips(mocap: Mocap, *, without: frozenset[str]) -> list[int]:
    """Clips of people who walk straight on, of subjects other than `without`."""
    found = []
    for index in _long_enough(mocap, 60, without):
        action = mocap.actions[index].lower()
        if "walk" not in action or "uneven" in action or mocap.tiers[index] > 0:
            continue
        plan = _floor_plan(mocap, index)
        way = np.linalg.norm(plan[-1] - plan[0])
        speed = way / len(plan) * float(mocap.arrays["fps"][index])
        if way > _WALK_M and way > 0.95 * np.linalg.norm(np.diff(plan, axis=0), axis=1).sum() and speed < 1.6:
            found.append(index)
    return found


def _long_enough(mocap: Mocap, frames: int, without: frozenset[str]) -> list[int]:
    there = [subject not in without for subject in mocap.subjects]
    return np.flatnonzero(np.array(there, dtype=bool) & (mocap.lengths >= frames)).tolist()


def endless(clip: Clip, frames: int, start: int = 0) -> Clip:
    """`clip` from frame `start` for `frames` frames, again from its beginning where it ends, by a crossfade."""
    seam = min(max(2, round(_SEAM_S * clip.fps)), len(clip) // 3)
    share: Array = np.linspace(0.0, 1.0, seam + 2)[1:-1]
    share = share**2 * (3 - 2 * share)
    head, tail = clip.between(0, seam), clip.between(len(clip) - seam, len(clip))
    rotations, pelvis = clip.rotations[:-seam].copy(), clip.pelvis[:-seam].copy()
    # The last frames melt into the first ones, which the loop then need not show by themselves.
    rotations[:seam] = blend(tail.rotations, head.rotations, share)
    pelvis[:seam] = tail.pelvis + share[:, None] * (head.pelvis - tail.pelvis)
    index = (start + np.arange(frames)) % len(pelvis)
    return replace(clip, rotations=rotations[index], pelvis=pelvis[index])


def stand(body: BodyModel, betas: Array, clip: Clip, frames: int, fps: float, start: int = 0) -> Performance:
    """`clip` of somebody who stays, without end, by a body of shape `betas` (10,), its middle at the origin."""
    clip = endless(clip.resampled(fps), frames, start)
    performed = perform(body, betas, clip)
    return performed.moved(-performed.joints[:, 0, :2].mean(axis=0) if frames > 0 else np.zeros(2))


def walk_along(
    body: BodyModel, betas: Array, clip: Clip, path: Array, heading: Array, *, fps: float, start: float = 0.0
) -> Performance:
    """The walk of `clip` along `path` (T, 2) facing `heading` (T,), by a body of shape `betas` (10,).

    The recorded steps are repeated and laid along the path, as many as its length takes: who goes slower
    than the recording walks slower. `start` is the share of the loop of steps at which the walk begins.
    """
    cycle, gain = _cycle(perform(body, betas, clip.resampled(fps)))
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])[: len(path)]
    count = len(cycle)
    # Nobody's steps stop dead: below a quarter of the recorded speed the feet go on in place.
    floor = 0.25 * gain / count
    advance = np.maximum(np.diff(way, prepend=0.0), 0.0)
    advance[1:] = np.maximum(advance[1:], floor)
    phase = (np.cumsum(advance) / gain + start) % 1.0 * count
    low = phase.astype(int) % count
    high, share = (low + 1) % count, phase % 1.0
    turn = about_z(heading)
    rotations = blend(cycle.rotations[low], cycle.rotations[high], share)
    rotations[:, 0] = turn @ rotations[:, 0]
    side = cycle.joints[low, 0, 1:] + share[:, None] * (cycle.joints[high, 0, 1:] - cycle.joints[low, 0, 1:])
    pelvis = np.concatenate([path + left_of(heading) * side[:, :1], side[:, 1:]], axis=1)
    return grounded(Figure(body, betas), rotations, pelvis, fps, bend_toes=False)


def _floor_plan(mocap: Mocap, index: int) -> Array:
    """(T, 2) where the pelvis of a clip is over the floor."""
    start = int(mocap.arrays["seq_start"][index])
    return mocap.arrays["trans"][start : start + int(mocap.lengths[index])][:, [0, 2]].astype(np.float64)


def _cycle(walk: Performance) -> tuple[Performance, float]:
    """One or more double steps of a straight walk that can follow themselves, turned to walk along +x.

    Returns them with the pelvis' way along x taken out of the joints, and the length of that way.
    """
    count = len(walk)
    way = walk.joints[-1, 0, :2] - walk.joints[0, 0, :2]
    walk = walk.moved(np.zeros(2), -float(np.arctan2(way[1], way[0])))
    seam = 4
    features = (walk.joints - walk.joints[:, :1]).reshape(count, -1)
    first, last = np.arange(seam, count // 2), np.arange(count // 2, count)
    gap = np.linalg.norm(features[first][:, None] - features[last][None], axis=-1)
    # A shorter loop shows its seam more often: prefer the longer of two that close equally well.
    begin, end = np.unravel_index(np.argmin(gap - 0.002 * (last[None] - first[:, None])), gap.shape)
    begin, end = int(first[begin]), int(last[end])
    share: Array = np.linspace(0.0, 1.0, seam + 2)[1:-1]
    rotations, joints = walk.rotations[begin:end].copy(), walk.joints[begin:end].copy()
    rotations[-seam:] = blend(rotations[-seam:], walk.rotations[begin - seam : begin], share)
    length = float(walk.joints[end, 0, 0] - walk.joints[begin, 0, 0])
    places = joints[:, 0].copy()
    before = walk.joints[begin - seam : begin, 0]
    places[-seam:, 1:] += share[:, None] * (before - places[-seam:])[:, 1:]
    places[:, 1] -= places[:, 1].mean()
    places[:, 0] = 0.0
    return Performance(rotations, joints - joints[:, :1] + places[:, None], walk.rest), length
