"""Feet that stand where they are put: footsteps for any path over the floor."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_STANCE = 0.6
"""Share of a stride in which a foot stands."""


Path = Callable[[Array], tuple[Array, Array]]
"""Where a pelvis is over the floor at times (...,), seconds: positions (..., 2), metres; headings (...,), radians
without jumps of a whole turn."""


def along(angle: Array) -> Array:
    """Unit vectors (..., 2) in directions `angle` (...,), from the x axis towards the y axis."""
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def left_of(angle: Array) -> Array:
    """Unit vectors (..., 2) to the left of directions `angle` (...,)."""
    return np.stack([-np.sin(angle), np.cos(angle)], axis=-1)


@dataclass(frozen=True)
class Steps:
    """The feet of a walk in T frames, left and right."""

    xy: Array
    """(T, 2, 2) where the ankles are over the floor, metres."""
    lift: Array
    """(T, 2) how high they are above standing, metres."""
    heading: Array
    """(T, 2) where the feet point, radians."""
    pitch: Array
    """(T, 2) heel above toes, radians."""
    swing: Array
    """(T, 2) how far a foot is ahead of the pelvis, metres: arms swing against it."""


def footsteps(path: Path, time_s: Array, stride_s: float, width_m: float, phase: float = 0.0) -> Steps:
    """Steps under `path` at the T times: each foot stands `_STANCE` of a stride, then swings to its next place.

    A foot stands where the hip is in the middle of its stance, `width_m` beside the other; the two are half
    a stride apart. Who stays in place does not lift the feet.
    """
    sides = np.array([0.0, 0.5])
    cycle = time_s[:, None] / stride_s + phase + sides
    number, part = np.floor(cycle), np.mod(cycle, 1.0)
    here, here_heading = _plant(path, number, sides + phase, stride_s, width_m)
    there, there_heading = _plant(path, number + 1, sides + phase, stride_s, width_m)
    progress = np.clip((part - _STANCE) / (1 - _STANCE), 0.0, 1.0)
    eased = progress**2 * (3 - 2 * progress)
    xy = here + eased[..., None] * (there - here)
    length = np.linalg.norm(there - here, axis=-1)
    turn = np.abs(there_heading - here_heading)
    effort = np.clip(length / 0.6 + turn / 1.5, 0.0, 1.0)
    lift = 0.09 * effort * np.sin(np.pi * progress)
    # The heel leaves the floor before the toes, and lands before them.
    push = np.clip((part - 0.45) / 0.2, 0.0, 1.0) * np.clip((0.85 - part) / 0.2, 0.0, 1.0)
    strike = np.clip((part - 0.85) / 0.12, 0.0, 1.0)
    heading = here_heading + eased * (there_heading - here_heading)
    centre, facing = path(time_s)
    swing = ((xy - centre[:, None]) * along(facing)[:, None]).sum(axis=-1)
    return Steps(xy, lift + 0.05 * push * effort, heading, (0.55 * push - 0.2 * strike) * effort, swing)


def _plant(path: Path, number: Array, offset: Array, stride_s: float, width_m: float) -> tuple[Array, Array]:
    """Place (T, 2, 2) and heading (T, 2) of the feet in stance `number` (T, 2)."""
    xy, heading = path((number + _STANCE / 2 - offset) * stride_s)
    side = np.array([0.5, -0.5]) * width_m
    return xy + left_of(heading) * side[:, None], heading + np.array([0.12, -0.12])
