"""Reads Shelf's annotation: the text format of 4D Association."""

from contextlib import suppress
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from shapepose_fg.core.arrays import Array
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.storage.files import read_text
from shapepose_fg.evaluation.metrics import PlainPeople

SHELF_JOINTS = tuple(
    "RAnkle RKnee RHip LHip LKnee LAnkle RWrist RElbow RShoulder LShoulder LElbow LWrist Neck "
    "HeadTop MidHip".split()
)
"""The 15 annotated joints, in the order of the file."""
_MAX_PEOPLE, _MAX_FRAMES = 1000, 10**7
"""Largest numbers of people and frames; larger ones are invalid."""


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
    if joints != len(SHELF_JOINTS) or not 0 <= frames <= _MAX_FRAMES:
        refuse(
            f"must say {len(SHELF_JOINTS)} joints and the number of frames, got {joints} and "
            f"{frames}"
        )
    who, rows = list[tuple[int, int]](), list[Array]()
    for frame in range(frames):
        (people,) = take(1, f"the number of people in frame {frame}", int)
        if not 0 <= people <= _MAX_PEOPLE:
            refuse(f"must be the number of people in frame {frame}, got {people}")
        for _ in range(people):
            (person,) = take(1, f"a person's id in frame {frame}", int)
            if (frame, person) in who[-people:] or not 0 <= person < 2**62:
                refuse(f"gives the id {person} in frame {frame}; ids must be 0 or more and differ")
            who.append((frame, person))
            meanings = (
                f"{joints} values of {row} in frame {frame}"
                for row in ("x", "y", "z", "confidence")
            )
            rows.append(np.stack([take(joints, meaning, float) for meaning in meanings], axis=1))
    if at < len(lines):
        at += 1
        refuse(f"goes on after the {frames} frames that line 1 promises")
    frame, person = np.array(who, dtype=np.int64).reshape(-1, 2).T
    xyz = np.stack(rows)[..., :3] if rows else np.zeros((0, joints, 3))
    return PlainPeople(frame, xyz, person, SHELF_JOINTS, complete=False)
