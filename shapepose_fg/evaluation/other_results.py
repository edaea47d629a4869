"""People in 3D as other systems wrote them, read to be scored like ours: 4D Association's text, and TRC."""

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NoReturn

import numpy as np

from shapepose_fg.core.arrays import Array
from shapepose_fg.core.camera import Axis
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.core.skeleton import BODY_25, MID_HIP
from shapepose_fg.core.storage.files import open_regular, read_text
from shapepose_fg.evaluation.metrics import PlainPeople
from shapepose_fg.io.calibration.written import METRES
from shapepose_fg.io.export.take import opensim_axes

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

_MAX_PEOPLE, _MAX_FRAMES, _MAX_JOINTS = 1000, 10**7, 1000
"""Counts beyond these are none."""
_FAR_M = 1e5
"""Nobody is so far from the origin of a room, metres: another unit, or a damaged file."""
_MIDDLES = ("CHip", "Hip")
"""What Pose2Sim calls the middle of the hips."""
_FILTERED = "_filt_"
"""What Pose2Sim adds to the names of files that it has filtered."""


def read_people(path: Path | str, up: Axis = "z") -> Reconstruction | PlainPeople:
    """People from a people.npz or its folder, 4D Association's text, a TRC file, or a folder of TRC files.

    Joints are BODY_25's, NaN where the file has none of that name; people in Shelf's 15 joints keep these. In a
    folder of TRC files each is a person, numbered in the order of the names. `up` is the axis of the world that a
    TRC file's y becomes. InputError, one sentence, for what cannot be read.
    """
    path = Path(path)
    if path.is_dir():
        files = sorted(file for file in path.iterdir() if file.suffix.lower() == ".trc")
        if len(files) == 0 or (path / "people.npz").exists():
            return Reconstruction.load(path)
        if len({_FILTERED in file.name for file in files}) == 2:
            raise InputError(
                f"{path}: there are people as triangulated and as filtered ({_FILTERED}); put one kind into a"
                " folder of its own"
            )
        return _in_body_25(files, [read_trc(file, up) for file in files])
    beginning = _beginning(path)
    if _is_trc(beginning):
        return _in_body_25([path], [read_trc(path, up)])
    if len(beginning.split()) != 2 or not all(word.isdecimal() for word in beginning.split()):
        return Reconstruction.load(path)
    people = read_skeleton_text(path)
    if people.joint_names != SHELF_JOINTS:
        return _in_body_25([path], [people])
    _check_near(path, people.joints)
    return people


def _beginning(path: Path) -> str:
    """The first line of a file, if it is text; nothing where it cannot be read: who reads it says why."""
    try:
        with open_regular(path) as stream:
            return stream.read(200).decode("utf-8-sig", errors="replace").partition("\n")[0]
    except (InputError, OSError):
        return ""


def _in_body_25(paths: Sequence[Path], parts: Sequence[PlainPeople]) -> PlainPeople:
    """The people of all files in BODY_25's joints, sorted by frame and person, numbered by their files."""
    placed = list[Array]()
    for path, part in zip(paths, parts, strict=True):
        known = [place for place, name in enumerate(part.joint_names) if name in BODY_25.joints]
        if len(known) == 0:
            raise InputError(
                f"{path}: line 4 names no joint of BODY_25 (Neck, RHip, ...); write the joints, not other markers"
            )
        joints = np.full((len(part.frame), len(BODY_25), 3), np.nan)
        joints[:, [BODY_25.index(part.joint_names[place]) for place in known]] = part.joints[:, known]
        _check_near(path, joints)
        placed.append(joints)
    frame = np.concatenate([part.frame for part in parts])
    person = np.concatenate([part.person + number for number, part in enumerate(parts)])
    order = np.lexsort((person, frame))
    return PlainPeople(frame[order], np.concatenate(placed)[order], person[order])


def _check_near(path: Path, joints: Array) -> None:
    """InputError where a joint is in no room."""
    farthest = np.abs(np.nan_to_num(joints)).max(initial=0.0)
    if farthest > _FAR_M:
        raise InputError(f"{path}: a joint is {farthest:.3g} m from the origin; check the unit")


def read_skeleton_text(path: Path, *, shelf: bool = False) -> PlainPeople:
    """Read such a file: the numbers of joints and of frames, then per frame the number of people, and per person
    an id and the rows x, y, z and confidence of all joints.

    What is NaN or has no confidence is missing. An annotation of `shelf` has its 15 joints, all of them known.
    InputError that names file and line for anything else.
    """
    lines = _Lines(path)
    joints, frames = lines.integers(2, "the number of joints and of frames")
    if shelf and joints != len(SHELF_JOINTS):
        lines.refuse(f"must say {len(SHELF_JOINTS)} joints and the number of frames, got {joints} and {frames}")
    if not 0 < joints <= _MAX_JOINTS or not 0 <= frames <= _MAX_FRAMES:
        lines.refuse(f"must say how many joints and frames there are, got {joints} and {frames}")
    who, rows = list[tuple[int, int]](), list[Array]()
    for frame in range(frames):
        (people,) = lines.integers(1, f"the number of people in frame {frame}")
        if not 0 <= people <= _MAX_PEOPLE:
            lines.refuse(f"must be the number of people in frame {frame}, got {people}")
        seen: set[int] = set()
        for _ in range(people):
            (person,) = lines.integers(1, f"a person's id in frame {frame}")
            if person in seen or not 0 <= person < 2**62:
                lines.refuse(f"gives the id {person} in frame {frame}; ids must be 0 or more and differ")
            seen.add(person)
            who.append((frame, person))
            meanings = (f"{joints} values of {row} in frame {frame}" for row in ("x", "y", "z", "confidence"))
            rows.append(np.stack([lines.numbers(joints, meaning, not shelf) for meaning in meanings], axis=1))
    if lines.left():
        lines.refuse(f"goes on after the {frames} frames that line 1 promises")
    table = np.stack(rows) if rows else np.zeros((0, joints, 4))
    known = np.isfinite(table).all(axis=-1) & ((table[..., 3] > 0) | shelf)
    frame, person = np.array(who, dtype=np.int64).reshape(-1, 2).T
    xyz = np.where(known[..., None], table[..., :3], np.nan)
    return PlainPeople(frame, xyz, person, _text_joints(path, xyz))


def _text_joints(path: Path, joints: Array) -> tuple[str, ...]:
    """The names of the joints (N, J, 3) of a file, by their number; InputError where that is none that is known.

    15 are Shelf's, where the middle of the hips is the last joint, or SKEL_15, where it is the first: the hips
    themselves are in the same places of both.
    """
    count = joints.shape[1]
    if count == len(SHELF_JOINTS):
        middle = joints[:, [2, 3]].mean(axis=1)
        first, last = (np.linalg.norm(joints[:, joint] - middle, axis=1) for joint in (0, 14))
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

    def numbers(self, count: int, meaning: str, unknown: bool) -> Array:
        """`count` numbers; NaN among them only where they may be `unknown`, infinity never."""
        words = self._next(count, meaning)
        try:
            values = np.array([float(word) for word in words])
        except ValueError:
            values = np.array([np.inf])
        if np.isinf(values).any() or not (unknown or np.isfinite(values).all()):
            self.refuse(f"must hold {meaning}, all finite numbers")
        return values

    def left(self) -> bool:
        """Whether there is one more, which is the present one then."""
        self._place, line = next(self._lines, (self._place, ""))
        return len(line) > 0

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


def read_trc(path: Path, up: Axis = "z") -> PlainPeople:
    """Read one person's markers into a world with the axis `up` upwards, as `export` turns it to TRC's y.

    The middle of the hips is named `MidHip`. A marker is missing where a cell is empty or NaN, or the line ends
    early. How many frames the header promises is not looked at: Pose2Sim's filter leaves one out and keeps the
    number. InputError that names file and line for anything else that is no number, for a unit that is not m, cm
    or mm, and for frames that do not rise.
    """

    def refuse(place: int, complaint: str) -> NoReturn:
        raise InputError(f"{path}: line {place} {complaint}; write the file again")

    def number(place: int, cell: str) -> float:
        try:
            value = float(cell.strip() or "nan")
        except ValueError:
            value = math.inf
        if math.isinf(value):
            refuse(place, f"holds {cell.strip()[:20]!r}, which is no number")
        return value

    lines = [line.split("\t") for line in read_text(path).splitlines()]
    if not _is_trc(lines[0][0]) or len(lines) < 5:
        raise InputError(
            f"{path}: does not begin as a TRC file does (PathFileType, then five lines); write the file again"
        )
    header = {heading.strip().lower(): value.strip() for heading, value in zip(lines[1], lines[2], strict=False)}
    for heading in ("nummarkers", "units"):
        if heading not in header:
            refuse(3, f"has no value for {heading}")
    if header["units"].lower() not in METRES:
        refuse(3, f"has the unit {header['units'][:20]!r}; it must be m, cm or mm")
    count, names = header["nummarkers"], [cell.strip() for cell in lines[3][2:] if cell.strip()]
    if not count.isdecimal() or not 0 < int(count[:9]) <= _MAX_JOINTS:
        refuse(3, f"says {count[:20]!r} markers; it must say 1 to {_MAX_JOINTS}")
    if len(names) != int(count[:9]):
        refuse(4, f"names {len(names)} markers, line 3 says {count[:9]}")
    if len(set(names)) < len(names):
        refuse(4, "gives two markers one name")
    width, rows = 2 + 3 * len(names), list[list[float]]()
    for place, cells in enumerate(lines[5:], 6):
        if not any(cell.strip() for cell in cells):
            continue
        row = [number(place, cell) for cell in cells]
        row += [math.nan] * (width - len(row))
        if not (math.isfinite(row[0] + row[1]) and row[0] == int(row[0])):
            refuse(place, "must begin with the number of a frame and its time")
        if abs(row[0]) >= 2**53 or (rows and row[0] <= rows[-1][0]):
            refuse(place, f"is of frame {row[0]:.0f}: frames must rise")
        if not all(math.isnan(value) for value in row[width:]):
            refuse(place, f"holds more than {len(names)} markers")
        rows.append(row[:width])
    table = np.array(rows, dtype=np.float64).reshape(len(rows), width)
    xyz = METRES[header["units"].lower()] * table[:, 2:].reshape(len(rows), len(names), 3)
    # A marker of which one coordinate is missing is missing.
    xyz = np.where(np.isfinite(xyz).all(axis=-1, keepdims=True), xyz, np.nan) @ opensim_axes(up)
    frame, named = table[:, 0].astype(np.int64), tuple(MID_HIP if name in _MIDDLES else name for name in names)
    return PlainPeople(frame, xyz, np.zeros(len(rows), dtype=np.int64), named)


def _is_trc(beginning: str) -> bool:
    """Whether a file that begins so is a TRC file."""
    return beginning.lstrip("\ufeff").startswith("PathFileType")
