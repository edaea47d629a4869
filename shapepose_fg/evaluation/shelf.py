"""Shelf's annotation: reads the text format of 4D Association, and maps BODY_25 to its joints."""

from contextlib import suppress
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from shapepose_fg.core.arrays import Array
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.core.storage.files import read_text
from shapepose_fg.evaluation.metrics import PlainPeople

SHELF_JOINTS = tuple(
    "RAnkle RKnee RHip LHip LKnee LAnkle RWrist RElbow RShoulder LShoulder LElbow LWrist Neck "
    "HeadTop MidHip".split()
)
"""The 15 annotated joints, in the order of the file."""
LIMB_ENDS = {
    "left upper arm": ("LShoulder", "LElbow"),
    "right upper arm": ("RShoulder", "RElbow"),
    "left lower arm": ("LElbow", "LWrist"),
    "right lower arm": ("RElbow", "RWrist"),
    "left upper leg": ("LHip", "LKnee"),
    "right upper leg": ("RHip", "RKnee"),
    "left lower leg": ("LKnee", "LAnkle"),
    "right lower leg": ("RKnee", "RAnkle"),
    "head": ("Neck", "HeadTop"),
    "torso": ("Neck", "MidHip"),
}
"""The joints at the ends of each limb."""
ACTORS = (0, 1, 2)
"""The scored ids of the annotation: actors 1, 2 and 3."""


def shelf_joints(body25: Array) -> Array:
    """Map BODY_25 joints (N, 25, 3), metres, z up, to Shelf's (N, 15, 3); NaN stays NaN.

    The hips, limbs and MidHip are the joints of the same name. With s and e the midpoints of
    shoulders and ears, Neck is s + 0.5 (e - s) and HeadTop is Neck + 0.125 f + 0.145 z, metres,
    with f the unit vector of (neck - midhip) x (RShoulder - LShoulder). The mapping is fixed:
    tuning it on the annotation would overfit. If one ear is unknown, e is the other ear projected
    on the plane halfway between the shoulders, in which the midpoint of two mirrored ears lies.
    """
    body25 = np.asarray(body25, dtype=np.float64)
    if body25.ndim != 3 or body25.shape[1:] != (25, 3):
        raise ValueError(f"body25 must be (N, 25, 3), got {body25.shape}")
    named = ("RShoulder", "LShoulder", "MidHip", "Neck", "REar", "LEar")
    right, left, midhip, neck, right_ear, left_ear = (
        body25[:, BODY_25.index(name)] for name in named
    )
    shoulders, across = 0.5 * (right + left), _unit(right - left)
    ear = np.where(np.isfinite(right_ear), right_ear, left_ear)
    mirrored = ear - np.sum((ear - shoulders) * across, axis=1, keepdims=True) * across
    middle = 0.5 * (right_ear + left_ear)
    middle = np.where(np.isfinite(middle), middle, mirrored)
    result = np.empty((len(body25), 15, 3))
    result[:, :12] = body25[:, [BODY_25.index(name) for name in SHELF_JOINTS[:12]]]
    result[:, 12] = shoulders + 0.5 * (middle - shoulders)
    result[:, 13] = (
        result[:, 12] + 0.125 * _unit(np.cross(neck - midhip, right - left)) + [0.0, 0.0, 0.145]
    )
    result[:, 14] = midhip
    return result


def _unit(vectors: Array) -> Array:
    """Unit vectors (N, 3); NaN for vectors of length zero."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors / np.where(length > 0, length, np.nan)


def read_shelf_ground_truth(path: Path | str) -> PlainPeople:
    """Annotated people in `SHELF_JOINTS`: `person` 0, 1, 2 are the actors 1, 2, 3; others are not
    scored, because not everybody is annotated.

    The file has the numbers of joints and of frames, then per frame the number of people, and per
    person an id and the rows x, y, z and confidence of all joints. InputError that names file and
    line for anything else.
    """
    lines = [
        (place, line.split())
        for place, line in enumerate(read_text(Path(path)).splitlines(), 1)
        if line.strip()
    ]
    at = 0

    def refuse(complaint: str) -> NoReturn:
        raise InputError(f"{path}: line {lines[at - 1][0]} {complaint}; copy the file again")

    def take(count: int, meaning: str, kind: type[int] | type[float]) -> list[Any]:
        """The next line, which must hold `count` finite numbers."""
        nonlocal at
        if at == len(lines):
            end = f"ends after line {lines[at - 1][0]}, before {meaning}"
            raise InputError(f"{path}: the file {end}; copy the whole file again")
        at += 1
        words, values = lines[at - 1][1], list[Any]()
        if len(words) != count:
            refuse(f"must hold {meaning}, got {len(words)} values")
        with suppress(ValueError):
            values = [kind(word) for word in words]
        if len(values) == 0 or (kind is float and not np.isfinite(values).all()):
            refuse(f"must hold {meaning}, all finite numbers, got {' '.join(words)[:40]!r}")
        return values

    joints, frames = take(2, "the number of joints and of frames", int)
    if joints != len(SHELF_JOINTS) or not 0 <= frames <= 10**7:
        refuse(
            f"must say {len(SHELF_JOINTS)} joints and the number of frames, got {joints} and "
            f"{frames}"
        )
    ids, rows = list[tuple[int, int]](), list[Array]()
    for frame in range(frames):
        (people,) = take(1, f"the number of people in frame {frame}", int)
        if not 0 <= people <= 1000:
            refuse(f"must be the number of people in frame {frame}, got {people}")
        for _ in range(people):
            (person,) = take(1, f"a person's id in frame {frame}", int)
            if (frame, person) in ids[-people:] or not 0 <= person < 2**62:
                refuse(f"gives the id {person} in frame {frame}; ids must be 0 or more and differ")
            ids.append((frame, person))
            meanings = (
                f"{joints} values of {row} in frame {frame}"
                for row in ("x", "y", "z", "confidence")
            )
            rows.append(np.stack([take(joints, meaning, float) for meaning in meanings], axis=1))
    if at < len(lines):
        at += 1
        refuse(f"goes on after the {frames} frames that line 1 promises")
    frame, person = np.array(ids, dtype=np.int64).reshape(-1, 2).T
    xyz = np.stack(rows)[..., :3] if rows else np.zeros((0, joints, 3))
    return PlainPeople(frame, xyz, person, SHELF_JOINTS, complete=False)
