"""Reads people from CSV files: of one camera by DeepLabCut and AniPose, with three or four header
rows; of all cameras by Caliscope.
"""

import csv
from collections.abc import Iterable, Iterator, Sequence
from itertools import islice
from pathlib import Path

import numpy as np

from shapepose_fg.core.arrays import Array, Index
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.skeleton import SKELETONS
from shapepose_fg.core.storage.files import ROWS_AT_ONCE, open_regular, text_pieces
from shapepose_fg.core.validation import is_number
from shapepose_fg.io.camera_names import MOST_FRAME, last_number, match_names
from shapepose_fg.io.detections.people import CameraPeople, PeopleBlock
from shapepose_fg.io.number_table import refuse_first

_DEEPLABCUT, _CALISCOPE = "DeepLabCut's CSV", "Caliscope's CSV"
_RERUN = "write the detections again, in pixels"
BLAZEPOSE = SKELETONS["BLAZEPOSE_33"].keypoint_count
"""Number of MediaPipe's points of the body; those of hands and face follow."""


def head_of(path: Path) -> list[str]:
    """The fields of the first line; none if the file is not text."""
    with open_regular(path) as stream:
        line = stream.read(4096).split(b"\n", 1)[0]
    try:
        return [word.strip() for word in line.decode("utf-8-sig").split(",")]
    except UnicodeError:
        return []


def is_deeplabcut(path: Path) -> bool:
    """Whether a CSV file begins with DeepLabCut's header."""
    return head_of(path)[:1] == ["scorer"]


def is_caliscope(path: Path) -> bool:
    """Whether a CSV file has the columns of Caliscope's 2D points of all cameras."""
    return {"sync_index", "img_loc_x", "img_loc_y"} <= set(head_of(path))


def read_deeplabcut(path: Path) -> CameraPeople:
    """The people of one camera: a single one, or each individual; body parts have names. InputError
    naming line and cure.
    """
    rows = _rows(path)
    heads = dict[str, list[str]]()
    for _, row in islice(rows, 4):
        heads[row[0].strip()] = [word.strip() for word in row[1:]]
        if row[0].strip() == "coords":
            break
    if "bodyparts" not in heads or "coords" not in heads:
        raise InputError(
            f"{path}: there are no rows bodyparts and coords below scorer, as DeepLabCut writes; "
            f"{_RERUN}"
        )
    count = min(len(heads["bodyparts"]), len(heads["coords"]))
    individuals = heads.get("individuals", [""] * count)
    joints, picked = body_parts(
        path, zip(individuals, heads["bodyparts"], heads["coords"], strict=False)
    )
    width = count + 1

    blocks, first, last = list[PeopleBlock](), 0, -1
    while len(some := list(islice(rows, ROWS_AT_ONCE))) > 0:
        lines, numbers = (
            np.array(each, dtype=np.intp)
            for each in zip(*((n, _frame(path, n, row[0])) for n, row in some), strict=True)
        )
        late = np.diff(numbers, prepend=last) <= 0
        refuse_first(path, lines, late, ": frame numbers must increase", _RERUN)
        first, last = int(numbers[0]) if last < 0 else first, int(numbers[-1])
        values = np.array([_numbers(path, line, row, width) for line, row in some])
        blocks.append(PeopleBlock.dense(numbers, taken(values, picked)))
    if last < 0:
        raise InputError(f"{path}: there are no frames below the headings; {_RERUN}")
    return CameraPeople(path, _DEEPLABCUT, iter(blocks), first, last, rerun=_RERUN, joints=joints)


def body_parts(
    path: Path, columns: Iterable[tuple[str, str, str]]
) -> tuple[tuple[str, ...], Index]:
    """DeepLabCut's body parts, and (P, J, 3) column numbers of x, y and likelihood of each
    individual; 0 if missing.

    `columns` has (individual, part, axis) of columns 1, 2, ...
    """
    people = dict[str, dict[str, dict[str, int]]]()
    for column, (one, part, axis) in enumerate(columns, start=1):
        people.setdefault(one, {}).setdefault(part, {})[axis] = column
    joints = tuple(next(iter(people.values()))) if people else ()
    # Parts shared by all animals, such as corners of the cage, form an individual with other parts.
    picked = [
        [[axes.get(name, 0) for name in ("x", "y", "likelihood")] for axes in own.values()]
        for own in people.values()
        if tuple(own) == joints
    ]
    if len(joints) == 0 or any(0 in axes[:2] for own in picked for axes in own):
        raise InputError(f"{path}: each body part must have the columns x and y; {_RERUN}")
    return joints, np.array(picked)


def taken(values: Array, columns: Index) -> Array:
    """(T, P, J, 3) keypoints of each person from a table `values` (T, C), by the `columns` of
    `body_parts`.
    """
    return np.where(columns > 0, values[:, columns], 1.0)  # without a likelihood the score is 1


def cameras_of_caliscope(path: Path) -> list[str]:
    """Names for the cameras of Caliscope's file. Raises InputError as `read_caliscope` does."""
    return [f"cam_{port}" for port in np.unique(_points(path)[:, 1].astype(np.intp)).tolist()]


def read_caliscope(path: Path, camera: int, cameras: Sequence[str]) -> CameraPeople:
    """Detections of one person in camera number `camera` of `cameras`, with MediaPipe's points;
    frames are numbered by `sync_index`.

    InputError naming line and cure.
    """
    table = _points(path)
    ports = np.unique(table[:, 1].astype(np.intp)).tolist()
    own = table[table[:, 1] == _port(path, camera, cameras, ports)]
    own = own[own[:, 2] < BLAZEPOSE]
    frame, place = np.unique(own[:, 0].astype(np.intp), return_inverse=True)
    keypoints = np.zeros((len(frame), BLAZEPOSE, 3))
    keypoints[place, own[:, 2].astype(np.intp)] = np.column_stack([own[:, 3:], np.ones(len(own))])
    first, last = int(table[:, 0].min()), int(table[:, 0].max())
    blocks = iter([PeopleBlock(frame, keypoints)])
    return CameraPeople(path, _CALISCOPE, blocks, first, last, rerun=_RERUN, joints="mediapipe")


def _points(path: Path) -> Array:
    """(N, 5) frame, camera, keypoint, x and y of Caliscope's points."""
    rows = _rows(path)
    _, head = next(rows)
    names = [word.strip() for word in head]
    camera_column = next((name for name in ("cam_id", "port") if name in names), None)
    what = next((name for name in ("keypoint_id", "point_id") if name in names), None)
    if camera_column is None or what is None:
        raise InputError(
            f"{path}: columns cam_id and keypoint_id (or port and point_id) are missing; export "
            "it again"
        )
    columns = [
        names.index(each) for each in ("sync_index", camera_column, what, "img_loc_x", "img_loc_y")
    ]
    parts = []
    while len(some := list(islice(rows, ROWS_AT_ONCE))) > 0:
        values = np.array([_numbers(path, line, row, len(names)) for line, row in some])[:, columns]
        bad = ~np.isfinite(values).all(axis=1) | (values[:, :3] != np.round(values[:, :3])).any(
            axis=1
        )
        bad |= (values[:, :3] < 0).any(axis=1) | (values[:, 0] >= MOST_FRAME)
        lines = np.array([line for line, _ in some], dtype=np.intp)
        refuse_first(path, lines, bad, " must hold whole numbers and pixels", "export it again")
        parts.append(values)
    table = np.concatenate(parts) if parts else np.zeros((0, 5))
    if table[:, 2].max(initial=0) > BLAZEPOSE and not (table[:, 2] == 0).any():
        table = table[:0]
    if len(table) == 0:
        raise InputError(
            f"{path}: there are no points of a person's body; track with Caliscope's POSE or "
            "HOLISTIC"
        )
    return table


def _port(path: Path, camera: int, cameras: Sequence[str], ports: list[int]) -> int:
    """The number of a camera in the file."""
    chosen = match_names(cameras, [str(port) for port in ports])
    if chosen is not None:
        return ports[chosen[camera]]
    digits = "".join(each for each in cameras[camera] if each.isdigit())
    if digits and int(digits) in ports:
        return int(digits)
    numbers = " ".join(map(str, ports))
    raise InputError(
        f"{path}: has cameras {numbers}, but not {cameras[camera]}; give the calibration of the "
        "same recording"
    )


def _rows(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Non-empty lines and their numbers; InputError for a line that is too long or invalid CSV."""

    def lines() -> Iterator[str]:
        rest = ""
        for piece in text_pieces(path):
            *whole, rest = (rest + piece).split("\n")
            yield from (f"{line}\n" for line in whole)
            if len(rest) > 2**20:
                raise InputError(f"{path}: a line has more than a million characters; {_RERUN}")
        if rest:
            yield rest

    reader = csv.reader(lines())
    try:
        for row in reader:
            if len(row) > 10_000:
                raise InputError(f"{path}: line {reader.line_num} has {len(row)} columns; {_RERUN}")
            if any(row):
                yield reader.line_num, row
    except csv.Error as error:
        raise InputError(
            f"{path}: line {reader.line_num} cannot be read as CSV ({error}); {_RERUN}"
        ) from None


def _frame(path: Path, line: int, word: str) -> int:
    """The frame number: the first field, or the last number in a picture's name."""
    number = last_number(word.strip().rsplit(".", 1)[0])
    if number is None or number == MOST_FRAME:
        raise InputError(
            f"{path}: line {line} must begin with a frame number, got {word[:40]!r}; {_RERUN}"
        )
    return number


def _numbers(path: Path, line: int, row: list[str], width: int) -> list[float]:
    """The values of a line, NaN for empty fields; the first field is ignored."""
    if len(row) != width:
        raise InputError(f"{path}: line {line} must hold {width} fields, got {len(row)}; {_RERUN}")
    found = []
    for n, word in enumerate(row):
        text = word.strip()
        if n > 0 and text and not is_number(text) and text.lower() != "nan":
            raise InputError(
                f"{path}: line {line} must hold numbers, got {text[:20]!r}; correct it, or {_RERUN}"
            )
        found.append(float(text) if is_number(text) else np.nan)
    return found
