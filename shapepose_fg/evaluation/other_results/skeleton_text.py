"""4D Association's text of people in 3D (`skel.txt`, and Shelf's annotation): who was where in each frame."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.errors import InputError
from shapepose_fg.core.storage.files import read_text

SHELF_JOINTS = tuple(
    "RAnkle RKnee RHip LHip LKnee LAnkle RWrist RElbow RShoulder LShoulder LElbow LWrist Neck HeadTop "
    "MidHip".split()
)
"""The 15 joints of Shelf's annotation, in the order of the file."""

_TRUNK = "MidHip Neck RHip LHip Nose RShoulder LShoulder RKnee LKnee"
SKEL_19 = tuple(f"{_TRUNK} REar LEar RElbow LElbow RAnkle LAnkle RWrist LWrist LBigToe RBigToe".split())
"""The joints that the system of Zhang et al. 2020 (CVPR) solves for by default, in its order."""
SKEL_17 = tuple(joint for joint in SKEL_19 if joint not in ("REar", "LEar"))
"""Its joints without ears."""
SKEL_15 = SKEL_17[:15]
"""Its joints without ears and toes: as many as in Shelf's annotation."""

MAX_PEOPLE = 1000
"""A count of people beyond this is not a count of people."""
_MAX_FRAMES = 10**7
_MAX_JOINTS = 1000
_ROWS = ("x", "y", "z", "confidence")


@dataclass(frozen=True)
class SkeletonText:
    """What stands in a file: N rows, one per person and frame."""

    frame: NDArray[np.int64]
    """(N,) frame, counted from 0."""
    person: NDArray[np.int64]
    """(N,) id as written."""
    joints: NDArray[np.float64]
    """(N, J, 3) metres, as written."""
    confidence: NDArray[np.float64]
    """(N, J) as written."""
    frame_count: int
    """Frames that the file spans, empty ones included."""


def read_skeleton_text(path: Path, *, joints: int | None = None, unknown: bool = True) -> SkeletonText:
    """Read such a file: the numbers of joints and of frames, then per frame the number of people, and per person
    an id and the rows x, y, z and confidence of all joints.

    `joints` is the number of joints that it must have. Where values may be `unknown`, NaN is one, and so is
    what has no confidence: NaN then. InputError that names file and line for anything else.
    """
    lines = _Lines(path)
    joint_count, frame_count = lines.integers(2, "the number of joints and of frames")
    if joints is not None and joint_count != joints:
        lines.refuse(f"must say {joints} joints and the number of frames, got {joint_count} and {frame_count}")
    if not 0 < joint_count <= _MAX_JOINTS or not 0 <= frame_count <= _MAX_FRAMES:
        lines.refuse(f"must say how many joints and frames there are, got {joint_count} and {frame_count}")
    frames, persons, rows = list[int](), list[int](), list[NDArray[np.float64]]()
    for frame in range(frame_count):
        (people,) = lines.integers(1, f"the number of people in frame {frame}")
        if not 0 <= people <= MAX_PEOPLE:
            lines.refuse(f"must be the number of people in frame {frame}, got {people}")
        seen: set[int] = set()
        for _ in range(people):
            (person,) = lines.integers(1, f"a person's id in frame {frame}")
            if person in seen or not 0 <= person < 2**62:
                lines.refuse(f"gives the id {person} in frame {frame}; ids must be 0 or more and differ")
            seen.add(person)
            values = [
                lines.numbers(joint_count, f"{joint_count} values of {row} in frame {frame}", unknown)
                for row in _ROWS
            ]
            frames.append(frame)
            persons.append(person)
            rows.append(np.stack(values, axis=1))
    lines.expect_end(frame_count)
    table = np.stack(rows) if rows else np.zeros((0, joint_count, 4))
    xyz, confidence = table[..., :3], np.nan_to_num(table[..., 3])
    if unknown:
        xyz = np.where((confidence > 0)[..., None] & np.isfinite(xyz).all(axis=-1, keepdims=True), xyz, np.nan)
    return SkeletonText(
        np.array(frames, dtype=np.int64), np.array(persons, dtype=np.int64), xyz, confidence, frame_count
    )


def joint_names(path: Path, text: SkeletonText) -> tuple[str, ...]:
    """The names of the joints of a file, by their number; InputError where that is none that is known.

    15 are Shelf's, where the middle of the hips is the last joint, or SKEL_15, where it is the first: the hips
    themselves are in the same places of both.
    """
    count = text.joints.shape[1]
    if count == len(SHELF_JOINTS):
        middle = text.joints[:, [2, 3]].mean(axis=1)
        first, last = (np.linalg.norm(text.joints[:, joint] - middle, axis=1) for joint in (0, 14))
        known = np.isfinite(first + last)
        return SHELF_JOINTS if np.sum(last[known]) <= np.sum(first[known]) else SKEL_15
    for names in (SKEL_17, SKEL_19):
        if count == len(names):
            return names
    raise InputError(
        f"{path}: line 1 says {count} joints; 15, 17 and 19 are known (SHELF15, SKEL15, SKEL17, SKEL19): write"
        " the people with one of these"
    )


class _Lines:
    """The lines of a text file that are not blank, one after the other, and where we are in it."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._place = 0
        self._lines: Iterator[tuple[int, str]] = (
            (place, line) for place, line in enumerate(read_text(path).splitlines(), 1) if line.strip()
        )

    def refuse(self, complaint: str) -> NoReturn:
        raise InputError(f"{self._path}: line {self._place} {complaint}; copy the file again")

    def integers(self, count: int, meaning: str) -> list[int]:
        words = self._next(count, meaning)
        try:
            return [int(word) for word in words]
        except ValueError:
            self.refuse(f"must hold {meaning}, got {' '.join(words)[:40]!r}")

    def numbers(self, count: int, meaning: str, unknown: bool) -> NDArray[np.float64]:
        """`count` numbers; NaN among them only where they may be `unknown`, infinity never."""
        words = self._next(count, meaning)
        try:
            values = np.array([float(word) for word in words])
        except ValueError:
            values = np.array([np.inf])
        if np.isinf(values).any() or not (unknown or np.isfinite(values).all()):
            self.refuse(f"must hold {meaning}, all finite numbers")
        return values

    def expect_end(self, frame_count: int) -> None:
        for place, _ in self._lines:
            self._place = place
            self.refuse(f"goes on after the {frame_count} frames that line 1 promises")

    def _next(self, count: int, meaning: str) -> list[str]:
        entry = next(self._lines, None)
        if entry is None:
            raise InputError(
                f"{self._path}: the file ends after line {self._place}, before {meaning}; copy it again whole"
            )
        self._place, line = entry
        words = line.split()
        if len(words) != count:
            self.refuse(f"must hold {meaning}, got {len(words)} values")
        return words
