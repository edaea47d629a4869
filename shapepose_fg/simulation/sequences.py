"""Named interaction sequences around real two-person salsa takes, and random scenes of recorded motions.

Takes 60/61_01 to _07 are for choosing settings ("tune"), _09 to _15 for reporting ("report"); whoever else is
in the room comes from other subjects. Room of 4 x 4 m, world z up, floor at z = 0.
"""

import re
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.body.model import BodyModel
from shapepose_fg.simulation.bystanders import stand, standing_clips, walk_along, walking_clips
from shapepose_fg.simulation.crossing import way_through
from shapepose_fg.simulation.holding import hold_hands
from shapepose_fg.simulation.mocap import Clip, Figure, Mocap, Performance, perform, together
from shapepose_fg.simulation.motion import Motion
from shapepose_fg.simulation.scene import Scene, ring_of_cameras

Array = NDArray[np.float64]
Split = Literal["tune", "report"]

DANCERS = frozenset({"60", "61"})
"""Subjects of the salsa takes: nobody trains on them."""
TAKES: dict[str, range] = {"tune": range(1, 8), "report": range(9, 16)}
"""Numbers of the takes of each split."""
_TORSO = (0, 6, 9, 12)
"""Pelvis, spine and neck: what nobody else may come into."""
_TORSO_M = 0.2
"""How near to these another's joint may come."""
_MIDDLES, _LIMBS = (0, 9), (18, 19, 20, 21, 22, 23, 4, 5)
"""Pelvis and chest; elbows, wrists, hands, knees."""
_TRIED = 30
"""Placements of somebody that are looked at closely."""
_ARM_M = 0.3
"""Who walks keeps this far from others' limbs."""


@dataclass(frozen=True)
class SequenceConfig:
    """What a sequence is made of, and how hard it is."""

    pairs: int = 1
    """Salsa pairs in the room at a time, 0 to 2."""
    standing: int = 1
    """People who stand close and gesture."""
    walking: int = 1
    """People who walk through, between and around."""
    close_m: float = 0.45
    """Pelvises of people who do not dance together stay this far apart, or a little farther."""
    limbs_m: float = 0.12
    """No joint of who stands comes nearer than this to a joint of anybody else, where there is room for it."""
    apart_m: float = 1.3
    """A take is used from where the dancers come nearer than this to where they part."""
    half_room_m: float = 1.75
    """Pelvises stay within this of the middle of the room, in x and in y."""
    segment_frames: int = 600
    """Longest stretch without a cut, at 30 frames a second."""
    frames: int = 3000
    """Length of the sequence."""
    shape_spread: float = 0.8
    """Standard deviation of the betas over people; a pair's two differ by less."""
    camera_distance_m: tuple[float, float] = (3.1, 3.6)
    """Range of the cameras' distances from the middle."""
    camera_height_m: tuple[float, float] = (2.0, 2.5)
    """Range of the cameras' heights; every second one is 0.3 m lower."""
    image_size: tuple[int, int] = (1280, 720)
    """Pixels."""
    seed: int = 0
    """Fixes everything that is drawn."""

    def __post_init__(self) -> None:
        if not (0 <= self.pairs <= 2 and self.standing >= 0 and self.walking >= 0):
            raise ValueError(f"pairs must be 0, 1 or 2, standing and walking at least 0; got {self}")
        if not (self.close_m > 0 and self.half_room_m > 0 and self.segment_frames > 0 and self.frames >= 0):
            raise ValueError(
                f"close_m, half_room_m, segment_frames must be positive, frames at least 0; got {self}"
            )

    @property
    def people(self) -> int:
        """Count of people."""
        return 2 * self.pairs + self.standing + self.walking


SEQUENCES: dict[str, SequenceConfig] = {
    "salsa": SequenceConfig(pairs=1, standing=1, walking=1, seed=11),
    "crossing": SequenceConfig(pairs=1, standing=0, walking=3, seed=23),
    "crowd": SequenceConfig(pairs=2, standing=1, walking=1, seed=37),
}
"""A pair with one who stands close and one who walks past; others who walk through; two pairs in one room."""


@dataclass(frozen=True)
class Sequence(Scene):
    """A scene made of recorded motions, and what it is made of."""

    name: str = "random"
    """Which of `SEQUENCES`."""
    split: str = ""
    """"tune" or "report"; empty where no salsa take is used."""
    cuts: tuple[int, ...] = ()
    """First frames of what follows a cut: there everybody may be somewhere else."""
    clips: tuple[tuple[str, ...], ...] = field(default=())
    """For each segment the name of the recording that each person performs."""


def sequence(
    name: str,
    split: Split,
    mocap: Mocap,
    *,
    body: BodyModel | None = None,
    cameras: int = 6,
    frames: int | None = None,
    fps: float = 30.0,
    config: SequenceConfig | None = None,
) -> Sequence:
    """Interaction sequence `name` of `SEQUENCES` from the takes of `split`, before `cameras` cameras.

    `config` takes the place of the named one's; `frames` of its length. ValueError for an unknown name or
    split, or recordings without a take of that split.
    """
    if name not in SEQUENCES or split not in TAKES:
        raise ValueError(
            f"name must be one of {', '.join(SEQUENCES)}, split one of {', '.join(TAKES)}; got {name}, {split}"
        )
    config = SEQUENCES[name] if config is None else config
    takes = salsa_takes(mocap, split)
    if len(takes) == 0:
        raise ValueError(f"these recordings hold no salsa take of split {split!r}: give the whole file")
    rng = np.random.default_rng([config.seed, list(TAKES).index(split)])
    return _compose(mocap, takes, config, rng, body, cameras, frames, fps, (name, split))


def random_scene(
    mocap: Mocap,
    *,
    people: int,
    cameras: int,
    frames: int,
    seed: int,
    body: BodyModel | None = None,
    fps: float = 30.0,
    config: SequenceConfig | None = None,
) -> Sequence:
    """0 to 12 people who stand and walk close together before 2 to 12 cameras; subjects 60 and 61 are not used."""
    if not (0 <= people <= 12 and 2 <= cameras <= 12 and frames >= 0):
        raise ValueError(f"need 0 to 12 people, 2 to 12 cameras, frames >= 0; got {people}, {cameras}, {frames}")
    base = SequenceConfig() if config is None else config
    rng = np.random.default_rng([base.seed, seed, 7])
    walking = int(rng.binomial(people, 0.4)) if people < 7 else people // 4
    base = replace(base, pairs=0, standing=people - walking, walking=walking)
    return _compose(mocap, [], base, rng, body, cameras, frames, fps, ("random", ""))


def salsa_takes(mocap: Mocap, split: Split) -> list[tuple[int, int]]:
    """The pairs of clips of a split, lead and follow."""
    return [pair for pair in mocap.pairs if _take(mocap.names[pair[0]]) in TAKES[split]]


def clearance_m(first: Array, second: Array) -> Array:
    """Least distance (T,) between the torso joints of one person and any joint of the other, (T, 24, 3) each."""
    trunk = list(_TORSO)
    gaps = [
        np.linalg.norm(a[:, trunk, None] - b[:, None], axis=-1).min(axis=(1, 2))
        for a, b in ((first, second), (second, first))
    ]
    return np.minimum(*gaps)


@dataclass
class _Room:
    """Who is in the room already, in one segment."""

    frames: int
    performed: list[Performance]
    names: list[str]

    def add(self, performance: Performance, name: str) -> None:
        self.performed.append(performance)
        self.names.append(name)

    def points(self, joints: tuple[int, ...] = _MIDDLES) -> Array:
        """(T, P x joints, 2) where SMPL's `joints` of everybody are over the floor."""
        if len(self.performed) == 0:
            return np.zeros((self.frames, 0, 2))
        return np.concatenate([p.joints[:, list(joints), :2] for p in self.performed], axis=1)


def _compose(
    mocap: Mocap,
    takes: list[tuple[int, int]],
    config: SequenceConfig,
    rng: np.random.Generator,
    body: BodyModel | None,
    cameras: int,
    frames: int | None,
    fps: float,
    label: tuple[str, str],
) -> Sequence:
    """Segments one after the other until there are frames enough."""
    body = BodyModel.default() if body is None else body
    frames = config.frames if frames is None else frames
    rig = ring_of_cameras(
        cameras,
        rng,
        image_size=config.image_size,
        distance_m=config.camera_distance_m,
        height_m=config.camera_height_m,
    )
    betas = _shapes(config, rng)
    stretches = _Stretches(mocap, takes, config, fps, rng)
    parts: list[Motion] = []
    clips: list[tuple[str, ...]] = []
    cuts: list[int] = []
    done = 0
    while done < frames:
        room = _segment(mocap, body, betas, config, rng, fps, frames - done, stretches)
        parts.append(together(betas, room.performed, room.frames))
        clips.append(tuple(room.names))
        done += room.frames
        cuts.append(done)
    motion = _joined(parts) if len(parts) > 0 else together(np.zeros((0, 10)), [], 0)
    if len(parts) == 0 and config.people > 0:
        motion = Motion(betas, *(np.zeros((0, config.people, *shape)) for shape in ((3,), (23, 3), (3,))))
    return Sequence(rig, body, motion, fps, *label, tuple(cuts[:-1]), tuple(clips))


class _Stretches:
    """Endless stretches of takes in a drawn order, each at most a segment long."""

    def __init__(self, mocap: Mocap, takes, config: SequenceConfig, fps: float, rng: np.random.Generator):
        self.mocap, self.config, self.fps, self.rng = mocap, config, fps, rng
        self.takes, self.queue = takes, []

    def __call__(self) -> tuple[Clip, Clip]:
        if len(self.queue) == 0:
            for pair in (self.takes[index] for index in self.rng.permutation(len(self.takes))):
                self.queue += _together_in(self.mocap, pair, self.config, self.fps)
        return self.queue.pop(0)


def _together_in(
    mocap: Mocap, pair: tuple[int, int], config: SequenceConfig, fps: float
) -> list[tuple[Clip, Clip]]:
    """The stretches of a take in which the two are together."""
    lead, follow = (mocap.clip(index).resampled(fps) for index in pair)
    gap = np.linalg.norm((lead.pelvis - follow.pelvis)[:, [0, 2]], axis=1)
    near = np.flatnonzero(gap < config.apart_m)
    if len(near) < fps:
        return []
    first, last = int(near[0]), int(near[-1]) + 1
    parts = max(1, int(np.ceil((last - first) / (config.segment_frames * fps / 30.0))))
    edges = np.linspace(first, last, parts + 1).astype(int)
    return [(lead.between(a, b), follow.between(a, b)) for a, b in pairwise(edges.tolist())]


def _segment(
    mocap: Mocap,
    body: BodyModel,
    betas: Array,
    config: SequenceConfig,
    rng: np.random.Generator,
    fps: float,
    most: int,
    stretches: _Stretches,
) -> _Room:
    """Everybody from one cut to the next: first the pairs, then who stands, then who walks around them."""
    dancing = [stretches() for _ in range(config.pairs)]
    longest = round(config.segment_frames * fps / 30.0)
    frames = min([most, longest, *(len(lead) for lead, _ in dancing)])
    room = _Room(frames, [], [])
    for number, pair in enumerate(dancing):
        pair = (pair[0].between(0, frames), pair[1].between(0, frames))
        _place_pair(room, body, betas[2 * number : 2 * number + 2], pair, number, config, rng)
    still, walks = (clips(mocap, without=DANCERS) for clips in (standing_clips, walking_clips))
    person = 2 * config.pairs
    for index in _drawn(still, config.standing, rng):
        _place_standing(room, body, betas[person], mocap.clip(index), config, rng, fps)
        person += 1
    for index in _drawn(walks, config.walking, rng):
        clip, speed = mocap.clip(index), 0.0
        speed = float(np.linalg.norm(clip.pelvis[-1] - clip.pelvis[0]) / len(clip) * clip.fps)
        middles, limbs = room.points(_MIDDLES), room.points(_LIMBS)
        way = way_through(
            np.concatenate([middles, limbs], axis=1),
            frames,
            rng,
            fps=fps,
            speed_mps=min(speed, 1.35),
            distance_m=np.repeat([config.close_m, _ARM_M], [middles.shape[1], limbs.shape[1]]),
            half_room_m=config.half_room_m,
        )
        start = rng.uniform()
        room.add(walk_along(body, betas[person], clip, way.xy, way.heading, fps=fps, start=start), clip.name)
        person += 1
    return room


def _place_pair(
    room: _Room,
    body: BodyModel,
    betas: Array,
    pair: tuple[Clip, Clip],
    number: int,
    config: SequenceConfig,
    rng: np.random.Generator,
) -> None:
    """Put a pair where there is room: one factor for both, so that who holds hands still does."""
    legs = np.mean([Figure(body, shape).leg_m for shape in betas])
    scale = float(legs / np.mean([clip.leg_m for clip in pair]))
    two = [perform(body, shape, clip, scale=scale) for shape, clip in zip(betas, pair, strict=True)]
    two = hold_hands(two[0], two[1], pair[0].fps)
    steps = np.concatenate([one.joints[:, 0, :2] for one in two])
    middle = (steps.min(axis=0) + steps.max(axis=0)) / 2
    two = [one.moved(-middle) for one in two]
    alone = config.pairs == 1
    along, side = _long_axis(steps - middle), 0.0 if alone else (-0.6, 0.6)[number]
    options = [
        (
            rng.uniform(-np.pi, np.pi) if alone else rng.choice([0.0, np.pi]) - along + rng.normal(0.0, 0.25),
            np.array([0.0, side]) + rng.normal(0.0, 0.2, 2),
        )
        for _ in range(60)
    ]
    others = room.points()
    worth = []
    for turn, shift in options:
        moved = np.concatenate([one.moved(shift, turn).joints[::3, [0, 9], :2] for one in two], axis=1)
        outside = float(np.maximum(np.abs(moved) - config.half_room_m, 0.0).max())
        gaps = np.linalg.norm(moved[:, :, None] - others[::3, None], axis=-1)
        nearest = float(gaps.min()) if gaps.size > 0 else config.close_m
        # Close, but not closer than allowed, and inside the room.
        worth.append(-20 * max(config.close_m - nearest, 0.0) - max(nearest - config.close_m, 0.0) - 10 * outside)
    placed = (
        [one.moved(options[index][1], float(options[index][0])) for one in two]
        for index in np.argsort(worth)[::-1][:_TRIED]
    )
    for one, clip in zip(_roomiest(room, placed, config), pair, strict=True):
        room.add(one, clip.name)


def _place_standing(
    room: _Room,
    body: BodyModel,
    betas: Array,
    clip: Clip,
    config: SequenceConfig,
    rng: np.random.Generator,
    fps: float,
) -> None:
    """Put somebody who stands at a free spot close to the others, turned towards them."""
    one = stand(body, betas, clip, room.frames, fps, start=int(rng.integers(10_000)))
    faces = one.rotations[:, 0, :2, 2].mean(axis=0) if room.frames > 0 else np.array([1.0, 0.0])
    spots = rng.uniform(-config.half_room_m, config.half_room_m, (150, 2))
    noise = rng.normal(0.0, 0.5, 150)
    others = room.points()
    nearest = np.linalg.norm(others[None, ::3] - spots[:, None, None], axis=-1)
    nearest = nearest.min(axis=(1, 2)) if nearest.size > 0 else np.full(150, config.close_m)
    short = np.maximum(config.close_m + 0.1 - nearest, 0.0)
    order = np.argsort(20 * short + np.maximum(nearest - config.close_m, 0.0))[:_TRIED]
    towards = others.mean(axis=(0, 1)) - spots if others.size > 0 else np.tile([1.0, 0.0], (len(spots), 1))
    turns = np.arctan2(towards[:, 1], towards[:, 0]) - np.arctan2(faces[1], faces[0]) + noise
    placed = ([one.moved(spots[index], float(turns[index]))] for index in order)
    room.add(_roomiest(room, placed, config)[0], clip.name)


def _roomiest(room: _Room, options: Iterable[list[Performance]], config: SequenceConfig) -> list[Performance]:
    """The first of the ways to place people that leaves everybody room enough, else the one that leaves most."""
    best, most = [], -np.inf
    for placed in options:
        free = min((_gap(one, other, config) for one in placed for other in room.performed), default=0.0)
        reach = max(np.abs(one.joints[:, 0, :2]).max(initial=0.0) for one in placed)
        free = min(free, config.half_room_m - float(reach))
        if free > most:
            best, most = placed, free
        if free >= 0.0:
            break
    return best


def _gap(one: Performance, other: Performance, config: SequenceConfig) -> float:
    """How much room two people leave each other beyond what is asked for, metres; negative where too little."""
    a, b = one.joints[::5], other.joints[::5]
    limbs = np.linalg.norm(a[:, :, None] - b[:, None], axis=-1).min(initial=9.0) - config.limbs_m
    trunks = clearance_m(a, b).min(initial=9.0) - _TORSO_M
    hips = np.linalg.norm((a - b)[:, 0, :2], axis=-1).min(initial=9.0) - config.close_m
    return float(min(limbs, trunks, hips))


def _shapes(config: SequenceConfig, rng: np.random.Generator) -> Array:
    """(P, 10) betas: those of a pair are near each other, so that their hands still meet."""
    betas = rng.normal(0.0, config.shape_spread, (config.people, 10))
    for lead in range(0, 2 * config.pairs, 2):
        betas[lead : lead + 2] = 0.6 * betas[lead] + rng.normal(0.0, 0.25, (2, 10))
    return np.clip(betas, -1.8, 1.8)


def _drawn(clips: list[int], count: int, rng: np.random.Generator) -> list[int]:
    """`count` clips, none twice before all were drawn once."""
    if count > 0 and len(clips) == 0:
        raise ValueError(
            "these recordings hold nobody who stands or walks, other than the dancers: give the whole file"
        )
    rounds = -(-count // max(len(clips), 1))
    return [clips[index] for _ in range(rounds) for index in rng.permutation(len(clips))][:count]


def _joined(parts: list[Motion]) -> Motion:
    """Motions of the same people one after the other."""
    names = ("global_orient", "body_pose", "transl")
    return Motion(parts[0].betas, *(np.concatenate([getattr(part, name) for part in parts]) for name in names))


def _long_axis(points: Array) -> float:
    """Direction in which points (N, 2) spread most."""
    _, vectors = np.linalg.eigh(np.cov(points.T) if len(points) > 1 else np.eye(2))
    return float(np.arctan2(vectors[1, -1], vectors[0, -1]))


def _take(name: str) -> int:
    """Number of the trial in a clip's name, "60_09#1" -> 9; -1 where it has none."""
    match = re.fullmatch(r"6[01]_(\d+)(#\d+)?", name)
    return int(match.group(1)) if match is not None else -1
