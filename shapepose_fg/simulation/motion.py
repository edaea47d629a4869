"""Synthetic motions of people who dance, walk and stand close together, from footsteps and hand
targets.

No recorded motion is needed: each role defines pelvis, hands and gaze (a `Puppet`), which
`limbs.pose` converts to SMPL's parameters. World z up, floor at z = 0, metres, radians.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from shapepose_fg.core.arrays import Array
from shapepose_fg.core.storage.schema import Column, Table
from shapepose_fg.simulation.limbs import LEGS, Puppet, pose

COUPLE, LOOP, WAVER = np.array([[-0.15, 0.0], [1.05, 0.0], [0.92, -0.1]])
"""Positions in a group of the couple's centre, of the walker's loop, and of the waving person,
metres."""
_PADDING_S = 3.0
"""Duration for which paths are defined before the first and after the last frame, s, for adjacent
steps."""
_STANCE = 0.6
"""Share of a stride for which a foot stands."""
Path = Callable[[Array], tuple[Array, Array]]
"""Function from times (...,), seconds, to the pelvis on the floor: positions (..., 2), metres;
headings (...,), radians, unwrapped."""


@dataclass(frozen=True)
class BodyMotion(Table):
    """P people's bodies in N frames, in SMPL's parameters."""

    betas: Annotated[Array, Column("P 10")]
    """(P, 10) shapes, in standard deviations."""
    global_orient: Annotated[Array, Column("N P 3")]
    """(N, P, 3) axis-angle."""
    body_pose: Annotated[Array, Column("N P 23 3")]
    """(N, P, 23, 3) axis-angle."""
    transl: Annotated[Array, Column("N P 3")]
    """(N, P, 3) metres."""

    @classmethod
    def still(cls, betas: Array, frames: int = 1) -> "BodyMotion":
        """People of shapes `betas` (P, 10) in the T-pose, without translation."""
        people = len(betas)
        return cls(betas, *(np.zeros((frames, people, *shape)) for shape in ((3,), (23, 3), (3,))))


class BodyDimensions:
    """Dimensions of a body that a role needs, metres."""

    def __init__(self, rest: Array, floor: float):
        """`rest` (24, 3) are the joints in the T-pose, y up, facing +z; `floor` is the y of the
        soles.
        """
        self.rest, self.floor = rest, floor
        self.pelvis_m, self.ankle_m, self.shoulder_m = (
            float(rest[joint, 1] - floor) for joint in (0, 7, 16)
        )
        """Heights of pelvis, ankle and shoulder of an upright body above its soles, metres."""
        hip, knee, ankle = rest[list(LEGS[0])]
        self.leg_m = float(np.linalg.norm(knee - hip) + np.linalg.norm(ankle - knee))
        """Length of thigh and shank together, metres."""


def close_motion(
    betas: Array, builds: list[BodyDimensions], frames: int, fps: float, rng: np.random.Generator
) -> BodyMotion:
    """People of shapes `betas` (P, 10) in close motion, in groups of four: a couple dances, one
    walks through, one waves.

    The first group is in the centre of the room, each further one in a corner of its own. The last
    group may be incomplete and has the first roles; a single person waves.
    """
    time = np.arange(frames) / fps
    puppets: list[Puppet] = []
    corners = np.array([[0.0, 0.0], [0.55, 1.15], [-1.0, -1.1], [-0.9, 1.2], [1.0, -1.2]])
    for first in range(0, len(builds), 4):
        group = builds[first : first + 4]
        centre = corners[(first // 4) % len(corners)] + rng.normal(0.0, 0.02, 2)
        if len(group) >= 2:
            puppets += dance(group[:2], time, centre + COUPLE, rng)
        if len(group) >= 3:
            puppets.append(walk(group[2], time, centre + LOOP, rng))
        if len(group) in (1, 4):
            puppets.append(wave(group[-1], time, centre + WAVER, np.pi, rng))
    posed = [pose(puppet, build.rest) for puppet, build in zip(puppets, builds, strict=True)]
    if len(posed) == 0:
        return BodyMotion.still(betas, frames)
    return BodyMotion(betas, *(np.stack(part, axis=1) for part in zip(*posed, strict=True)))


def dance(
    pair: list[BodyDimensions], time: Array, centre: Array, rng: np.random.Generator
) -> list[Puppet]:
    """Two people who face each other, hold both hands and rotate about each other, with one pair of
    hands raised.
    """
    turn = rng.choice([-1.0, 1.0]) * rng.uniform(0.8, 1.1)  # rad/s
    beat = rng.uniform(1.0, 1.15)  # s
    start = rng.uniform(-0.2, 0.2)

    def angle(t: Array) -> Array:
        return np.pi / 2 + turn * (t - 1.2) + start

    def middle(t: Array) -> Array:
        sway = 0.06 * np.sin(2 * np.pi * t / (2 * beat))
        return centre + left_of(angle(t)) * sway[:, None]

    def half_distance(t: Array) -> Array:
        return 0.29 + 0.04 * np.sin(2 * np.pi * t / (3 * beat) + start)

    def path_of(sign: float) -> Path:
        def path(t: Array) -> tuple[Array, Array]:
            outward = along(angle(t)) * sign
            facing = angle(t) + (np.pi if sign > 0 else 0.0)
            return middle(t) + outward * half_distance(t)[:, None], facing + 0.15 * np.sin(
                np.pi * t / beat
            )

        return path

    shoulder = np.mean([build.shoulder_m for build in pair])
    across = left_of(angle(time))
    up = _bump(time, 0.5, 1.4, period=2.4)
    held = []
    for side, lift in ((1.0, up), (-1.0, np.zeros_like(up))):
        xy = middle(time) + side * across * (0.34 - 0.16 * lift)[:, None]
        z = shoulder - 0.32 + 0.72 * lift + 0.03 * np.sin(2 * np.pi * time / beat)
        held.append(_at(xy, z))
    puppets = []
    for sign, build, other in ((1.0, pair[0], pair[1]), (-1.0, pair[1], pair[0])):
        outward = (
            np.stack([np.cos(angle(time)), np.sin(angle(time)), np.zeros_like(time)], axis=1) * sign
        )
        # For the person at the far end, facing the centre, `across` is to the right; for the other
        # to the left.
        hands = held if sign < 0 else held[::-1]
        wrists = np.stack([hand + 0.07 * outward for hand in hands], axis=1)
        xy, _ = path_of(-sign)(time)
        gaze = _at(xy, other.shoulder_m + 0.12)
        puppets.append(
            _puppet(
                build,
                time,
                path_of(sign),
                stride_s=beat,
                phase=0.25 if sign > 0 else 0.75,
                dip=0.03 + 0.02 * np.sin(2 * np.pi * time / beat),
                lean=np.stack(
                    [0.08 + 0.05 * up, 0.12 * np.sin(np.pi * time / beat), 0.1 * up * sign], axis=1
                ),
                wrists=wrists,
                reach=np.ones((len(time), 2)),
                gaze=gaze,
            )
        )
    return puppets


def walk(build: BodyDimensions, time: Array, centre: Array, rng: np.random.Generator) -> Puppet:
    """A person who walks on a long loop around `centre` (2,), past the others, with
    swinging arms.
    """
    speed = rng.uniform(1.0, 1.2)  # m/s
    half_axes = np.array([0.62, 1.15])
    lap = 2 * np.pi * np.sqrt((half_axes**2).mean()) / speed

    def path(t: Array) -> tuple[Array, Array]:
        phi = 2 * np.pi * (t - 1.2) / lap
        xy = centre + half_axes * np.stack([-np.cos(phi), np.sin(phi)], axis=-1)
        return xy, np.unwrap(np.arctan2(half_axes[1] * np.cos(phi), half_axes[0] * np.sin(phi)))

    xy, heading = path(time)
    ahead = xy + 2.0 * along(heading)
    twist = 0.12 * np.sin(2 * np.pi * time / 1.05)
    return _puppet(
        build,
        time,
        path,
        stride_s=1.05,
        phase=rng.uniform(),
        dip=np.full_like(time, 0.02),
        lean=np.stack([np.full_like(time, 0.06), twist, np.zeros_like(time)], axis=1),
        wrists=np.zeros((len(time), 2, 3)),
        reach=np.zeros((len(time), 2)),
        gaze=_at(ahead, 1.3),
    )


def wave(
    build: BodyDimensions, time: Array, spot: Array, heading: float, rng: np.random.Generator
) -> Puppet:
    """A person who stays at `spot` (2,): waves with the right hand, then crouches and
    reaches down.
    """
    clock = time + rng.uniform(-0.1, 0.1)
    waving, crouching = _bump(clock, -0.4, 1.75, period=2.8), _bump(clock, 1.2, 1.55, period=2.8)

    def path(t: Array) -> tuple[Array, Array]:
        shift = 0.04 * np.sin(2 * np.pi * t / 2.8)
        return spot + shift[:, None] * left_of(np.array(heading)), heading + 0.25 * np.sin(
            2 * np.pi * t / 2.8
        )

    xy, facing = path(time)
    forward = along(facing)
    left = left_of(facing)
    beat = 0.13 * np.sin(2 * np.pi * time / 0.62)
    hello = xy + 0.2 * forward - (0.38 + beat)[:, None] * left
    floor = xy + 0.42 * forward + 0.1 * left
    return _puppet(
        build,
        time,
        path,
        stride_s=1.4,
        phase=rng.uniform(),
        dip=0.02 + 0.3 * crouching,
        lean=np.stack(
            [0.03 + 0.75 * crouching, 0.2 * np.sin(2 * np.pi * time / 2.8), -0.06 * waving], axis=1
        ),
        wrists=np.stack([_at(floor, 0.42), _at(hello, build.shoulder_m + 0.32)], axis=1),
        reach=np.stack([crouching, waving], axis=1),
        gaze=_at(xy + 1.2 * forward, 1.45 - 1.1 * crouching),
    )


def _puppet(
    build: BodyDimensions,
    time: Array,
    path: Path,
    *,
    stride_s: float,
    phase: float,
    dip: Array,
    **upper: Array,
) -> Puppet:
    """A puppet with footsteps along `path`, and the pelvis `dip` (T,) metres lower than upright.

    `upper` are fields of `Puppet` for trunk, hands and gaze.
    """
    end = (time[-1] if len(time) else 0.0) + _PADDING_S
    feet, lift, foot_heading, pitch, ahead = _footsteps(
        _tabulated(path, np.arange(-_PADDING_S, end, 0.02)), time, stride_s, phase
    )
    xy, heading = path(time)
    ankles = np.concatenate([feet, (build.ankle_m + lift)[..., None]], axis=-1)
    # Legs are never fully stretched: the pelvis is low enough for both feet, smoothly.
    aside = np.linalg.norm(feet - xy[:, None], axis=-1) - 0.5 * 0.16
    drop = np.sqrt(np.maximum((0.985 * build.leg_m) ** 2 - np.maximum(aside, 0.0) ** 2, 0.1))
    allowed = (ankles[..., 2] + drop).min(axis=1) + (
        build.pelvis_m - build.rest[1, 1] + build.floor
    )
    height = _soften(np.minimum(build.pelvis_m - dip, allowed))
    lean_back = -0.22 * np.maximum(dip - 0.05, 0.0)  # hips move back over the heels in a crouch
    return Puppet(
        pelvis=_at(xy + lean_back[:, None] * along(heading), height),
        heading=heading,
        ankles=ankles,
        foot_heading=foot_heading,
        foot_pitch=pitch,
        swing=np.clip(0.55 * ahead[:, ::-1], -0.25, 0.3),  # arms swing opposite to the feet
        **upper,
    )


def _footsteps(
    path: Path, time_s: Array, stride_s: float, phase: float
) -> tuple[Array, Array, Array, Array, Array]:
    """Footsteps along `path` at T times: each foot stands for `_STANCE` of a stride, then swings to
    its next position.

    For each foot, left and right: the ankle on the floor (T, 2, 2) and its height above standing,
    metres; the foot's heading and pitch, radians; and its distance ahead of the pelvis, metres; (T,
    2) each. A foot stands below the hip in mid-stance; the two are half a stride apart. People who
    stay in place do not lift their feet.
    """
    sides = np.array([0.0, 0.5])
    cycle = time_s[:, None] / stride_s + phase + sides
    number, part = np.floor(cycle), np.mod(cycle, 1.0)
    start, start_heading = _plant(path, number, sides + phase, stride_s)
    stop, stop_heading = _plant(path, number + 1, sides + phase, stride_s)
    progress = np.clip((part - _STANCE) / (1 - _STANCE), 0.0, 1.0)
    eased = progress**2 * (3 - 2 * progress)
    xy = start + eased[..., None] * (stop - start)
    length = np.linalg.norm(stop - start, axis=-1)
    turn = np.abs(stop_heading - start_heading)
    effort = np.clip(length / 0.6 + turn / 1.5, 0.0, 1.0)
    lift = 0.09 * effort * np.sin(np.pi * progress)
    # The heel leaves the floor before the toes, and lands before them.
    push = np.clip((part - 0.45) / 0.2, 0.0, 1.0) * np.clip((0.85 - part) / 0.2, 0.0, 1.0)
    strike = np.clip((part - 0.85) / 0.12, 0.0, 1.0)
    heading = start_heading + eased * (stop_heading - start_heading)
    centre, facing = path(time_s)
    swing = ((xy - centre[:, None]) * along(facing)[:, None]).sum(axis=-1)
    return xy, lift + 0.05 * push * effort, heading, (0.55 * push - 0.2 * strike) * effort, swing


def _plant(path: Path, number: Array, offset: Array, stride_s: float) -> tuple[Array, Array]:
    """Position (T, 2, 2) and heading (T, 2) of the feet in stance `number` (T, 2)."""
    xy, heading = path((number + _STANCE / 2 - offset) * stride_s)
    # Distance between the feet, m.
    side = np.array([0.5, -0.5]) * 0.19
    return xy + left_of(heading) * side[:, None], heading + np.array([0.12, -0.12])


def _tabulated(path: Path, time_s: Array) -> Path:
    """`path` tabulated at increasing times (M,), interpolated linearly."""
    places, headings = path(time_s)

    def at(t: Array) -> tuple[Array, Array]:
        xy = np.stack([np.interp(t, time_s, places[:, axis]) for axis in (0, 1)], axis=-1)
        return xy, np.interp(t, time_s, headings)

    return at


def _at(xy: Array, z: Array | float) -> Array:
    """Points (T, 3) over `xy` (T, 2) at height `z`."""
    return np.concatenate([xy, np.broadcast_to(z, len(xy))[:, None]], axis=1)


def _bump(time: Array, start: float, length: float, *, period: float) -> Array:
    """A smooth pulse per period, from 0 at `start` to 1 and back within `length`."""
    part = np.clip(((time - start) % period) / length, 0.0, 1.0)
    return np.clip(1.6 * np.sin(np.pi * part) ** 2, 0.0, 1.0)


def _soften(height: Array) -> Array:
    """Running mean over five frames, with the ends repeated."""
    if len(height) == 0:
        return height
    padded = np.concatenate([np.repeat(height[:1], 2), height, np.repeat(height[-1:], 2)])
    return np.convolve(padded, np.full(5, 0.2), mode="valid")


def along(angle: Array) -> Array:
    """Unit vectors (..., 2) in directions `angle` (...,), from the x axis towards the y axis."""
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def left_of(angle: Array) -> Array:
    """Unit vectors (..., 2) to the left of directions `angle` (...,)."""
    return np.stack([-np.sin(angle), np.cos(angle)], axis=-1)
