"""Named interaction sequences around real two-person salsa takes.

Takes 60/61_01 to _07 are for choosing settings ("tune"), _09 to _15 for reporting ("report"); whoever else is
in the room comes from other subjects. Room of 4 x 4 m, world z up, floor at z = 0.
"""

import re
from collections.abc import Iterator
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
"""Subjects of the salsa takes: no network trains on them."""
TAKES: dict[str, range] = {"tune": range(1, 8), "report": range(9, 16)}
"""Numbers of the takes of each split."""
_APART_M = 1.3
"""A take is used from where the dancers come nearer than this to where they part."""
_SHAPE_SPREAD = 0.8
"""Standard deviation of the betas over people; a pair's two differ by less."""
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
    parts, clips, starts = [Motion.still(betas, 0)], [], [0]
    while starts[-1] < (frames if until is None else min(until, frames)):
        # Everybody from one cut to the next: first the pairs, then who stands, then who walks around them.
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
    return Scene(rig, body, Motion.joined(parts), fps, tuple(starts[1:-1]), tuple(clips))


def salsa_takes(mocap: Mocap, split: Split) -> list[tuple[int, int]]:
    """The pairs of clips of a split, lead and follow."""
    return [pair for pair in mocap.pairs if _take(mocap.names[pair[0]]) in TAKES[split]]


def _dances(
    mocap: Mocap, takes: list[tuple[int, int]], config: SequenceConfig, fps: float, rng: np.random.Generator
) -> Iterator[tuple[Clip, Clip]]:
    """Segments of takes in a drawn order without end, each as long as may be without a cut at the most."""
    while True:
        drawn = [takes[index] for index in rng.permutation(len(takes))]
        segments = [segment for pair in drawn for segment in _together_in(mocap, pair, config, fps)]
        if len(segments) == 0:
            raise ValueError("in none of these salsa takes the two dance together: give the whole file")
        yield from segments


def _together_in(
    mocap: Mocap, pair: tuple[int, int], config: SequenceConfig, fps: float
) -> list[tuple[Clip, Clip]]:
    """The segments of a take in which the two are together."""
    lead, follow = (mocap.clip(index).resampled(fps) for index in pair)
    gap = np.linalg.norm((lead.pelvis - follow.pelvis)[:, [0, 2]], axis=1)
    near = np.flatnonzero(gap < _APART_M)
    if len(near) < fps:
        return []
    first, last = int(near[0]), int(near[-1]) + 1
    parts = max(1, int(np.ceil((last - first) / (config.segment_frames * fps / 30.0))))
    edges = np.linspace(first, last, parts + 1).astype(int)
    return [(lead.between(a, b), follow.between(a, b)) for a, b in pairwise(edges.tolist())]


def _shapes(config: SequenceConfig, rng: np.random.Generator) -> Array:
    """(P, 10) betas: those of a pair are near each other, so that their hands still meet."""
    betas = rng.normal(0.0, _SHAPE_SPREAD, (config.people, 10))
    for lead in range(0, 2 * config.pairs, 2):
        betas[lead : lead + 2] = 0.6 * betas[lead] + rng.normal(0.0, 0.25, (2, 10))
    return np.clip(betas, -1.8, 1.8)


def _drawn(clips: list[int], count: int, rng: np.random.Generator) -> list[int]:
    """`count` clips, none twice before all were drawn once."""
    if count > 0 and len(clips) == 0:
        raise ValueError("no one but the dancers stands or walks in these recordings: give the whole file")
    rounds = -(-count // max(len(clips), 1))
    return [clips[index] for _ in range(rounds) for index in rng.permutation(len(clips))][:count]


def _take(name: str) -> int:
    """Number of the trial in a clip's name, "60_09#1" -> 9; -1 where it has none."""
    match = re.fullmatch(r"6[01]_(\d+)(#\d+)?", name)
    return int(match.group(1)) if match is not None else -1
