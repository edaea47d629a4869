"""Named interaction sequences with real two-person salsa takes, in a room with further people.

Takes 60/61_01 to _07 are for choosing settings ("tune"), _09 to _15 for reporting ("report"); all
other people come from other subjects. Room of 4 x 4 m, world z up, floor at z = 0.
"""

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Literal

import numpy as np

from shapepose_fg.body.model.body_model import BodyModel
from shapepose_fg.core.arrays import Array
from shapepose_fg.core.decompositions import comparable
from shapepose_fg.core.skeleton import smpl_joints
from shapepose_fg.simulation.bystanders import (
    path_through,
    stand,
    standing_clips,
    walk_along,
    walking_clips,
)
from shapepose_fg.simulation.limbs import turned_about
from shapepose_fg.simulation.mocap import Clip, Mocap
from shapepose_fg.simulation.motion import BodyMotion
from shapepose_fg.simulation.performance import Figure, Performance, hold_hands, perform, together
from shapepose_fg.simulation.scene import Scene, ring_of_cameras

_TORSO = smpl_joints("pelvis spine2 spine3 neck")
"""Pelvis, spine and neck: joints from which other people must keep a distance."""
_HALF_ROOM_M = 1.75
"""Maximum distance of pelvises from the centre of the room, in x and in y, m."""
_MIDDLES = smpl_joints("pelvis spine3")
_LIMBS = smpl_joints(
    "left_elbow right_elbow left_wrist right_wrist left_hand right_hand left_knee right_knee"
)
_SPOTS, _PAIR_OPTIONS, _TRIED = 150, 60, 30
"""Number of random positions for standing people and for pairs, and number of them that
are tested."""


@dataclass(frozen=True)
class SequenceConfig:
    """Composition and difficulty of a sequence."""

    pairs: int = 1
    """Number of salsa pairs at a time, 0 to 2."""
    standing: int = 1
    """Number of people who stand close and gesture."""
    walking: int = 1
    """Number of people who walk through, between and around."""
    close_m: float = 0.45
    """Approximate minimum distance between the pelvises of people who do not dance together, m."""
    segment_frames: int = 600
    """Maximum length of a segment without a cut, frames at 30 Hz."""
    frames: int = 3000
    """Length of the sequence, frames at 30 Hz."""
    camera_distance_m: tuple[float, float] = (3.1, 3.6)
    """Range of the cameras' distances from the centre, m."""
    camera_height_m: tuple[float, float] = (2.0, 2.5)
    """Range of the cameras' heights, m; every second one is 0.3 m lower."""
    focal_px: tuple[float, float] = (860.0, 940.0)
    """Range of the cameras' focal lengths, px."""
    seed: int = 0
    """Seed of all random values."""
    without: frozenset[str] = frozenset()
    """Subjects excluded from standing and walking people; the dancers always are."""

    def __post_init__(self) -> None:
        if not (0 <= self.pairs <= 2 and self.standing >= 0 and self.walking >= 0):
            raise ValueError(
                f"pairs must be 0, 1 or 2, standing and walking at least 0; got {self}"
            )
        if not (self.close_m > 0 and self.segment_frames > 0 and self.frames >= 0):
            raise ValueError(
                f"close_m, segment_frames must be positive, frames at least 0; got {self}"
            )

    @property
    def people(self) -> int:
        """Number of people."""
        return 2 * self.pairs + self.standing + self.walking


class Room:
    """The people in the room between two cuts."""

    def __init__(
        self,
        body: BodyModel,
        config: SequenceConfig,
        frames: int,
        fps: float,
        rng: np.random.Generator,
    ):
        self.body, self.config, self.frames, self.fps, self.rng = body, config, frames, fps, rng
        self.performed: list[Performance] = []
        """Motions of the people, in order of arrival."""
        self.names: list[str] = []
        """Name of the recording of each motion in `performed`."""

    def add_pair(self, betas: Array, pair: tuple[Clip, Clip]) -> None:
        """Add two people who dance together, with a common scale, so that held hands
        stay together.
        """
        legs = np.mean([Figure(self.body, shape).leg_m for shape in betas])
        scale = float(legs / np.mean([clip.leg_m for clip in pair]))
        two = hold_hands(
            perform(self.body, betas[0], pair[0], scale=scale),
            perform(self.body, betas[1], pair[1], scale=scale),
            self.fps,
        )
        steps = np.concatenate([one.joints[:, 0, :2] for one in two])
        middle = (steps.min(axis=0) + steps.max(axis=0)) / 2
        two = [one.moved(-middle) for one in two]
        turns, shifts = self._pair_options(_long_axis(steps - middle))
        scores = [
            self._position_score(two, turn, shift)
            for turn, shift in zip(turns, shifts, strict=True)
        ]
        placed = (
            [one.moved(shifts[index], float(turns[index])) for one in two]
            for index in np.argsort(comparable(-np.array(scores)), kind="stable")[:_TRIED]
        )
        for one, clip in zip(self._roomiest(placed), pair, strict=True):
            self._add(one, clip.name)

    def add_standing(self, betas: Array, clip: Clip) -> None:
        """Add a person who stays at a free spot close to the others, facing them."""
        one = stand(
            self.body, betas, clip, self.frames, self.fps, start=int(self.rng.integers(10_000))
        )
        faces = one.rotations[:, 0, :2, 2].mean(axis=0)
        spots = self.rng.uniform(-_HALF_ROOM_M, _HALF_ROOM_M, (_SPOTS, 2))
        noise = self.rng.normal(0.0, 0.5, _SPOTS)
        others = self.points(_MIDDLES)
        if others.shape[1] > 0:
            nearest = np.linalg.norm(others[None, ::3] - spots[:, None, None], axis=-1).min(
                axis=(1, 2)
            )
            towards = others.mean(axis=(0, 1)) - spots
        else:
            nearest, towards = (
                np.full(_SPOTS, self.config.close_m),
                np.tile([1.0, 0.0], (_SPOTS, 1)),
            )
        turns = np.arctan2(towards[:, 1], towards[:, 0]) - np.arctan2(faces[1], faces[0]) + noise
        short = np.maximum(self.config.close_m + 0.1 - nearest, 0.0)
        far = comparable(20 * short + np.maximum(nearest - self.config.close_m, 0.0))
        order = np.argsort(far, kind="stable")[:_TRIED]
        placed = ([one.moved(spots[index], float(turns[index]))] for index in order)
        self._add(self._roomiest(placed)[0], clip.name)

    def add_walking(self, betas: Array, clip: Clip) -> None:
        """Add a person who walks through, between and around all others."""
        middles, limbs = self.points(_MIDDLES), self.points(_LIMBS)
        speed = float(np.linalg.norm(clip.pelvis[-1] - clip.pelvis[0]) / len(clip) * clip.fps)
        # Maximum speed of walking people in a crowded room, m/s.
        # Distance of walking people from others' limbs, m.
        path, heading = path_through(
            np.concatenate([middles, limbs], axis=1),
            self.frames,
            self.rng,
            fps=self.fps,
            speed_mps=min(speed, 1.35),
            distance_m=np.repeat([self.config.close_m, 0.3], [middles.shape[1], limbs.shape[1]]),
            half_room_m=_HALF_ROOM_M,
        )
        start = self.rng.uniform()
        walk = walk_along(self.body, betas, clip, path, heading, fps=self.fps, start=start)
        self._add(walk, clip.name)

    def points(self, joints: tuple[int, ...]) -> Array:
        """(T, P x joints, 2) positions of SMPL's `joints` of all people on the floor."""
        if len(self.performed) == 0:
            return np.zeros((self.frames, 0, 2))
        return np.concatenate([p.joints[:, list(joints), :2] for p in self.performed], axis=1)

    def _add(self, performance: Performance, name: str) -> None:
        self.performed.append(performance)
        self.names.append(name)

    def _pair_options(self, along: float) -> tuple[Array, Array]:
        """Rotations (N,) and positions (N, 2) for a pair with steps mainly `along`; two pairs dance
        side by side.
        """
        if self.config.pairs == 1:
            turns, side = self.rng.uniform(-np.pi, np.pi, _PAIR_OPTIONS), 0.0
        else:
            turns = (
                self.rng.choice([0.0, np.pi], _PAIR_OPTIONS)
                - along
                + self.rng.normal(0.0, 0.25, _PAIR_OPTIONS)
            )
            side = -0.6 if len(self.performed) == 0 else 0.6
        return turns, np.array([0.0, side]) + self.rng.normal(0.0, 0.2, (_PAIR_OPTIONS, 2))

    def _position_score(self, two: list[Performance], turn: float, shift: Array) -> float:
        """Score of a pair's position: inside the room, close to others, but not closer than
        allowed.
        """
        steps = np.concatenate([one.joints[::3, list(_MIDDLES), :2] for one in two], axis=1)
        steps = steps @ turned_about("z", np.array([turn]))[0, :2, :2].T + shift
        outside = float(np.maximum(np.abs(steps) - _HALF_ROOM_M, 0.0).max())
        gaps = np.linalg.norm(steps[:, :, None] - self.points(_MIDDLES)[::3, None], axis=-1)
        spare = float(gaps.min()) - self.config.close_m if gaps.size > 0 else 0.0
        return 20.0 * min(spare, 0.0) - max(spare, 0.0) - 10.0 * outside

    def _roomiest(self, options: Iterable[list[Performance]]) -> list[Performance]:
        """The first option with sufficient distances to other people and walls; the option with the
        largest distances, if none suffices.
        """
        best, most = [], -np.inf
        for placed in options:
            reach = max(np.abs(one.joints[:, 0, :2]).max() for one in placed)
            free = min(
                (self._gap(one, other) for one in placed for other in self.performed), default=0.0
            )
            free = float(comparable(min(free, _HALF_ROOM_M - float(reach))))
            if free > most:
                best, most = placed, free
            if free >= 0.0:
                break
        return best

    def _gap(self, one: Performance, other: Performance) -> float:
        """Distance of two people minus the required one, metres."""
        a, b = one.joints[::5], other.joints[::5]
        # Minimum distance of a standing person's joints from those of others, if space
        # permits, m.
        limbs = np.linalg.norm(a[:, :, None] - b[:, None], axis=-1).min() - 0.12
        # Minimum distance of another person's joints from pelvis, spine and neck, m.
        trunks = clearance_m(a, b).min() - 0.2
        hips = np.linalg.norm((a - b)[:, 0, :2], axis=-1).min() - self.config.close_m
        return float(min(limbs, trunks, hips))


def clearance_m(first: Array, second: Array) -> Array:
    """Minimum distance (T,) between the torso joints of one person and any joint of the other, (T,
    24, 3) each.
    """
    trunk = list(_TORSO)
    gaps = [
        np.linalg.norm(a[:, trunk, None] - b[:, None], axis=-1).min(axis=(1, 2))
        for a, b in ((first, second), (second, first))
    ]
    return np.minimum(*gaps)


def _long_axis(points: Array) -> float:
    """Principal direction of points (N, 2), from -1 to pi - 1 radians; 0 if they are isotropic.

    The range ends where no axis of a symmetric motion is.
    """
    x, y = (points - points.mean(axis=0)).T
    along, across, most = (x**2 - y**2).sum(), 2 * (x * y).sum(), (x**2 + y**2).sum()
    if np.hypot(along, across) <= 1e-9 * most:
        return 0.0
    return float((np.arctan2(across, along) / 2 + 1) % np.pi - 1)


Split = Literal["tune", "report"]

DANCERS = frozenset({"60", "61"})
"""Subjects of the salsa takes; no network is trained on them."""
TAKES: dict[str, range] = {"tune": range(1, 8), "report": range(9, 16)}
"""Numbers of the takes of each split."""
_IMAGE_PX_A_M = 259.0
"""Size of people in the image, pixels per metre, for all distances of the cameras."""


def _from_afar(distance_m: float) -> dict[str, Any]:
    """Settings of distant cameras at hip height with long lenses.

    Rays to the same joint of different people are nearly in one plane and intersect wherever a
    person could be. With the distance, rays become flatter, but one person occludes less of the
    room. Distances were chosen on the tune split, so that there is room for improvement, and hips
    are seen in at least 4.5 views (docs/simulation.md).
    """
    range_m = (distance_m, distance_m + 0.5)
    focal_px = (_IMAGE_PX_A_M * range_m[0], _IMAGE_PX_A_M * range_m[1])
    return {"camera_distance_m": range_m, "camera_height_m": (1.0, 1.15), "focal_px": focal_px}


SEQUENCES: dict[str, SequenceConfig] = {
    "salsa": SequenceConfig(pairs=1, standing=3, walking=3, seed=11, **_from_afar(8.0)),
    "crossing": SequenceConfig(pairs=1, standing=1, walking=4, seed=23, **_from_afar(10.0)),
    "crowd": SequenceConfig(pairs=2, standing=2, walking=2, seed=37, **_from_afar(7.0)),
}
"""Sequences by name: a pair with three standing and three walking people; mostly walkers; two pairs
and others."""


def sequence(
    name: str,
    split: Split,
    mocap: Mocap,
    *,
    body: BodyModel | None = None,
    cameras: int = 6,
    frames: int | None = None,
    until: int | None = None,
    fps: float = 30.0,
    config: SequenceConfig | None = None,
) -> Scene:
    """Interaction sequence `name` of `SEQUENCES` from the takes of `split`, seen by `cameras`
    cameras.

    `config` replaces that of the name; `frames` its length. With `until`, no segment is generated
    that begins at that frame or later; the others are as in the whole recording. Raises ValueError
    for an unknown name or split, or recordings without a take of that split.
    """
    if name not in SEQUENCES or split not in TAKES:
        raise ValueError(
            f"name must be one of {', '.join(SEQUENCES)}, split one of {', '.join(TAKES)}; got "
            f"{name}, {split}"
        )
    config = SEQUENCES[name] if config is None else config
    takes = salsa_takes(mocap, split)
    if len(takes) == 0:
        raise ValueError(
            f"these recordings have no salsa take of split {split!r}; give the complete "
            "cmu_smpl24.npz (docs/simulation.md)"
        )
    rng = np.random.default_rng([config.seed, list(TAKES).index(split)])
    body = BodyModel.default() if body is None else body
    frames = config.frames if frames is None else frames
    rig = ring_of_cameras(
        cameras,
        rng,
        distance_m=config.camera_distance_m,
        height_m=config.camera_height_m,
        focal_px=config.focal_px,
    )
    betas, without = _shapes(config, rng), DANCERS | config.without
    dances = _dances(mocap, takes, config, fps, rng)
    parts, clips, starts = [BodyMotion.still(betas, 0)], [], [0]
    while starts[-1] < (frames if until is None else min(until, frames)):
        # One segment between cuts: first pairs, then standing people, then people walking around
        # them.
        dancing = [next(dances) for _ in range(config.pairs)]
        longest = max(1, round(config.segment_frames * fps / 30.0))
        length = min([frames - starts[-1], longest, *(len(lead) for lead, _ in dancing)])
        room = Room(body, config, length, fps, rng)
        for number, pair in enumerate(dancing):
            lead, follow = (clip.between(0, length) for clip in pair)
            room.add_pair(betas[2 * number : 2 * number + 2], (lead, follow))
        for index in _drawn(standing_clips(mocap, without=without), config.standing, rng):
            room.add_standing(betas[len(room.names)], mocap.clip(index))
        for index in _drawn(walking_clips(mocap, without=without), config.walking, rng):
            room.add_walking(betas[len(room.names)], mocap.clip(index))
        parts.append(together(betas, room.performed, room.frames))
        clips.append(tuple(room.names))
        starts.append(starts[-1] + room.frames)
    return Scene(rig, body, BodyMotion.concatenate(parts), fps, tuple(starts[1:-1]), tuple(clips))


def salsa_takes(mocap: Mocap, split: Split) -> list[tuple[int, int]]:
    """The salsa takes of a split: numbers of the clips of the lead and of the follower."""
    return [pair for pair in mocap.pairs if _take(mocap.names[pair[0]]) in TAKES[split]]


def _dances(
    mocap: Mocap,
    takes: list[tuple[int, int]],
    config: SequenceConfig,
    fps: float,
    rng: np.random.Generator,
) -> Iterator[tuple[Clip, Clip]]:
    """Endless stream of segments from takes in random order, each as long as possible without a
    cut.
    """
    while True:
        drawn = [takes[index] for index in rng.permutation(len(takes))]
        segments = [segment for pair in drawn for segment in _together_in(mocap, pair, config, fps)]
        if len(segments) == 0:
            raise ValueError(
                "these recordings have no salsa take in which the two dancers are close "
                "together; give the complete cmu_smpl24.npz (docs/simulation.md)"
            )
        yield from segments


def _together_in(
    mocap: Mocap, pair: tuple[int, int], config: SequenceConfig, fps: float
) -> list[tuple[Clip, Clip]]:
    """The segments of a take of two dancers in which they are close together."""
    lead, follow = (mocap.clip(index).resampled(fps) for index in pair)
    gap = np.linalg.norm((lead.pelvis - follow.pelvis)[:, [0, 2]], axis=1)
    # Maximum distance of the dancers at the ends of the used part of a take, m.
    near = np.flatnonzero(gap < 1.3)
    if len(near) < fps:
        return []
    first, last = int(near[0]), int(near[-1]) + 1
    parts = max(1, int(np.ceil((last - first) / (config.segment_frames * fps / 30.0))))
    edges = np.linspace(first, last, parts + 1).astype(int)
    return [(lead.between(a, b), follow.between(a, b)) for a, b in pairwise(edges.tolist())]


def _shapes(config: SequenceConfig, rng: np.random.Generator) -> Array:
    """(P, 10) betas; similar within a pair, so that the hands still meet."""
    # Standard deviation of the betas over people; smaller within a pair.
    betas = rng.normal(0.0, 0.8, (config.people, 10))
    for lead in range(0, 2 * config.pairs, 2):
        betas[lead : lead + 2] = 0.6 * betas[lead] + rng.normal(0.0, 0.25, (2, 10))
    return np.clip(betas, -1.8, 1.8)


def _drawn(clips: list[int], count: int, rng: np.random.Generator) -> list[int]:
    """Draw `count` clips; none is repeated before all are drawn once."""
    if count > 0 and len(clips) == 0:
        raise ValueError(
            "these recordings have no standing or walking people; give the complete "
            "cmu_smpl24.npz (docs/simulation.md)"
        )
    rounds = -(-count // max(len(clips), 1))
    return [clips[index] for _ in range(rounds) for index in rng.permutation(len(clips))][:count]


def _take(name: str) -> int:
    """Number of the trial in a clip's name, "60_09#1" -> 9; -1 if there is none."""
    match = re.fullmatch(r"6[01]_(\d+)(#\d+)?", name)
    return int(match.group(1)) if match is not None else -1
