"""Reads Shelf's annotation: the text format of 4D Association."""

from collections.abc import Iterator
from pathlib import Path
from typing import NoReturn

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
    lines = _Lines(Path(path))
    joints, frames = lines.integers(2, "the number of joints and of frames")
    if joints != len(SHELF_JOINTS) or not 0 <= frames <= _MAX_FRAMES:
        lines.refuse(
            f"must say {len(SHELF_JOINTS)} joints and the number of frames, got {joints} and "
            f"{frames}"
        )
    who, rows = list[tuple[int, int]](), list[Array]()
    for frame in range(frames):
        (people,) = lines.integers(1, f"the number of people in frame {frame}")
        if not 0 <= people <= _MAX_PEOPLE:
            lines.refuse(f"must be the number of people in frame {frame}, got {people}")
        seen: set[int] = set()
        for _ in range(people):
            (person,) = lines.integers(1, f"a person's id in frame {frame}")
            if person in seen or not 0 <= person < 2**62:
                lines.refuse(
                    f"gives the id {person} in frame {frame}; ids must be 0 or more and differ"
                )
            seen.add(person)
            who.append((frame, person))
            meanings = (
                f"{joints} values of {row} in frame {frame}"
                for row in ("x", "y", "z", "confidence")
            )
            rows.append(np.stack([lines.numbers(joints, meaning) for meaning in meanings], axis=1))
    if lines.left():
        lines.refuse(f"goes on after the {frames} frames that line 1 promises")
    frame, person = np.array(who, dtype=np.int64).reshape(-1, 2).T
    xyz = np.stack(rows)[..., :3] if rows else np.zeros((0, joints, 3))
    return PlainPeople(frame, xyz, person, SHELF_JOINTS, complete=False)


class _Lines:
    """Iterates over the non-blank lines of a text file, and tracks the current position for error
    messages.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._place = 0
        self._lines: Iterator[tuple[int, str]] = (
            (place, line)
            for place, line in enumerate(read_text(path).splitlines(), 1)
            if line.strip()
        )

    def refuse(self, complaint: str) -> NoReturn:
        raise InputError(f"{self._path}: line {self._place} {complaint}; copy the file again")

    def integers(self, count: int, meaning: str) -> list[int]:
        words = self._next(count, meaning)
        try:
            return [int(word) for word in words]
        except ValueError:
            self.refuse(f"must hold {meaning}, got {' '.join(words)[:40]!r}")

    def numbers(self, count: int, meaning: str) -> Array:
        words = self._next(count, meaning)
        try:
            values = np.array([float(word) for word in words])
        except ValueError:
            values = np.array([np.inf])
        if not np.isfinite(values).all():
            self.refuse(f"must hold {meaning}, all finite numbers")
        return values

    def left(self) -> bool:
        """Advance to the next line; returns whether there is one."""
        self._place, line = next(self._lines, (self._place, ""))
        return len(line) > 0

    def _next(self, count: int, meaning: str) -> list[str]:
        entry = next(self._lines, None)
        if entry is None:
            raise InputError(
                f"{self._path}: the file ends after line {self._place}, before {meaning}; copy "
                "the whole file again"
            )
        self._place, line = entry
        words = line.split()
        if len(words) != count:
            self.refuse(f"must hold {meaning}, got {len(words)} values")
        return words
