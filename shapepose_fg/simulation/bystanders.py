"""Bystanders of a scene: looped recorded gestures, and recorded walks past everybody else."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from scipy.ndimage import gaussian_filter1d

from shapepose_fg.body.model.body_model import BodyModel
from shapepose_fg.core.arrays import Array
from shapepose_fg.core.decompositions import comparable
from shapepose_fg.simulation.limbs import turned_about
from shapepose_fg.simulation.mocap import Clip, Mocap, blend
from shapepose_fg.simulation.motion import along, left_of
from shapepose_fg.simulation.performance import Figure, Performance, grounded, perform

_STILL = (
    "basketball signal",
    "directing traffic",
    "washwindow",
    "wash self",
    "laugh",
    "bend over",
    "arms held high",
)
"""Actions of people who stay in place, as the recordings name them."""
_HORIZON_S = np.linspace(0.2, 2.0, 10)
"""Times ahead at which a walker predicts the others, s."""


def standing_clips(mocap: Mocap, *, without: frozenset[str]) -> list[int]:
    """Indices of clips of people who stand and gesture, by subjects other than `without`."""
    # Radius within which standing people stay, and distance that walking people exceed, m.
    return [
        index
        for index, action, plan in _clips(mocap, 90, without)
        if any(word in action for word in _STILL) and np.ptp(plan, axis=0).max() < 0.75
    ]


def walking_clips(mocap: Mocap, *, without: frozenset[str]) -> list[int]:
    """Indices of clips of people who walk straight, by subjects other than `without`."""
    found = []
    for index, action, plan in _clips(mocap, 60, without):
        if "walk" in action and "uneven" not in action and mocap.tiers[index] <= 0:
            length_m = np.linalg.norm(plan[-1] - plan[0])
            speed = length_m / len(plan) * float(mocap.arrays["fps"][index])
            straight = length_m > 0.95 * np.linalg.norm(np.diff(plan, axis=0), axis=1).sum()
            found += [index] if length_m > 2.5 and straight and speed < 1.6 else []
    return found


def _clips(mocap: Mocap, frames: int, without: frozenset[str]) -> Iterator[tuple[int, str, Array]]:
    """Clips of at least `frames` frames, with their actions, and the pelvis' positions (T, 2) on
    the floor.
    """
    for index, (subject, action) in enumerate(zip(mocap.subjects, mocap.actions, strict=True)):
        if subject not in without and mocap.lengths[index] >= frames:
            start = int(mocap.arrays["seq_start"][index])
            places = mocap.arrays["trans"][start : start + int(mocap.lengths[index])]
            yield index, action.lower(), places[:, [0, 2]].astype(np.float64)


def endless(clip: Clip, frames: int, start: int = 0) -> Clip:
    """`clip` from frame `start` on, looped to `frames` frames with a crossfade at the end."""
    # Length of the crossfade from the end of a clip to its beginning.
    seam = min(max(2, round(0.5 * clip.fps)), len(clip) // 3)
    share: Array = np.linspace(0.0, 1.0, seam + 2)[1:-1]
    share = share**2 * (3 - 2 * share)
    head, tail = clip.between(0, seam), clip.between(len(clip) - seam, len(clip))
    rotations, pelvis = clip.rotations[:-seam].copy(), clip.pelvis[:-seam].copy()
    # The last frames are blended into the first ones, and not repeated.
    rotations[:seam] = blend(tail.rotations, head.rotations, share)
    pelvis[:seam] = tail.pelvis + share[:, None] * (head.pelvis - tail.pelvis)
    index = (start + np.arange(frames)) % len(pelvis)
    return replace(clip, rotations=rotations[index], pelvis=pelvis[index])


def stand(
    body: BodyModel, betas: Array, clip: Clip, frames: int, fps: float, start: int = 0
) -> Performance:
    """`clip` of a person who stays in place, looped, by a body of shape `betas` (10,), its middle
    at the origin.
    """
    clip = endless(clip.resampled(fps), frames, start)
    performed = perform(body, betas, clip)
    return performed.moved(-performed.joints[:, 0, :2].mean(axis=0) if frames > 0 else np.zeros(2))


def walk_along(
    body: BodyModel,
    betas: Array,
    clip: Clip,
    path: Array,
    heading: Array,
    *,
    fps: float,
    start: float = 0.0,
) -> Performance:
    """The walk of `clip` along `path` (T, 2) with `heading` (T,), by a body of shape `betas` (10,).

    The recorded steps are looped along the path, as many as its length needs, so that a slower
    person takes slower steps. `start` is the phase of the loop at which the walk begins, 0 to 1.
    """
    cycle, gain = _cycle(perform(body, betas, clip.resampled(fps)))
    travelled_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])[
        : len(path)
    ]
    count = len(cycle)
    # Steps do not stop abruptly: below a quarter of the recorded speed the feet continue in place.
    floor = 0.25 * gain / count
    advance = np.maximum(np.diff(travelled_m, prepend=0.0), 0.0)
    advance[1:] = np.maximum(advance[1:], floor)
    phase = (np.cumsum(advance) / gain + start) % 1.0 * count
    low = phase.astype(int) % count
    high, share = (low + 1) % count, phase % 1.0
    turn = turned_about("z", heading)
    rotations = blend(cycle.rotations[low], cycle.rotations[high], share)
    rotations[:, 0] = turn @ rotations[:, 0]
    side = cycle.joints[low, 0, 1:] + share[:, None] * (
        cycle.joints[high, 0, 1:] - cycle.joints[low, 0, 1:]
    )
    pelvis = np.concatenate([path + left_of(heading) * side[:, :1], side[:, 1:]], axis=1)
    return grounded(Figure(body, betas), rotations, pelvis, fps, bend_toes=False)


def _cycle(walk: Performance) -> tuple[Performance, float]:
    """A loop of double steps from a straight walk, without the motion along +x; and its
    length, m.
    """
    count = len(walk)
    displacement = walk.joints[-1, 0, :2] - walk.joints[0, 0, :2]
    walk = walk.moved(np.zeros(2), -float(np.arctan2(displacement[1], displacement[0])))
    seam = 4
    features = (walk.joints - walk.joints[:, :1]).reshape(count, -1)
    first, last = np.arange(seam, count // 2), np.arange(count // 2, count)
    gap = np.linalg.norm(features[first][:, None] - features[last][None], axis=-1)
    # A shorter loop repeats its seam more often: prefer the longer of two that close equally well.
    begin, end = np.unravel_index(
        np.argmin(comparable(gap - 0.002 * (last[None] - first[:, None]))), gap.shape
    )
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


WalkerPath = tuple[Array, Array]
"""Positions (T, 2), metres, and headings (T,), radians from the x axis towards y, unwrapped, of a
walker."""


def path_through(
    others: Array,
    frames: int,
    rng: np.random.Generator,
    *,
    fps: float,
    speed_mps: float,
    distance_m: Array,
    half_room_m: float,
) -> WalkerPath:
    """A path from wall to wall and back, with distance `distance_m` (K,) or a little more from
    `others` (T, K, 2).
    """
    # Number of random paths, of which the best is used.
    paths = [_walk(others, frames, rng, fps, speed_mps, distance_m, half_room_m) for _ in range(4)]
    return max(paths, key=lambda path: comparable(_path_score(path, others, distance_m)))


def _path_score(path: WalkerPath, others: Array, distance_m: Array) -> float:
    """Score of a path: mainly no contact, then closeness."""
    if others.shape[1] == 0 or len(path[0]) == 0:
        return 0.0
    room = (np.linalg.norm(others - path[0][:, None], axis=-1) - distance_m).min(axis=1)
    return (
        30.0 * float(np.minimum(room, 0.0).mean())
        + min(float(room.min()), 0.0)
        + float((room < 0.4).mean())
    )


def _walk(
    others: Array,
    frames: int,
    rng: np.random.Generator,
    fps: float,
    speed: float,
    distance: Array,
    half: float,
) -> WalkerPath:
    """One random path: each decision takes the best turn and pace for the next two seconds (dynamic
    window).
    """
    # Interval between a walker's decisions, s.
    hold = max(1, round(0.1 * fps))
    xy, heading, pace = _path_start(others, rng, half)
    goal = _path_goal(xy, rng, half)
    # Turning rates that a walker considers, rad/s.
    # Speeds that a walker considers, as shares of the walker's own.
    grids = np.meshgrid(np.linspace(-1.9, 1.9, 15), [0.15, 0.45, 0.75, 1.0])
    turns, paces = (grid.ravel() for grid in grids)
    rate, places, headings = 0.0, np.empty((frames, 2)), np.empty(frames)
    for frame in range(0, frames, hold):
        if np.linalg.norm(goal - xy) < 0.5:
            goal = _path_goal(xy, rng, half)
        ahead = np.minimum(frame + np.round(_HORIZON_S * fps).astype(int), frames - 1)
        options = _arcs(xy, heading, turns, paces * speed)
        cost = (
            0.35 * np.abs(turns - rate)
            + 0.15 * np.abs(turns)
            + 1.2 * (1 - paces)
            + 1.5 * np.abs(paces - pace)
        )
        cost += 2.0 * np.linalg.norm(options[:, -1] - goal, axis=-1)
        cost += 60.0 * np.maximum(np.abs(options) - half, 0.0).sum(axis=(1, 2))
        apart_x, apart_y = (options[..., None, axis] - others[ahead, :, axis] for axis in (0, 1))
        gaps = np.sqrt(apart_x**2 + apart_y**2)  # dominates the run time; norm is five times slower
        cost += 200.0 * (np.maximum(distance + 0.08 - gaps, 0.0) ** 2).sum(axis=(1, 2))
        best = int(np.argmin(comparable(cost)))
        rate, pace = float(turns[best]), float(paces[best])
        for later in range(frame, min(frame + hold, frames)):
            places[later], headings[later] = xy, heading
            heading += rate / fps
            xy = xy + pace * speed / fps * along(np.array(heading))
    path, facing = (
        gaussian_filter1d(each, 0.12 * fps, axis=0, mode="nearest") for each in (places, headings)
    )
    return path, facing


def _arcs(xy: Array, heading: float, turns: Array, speeds: Array) -> Array:
    """Positions (C, H, 2) along the horizon for C turning rates and speeds; turns last at most 0.8
    s.
    """
    step = np.diff(_HORIZON_S, prepend=0.0)
    angle = heading + turns[:, None] * np.minimum(_HORIZON_S - step / 2, 0.8)
    return xy + np.cumsum(along(angle) * (speeds[:, None] * step)[..., None], axis=1)


def _path_start(others: Array, rng: np.random.Generator, half: float) -> tuple[Array, float, float]:
    """A free position, a heading towards the centre, and the initial pace."""
    spots = rng.uniform(-0.95 * half, 0.95 * half, (64, 2))
    if others.size > 0:
        early = others[: max(1, min(len(others), 20)) : 4]
        free = np.linalg.norm(spots[:, None, None] - early, axis=-1).min(axis=(1, 2))
        spots = spots[[int(np.argmax(comparable(np.minimum(free, 0.9))))]]
    return spots[0], float(np.arctan2(-spots[0][1], -spots[0][0]) + rng.uniform(-0.5, 0.5)), 0.75


def _path_goal(xy: Array, rng: np.random.Generator, half: float) -> Array:
    """A random goal near the opposite wall."""
    angle = np.arctan2(-xy[1], -xy[0]) + rng.uniform(-0.9, 0.9)
    return rng.uniform(0.75, 0.95) * half * along(angle)
