"""Named interaction sequences around real two-person salsa takes, and random scenes of recorded motions.

Takes 60/61_01 to _07 are for choosing settings ("tune"), _09 to _15 for reporting ("report"); whoever else is
in the room comes from other subjects. Room of 4 x 4 m, world z up, floor at z = 0.
"""

import re
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.body.model.body_model import BodyModel
from shapepose_fg.simulation.bystanders import standing_clips, walking_clips
from shapepose_fg.simulation.mocap import Clip, Mocap
from shapepose_fg.simulation.motion import Motion
from shapepose_fg.simulation.performance import together
from shapepose_fg.simulation.room import Room, SequenceConfig
from shapepose_fg.simulation.scene import Scene, ring_of_cameras

Array = NDArray[np.float64]
Split = Literal["tune", "report"]

DANCERS = frozenset({"60", "61"})
"""Subjects of the salsa takes: nobody trains on them."""
TAKES: dict[str, range] = {"tune": range(1, 8), "report": range(9, 16)}
"""Numbers of the takes of each split."""
_IMAGE_PX_A_M = 259.0
"""Everybody is as large in the image, whatever the cameras' distance."""


def _from_afar(distance_m: float) -> dict[str, Any]:
    """Cameras at the height of the hips, far away, with long lenses.

    Rays to different people's same joints lie nearly in one plane and cross wherever somebody could stand. From
    farther away they are flatter still, but one person hides less of the room. Distances were chosen on the tune
    split, for room to get better in and hips that are seen in 4.5 views or more (docs/simulation.md).
    """
    range_m = (distance_m, distance_m + 0.5)
    focal_px = (_IMAGE_PX_A_M * range_m[0], _IMAGE_PX_A_M * range_m[1])
    return {"camera_distance_m": range_m, "camera_height_m": (1.0, 1.15), "focal_px": focal_px}


SEQUENCES: dict[str, SequenceConfig] = {
    "salsa": SequenceConfig(pairs=1, standing=3, walking=3, seed=11, **_from_afar(8.0)),
    "crossing": SequenceConfig(pairs=1, standing=1, walking=4, seed=23, **_from_afar(10.0)),
    "crowd": SequenceConfig(pairs=2, standing=2, walking=2, seed=37, **_from_afar(7.0)),
}
"""A pair among three who stand and three who walk; mostly walkers, through and between; two pairs and others."""


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
    until: int | None = None,
    fps: float = 30.0,
    config: SequenceConfig | None = None,
) -> Sequence:
    """Interaction sequence `name` of `SEQUENCES` from the takes of `split`, before `cameras` cameras.

    `config` takes the place of the named one's; `frames` of its length. With `until` no segment
    is made that begins at that frame or later: what there is of the recording is as in the whole one. ValueError
    for an unknown name or split, or recordings without a take of that split.
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
    return _compose(mocap, takes, config, rng, body, cameras, frames, fps, (name, split), until)


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
    until: int | None = None,
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
        focal_px=config.focal_px,
    )
    betas = _shapes(config, rng)
    stretches = _Stretches(mocap, takes, config, fps, rng)
    parts: list[Motion] = []
    clips: list[tuple[str, ...]] = []
    cuts: list[int] = []
    done = 0
    while done < (frames if until is None else min(until, frames)):
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
) -> Room:
    """Everybody from one cut to the next: first the pairs, then who stands, then who walks around them."""
    dancing = [stretches() for _ in range(config.pairs)]
    longest = max(1, round(config.segment_frames * fps / 30.0))
    frames = min([most, longest, *(len(lead) for lead, _ in dancing)])
    room = Room(body, config, frames, fps, rng)
    for number, (lead, follow) in enumerate(dancing):
        room.add_pair(betas[2 * number : 2 * number + 2], (lead.between(0, frames), follow.between(0, frames)))
    for index in _drawn(standing_clips(mocap, without=DANCERS | config.without), config.standing, rng):
        room.add_standing(betas[len(room.names)], mocap.clip(index))
    for index in _drawn(walking_clips(mocap, without=DANCERS | config.without), config.walking, rng):
        room.add_walking(betas[len(room.names)], mocap.clip(index))
    return room


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


def _take(name: str) -> int:
    """Number of the trial in a clip's name, "60_09#1" -> 9; -1 where it has none."""
    match = re.fullmatch(r"6[01]_(\d+)(#\d+)?", name)
    return int(match.group(1)) if match is not None else -1
