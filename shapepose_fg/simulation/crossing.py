"""Ways through a room full of moving people: somebody who looks ahead and walks around the others."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from shapepose_fg.simulation.gait import along

Array = NDArray[np.float64]

_TRIES = 4
_DECISION_S = 0.1
"""How often a walker looks up."""
_HORIZON_S = np.linspace(0.2, 2.0, 10)
"""How far ahead a walker sees what the others will do."""
_TURNS = np.linspace(-1.9, 1.9, 15)
"""Turns that are weighed, rad/s."""
_PACES = np.array([0.15, 0.45, 0.75, 1.0])
"""Speeds that are weighed, as shares of the walker's own."""


class Way(NamedTuple):
    """Where somebody walks."""

    xy: Array
    """(T, 2) metres."""
    heading: Array
    """(T,) radians, from the x axis towards the y axis, without whole turns."""


def way_through(
    others: Array,
    frames: int,
    rng: np.random.Generator,
    *,
    fps: float,
    speed_mps: float,
    distance_m: Array,
    half_room_m: float,
) -> Way:
    """A way from wall to wall and back, past points `others` (T, K, 2) at `distance_m` (K,) or a little more.

    Of several tries the one that keeps its distance best, then the one that comes closest.
    """
    ways = [_walk(others, frames, rng, fps, speed_mps, distance_m, half_room_m) for _ in range(_TRIES)]
    return max(ways, key=lambda way: _worth(way, others, distance_m))


def _worth(way: Way, others: Array, distance_m: Array) -> float:
    """How good a way is: first that no one is bumped into, then that it is close."""
    if others.shape[1] == 0 or len(way.xy) == 0:
        return 0.0
    room = (np.linalg.norm(others - way.xy[:, None], axis=-1) - distance_m).min(axis=1)
    return 30.0 * float(np.minimum(room, 0.0).mean()) + min(float(room.min()), 0.0) + float((room < 0.4).mean())


def _walk(
    others: Array, frames: int, rng: np.random.Generator, fps: float, speed: float, distance: Array, half: float
) -> Way:
    """One try: at each decision the turn and pace whose next two seconds are best (dynamic window)."""
    hold = max(1, round(_DECISION_S * fps))
    xy, heading, pace = _start(others, rng, half)
    goal = _goal(xy, rng, half)
    turns, paces = (grid.ravel() for grid in np.meshgrid(_TURNS, _PACES))
    rate, places, headings = 0.0, np.empty((frames, 2)), np.empty(frames)
    for frame in range(0, frames, hold):
        if np.linalg.norm(goal - xy) < 0.5:
            goal = _goal(xy, rng, half)
        ahead = np.minimum(frame + np.round(_HORIZON_S * fps).astype(int), frames - 1)
        options = _arcs(xy, heading, turns, paces * speed)
        cost = 0.35 * np.abs(turns - rate) + 0.15 * np.abs(turns) + 1.2 * (1 - paces) + 1.5 * np.abs(paces - pace)
        cost += 2.0 * np.linalg.norm(options[:, -1] - goal, axis=-1)
        cost += 60.0 * np.maximum(np.abs(options) - half, 0.0).sum(axis=(1, 2))
        apart_x, apart_y = (options[..., None, axis] - others[ahead, :, axis] for axis in (0, 1))
        gaps = np.sqrt(apart_x**2 + apart_y**2)  # most of the time goes here: five times as fast as norm
        cost += 200.0 * (np.maximum(distance + 0.08 - gaps, 0.0) ** 2).sum(axis=(1, 2))
        best = int(np.argmin(cost))
        rate, pace = float(turns[best]), float(paces[best])
        for later in range(frame, min(frame + hold, frames)):
            places[later], headings[later] = xy, heading
            heading += rate / fps
            xy = xy + pace * speed / fps * along(np.array(heading))
    sigma = 0.12 * fps
    return Way(
        gaussian_filter1d(places, sigma, axis=0, mode="nearest"),
        gaussian_filter1d(headings, sigma, mode="nearest"),
    )


def _arcs(xy: Array, heading: float, turns: Array, speeds: Array) -> Array:
    """Where (C, H, 2) each of C turns and speeds leads along the horizon; turns last for at most 0.8 s."""
    step = np.diff(_HORIZON_S, prepend=0.0)
    angle = heading + turns[:, None] * np.minimum(_HORIZON_S - step / 2, 0.8)
    return xy + np.cumsum(along(angle) * (speeds[:, None] * step)[..., None], axis=1)


def _start(others: Array, rng: np.random.Generator, half: float) -> tuple[Array, float, float]:
    """A place that is free, facing the middle, and the first pace."""
    spots = rng.uniform(-0.95 * half, 0.95 * half, (64, 2))
    if others.size > 0:
        early = others[: max(1, min(len(others), 20)) : 4]
        free = np.linalg.norm(spots[:, None, None] - early, axis=-1).min(axis=(1, 2))
        spots = spots[[int(np.argmax(np.minimum(free, 0.9)))]]
    return spots[0], float(np.arctan2(-spots[0][1], -spots[0][0]) + rng.uniform(-0.5, 0.5)), 0.75


def _goal(xy: Array, rng: np.random.Generator, half: float) -> Array:
    """A place near the wall across the room."""
    angle = np.arctan2(-xy[1], -xy[0]) + rng.uniform(-0.9, 0.9)
    return rng.uniform(0.75, 0.95) * half * along(angle)
