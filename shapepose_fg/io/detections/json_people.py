"""Reads people from JSON: a file per frame (OpenPose, Pose2Sim, MMPose of pictures, OpenPifPaf,
Ultralytics, AlphaPose's sep-json), or one file per camera with all its frames (COCO's keypoint
results, AlphaPose, MMPose of a video, OpenPifPaf of a video).

Pose2Sim (RTMLib's people in OpenPose's format) has no `_keypoints` in the file names, NaN for
people that it dropped, and `{}` for people that a camera does not see.
"""

from array import array
from collections.abc import Iterable, Iterator, Mapping
from functools import partial
from itertools import chain, pairwise
from pathlib import Path
from typing import Any

import numpy as np

from shapepose_fg.core.arrays import Array, Index
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.storage.files import (
    BIG,
    LARGE,
    MIDDLE,
    open_regular,
    parse_json,
    read_json,
    read_text,
)
from shapepose_fg.core.validation import describe, numbers
from shapepose_fg.io.camera_names import MOST_FRAME, in_order, last_number, numbered
from shapepose_fg.io.detection_table import BLOCK_FRAMES
from shapepose_fg.io.detections.people import (
    CameraPeople,
    PeopleBlock,
    check_one_model,
    frame_blocks,
)
from shapepose_fg.io.json_items import JsonItems

_OPENPOSE, _POSE2SIM, _PICTURES = "OpenPose's JSON", "Pose2Sim's JSON", "MMPose's JSON of pictures"
_COCO, _ALPHAPOSE, _VIDEO = (
    "COCO's keypoint results",
    "AlphaPose's JSON",
    "MMPose's JSON of a video",
)
_PIFPAF, _YOLO, _SEPARATE = "OpenPifPaf's JSON", "Ultralytics' JSON", "AlphaPose's JSON of frames"
_RERUN = {
    _OPENPOSE: "run OpenPose again with --write_json --keypoint_scale 0",
    _POSE2SIM: "run Pose2Sim's pose estimation again",
    _PICTURES: "run MMPose again with --pred-out-dir",
    _COCO: "write the results again, in pixels",
    _ALPHAPOSE: "run AlphaPose again with --format coco",
    _VIDEO: "run MMPose again with --save-predictions or --pred-out-dir",
    _PIFPAF: "run OpenPifPaf again with --json-output",
    _YOLO: "write each frame's result.to_json() again, or run yolo pose with save_txt=True",
    _SEPARATE: "run AlphaPose again, without --format",
}
FRAME_FILE = r"(_keypoints|(\.\w{1,5})?\.predictions)?\.json"
"""Pattern of what follows the frame number in file names."""
_ALL_FRAMES, _SEP_JSON = "alphapose-results.json", "sep-json"
"""AlphaPose's file with all frames, and its folder with a file per frame (--format open and
cmu)."""
_LISTS = ("annotations", "instance_info")
"""Keys of the list of people in a file that is an object: COCO's data sets, and MMPose."""


def _keypoints(person: Any, place: str, program: str) -> Array:
    """(K, 3) x, y and score of the keypoints of a person in the format of any of the programs; K is
    0 for a person, or another object, without keypoints.

    They are a flat list, pairs with a list of scores (MMPose), or three lists (Ultralytics).
    """
    if not isinstance(person, dict):
        raise InputError(f"{place} must be an object, got {describe(person)}; {_RERUN[program]}")
    known = ("pose_keypoints_2d", "joints", "keypoints")
    key = next((name for name in known if person.get(name) is not None), None)
    if key is None:
        if len(person) == 0 or program == _YOLO:
            return np.zeros((0, 3))
        wanted = known[0] if program in (_OPENPOSE, _POSE2SIM, _SEPARATE) else known[2]
        raise InputError(f"{place}.{wanted} is missing; {_RERUN[program]}")
    given, cure = person[key], _RERUN[program]
    parts = {key: given, "keypoint_scores": person.get("keypoint_scores")}
    if isinstance(given, dict):
        parts = {f"{key}.{name}": given.get(name) for name in ("x", "y", "visible")}
    parts = {name: each for name, each in parts.items() if each is not None}
    columns = [numbers(each, f"{place}.{n}", cure, may_lack=True) for n, each in parts.items()]
    if len({len(each) for each in columns}) > 1:
        counts = (f"{len(each)} {name}" for name, each in zip(parts, columns, strict=True))
        raise InputError(f"{place}: there are {', but '.join(counts)}; {cure}")
    found = np.column_stack(columns) if len(columns) > 1 else columns[0]
    if found.ndim == 1 and len(found) % 3 == 0:
        found = found.reshape(-1, 3)
    if isinstance(given, dict):
        found = np.column_stack([found, np.ones(len(found))])[:, :3]
        found[(found[:, :2] == 0).all(axis=1), 2] = 0  # keypoints with a low score are at 0 0
    if found.shape[1:] != (3,):
        problem = f"must hold x, y and score of each keypoint, got {found.size} numbers"
        raise InputError(f"{place}.{key} {problem}; {cure}")
    return found


def _member(record: Any, key: str, place: str, program: str) -> Any:
    """The value of a key; InputError if it is missing."""
    if not isinstance(record, dict) or key not in record:
        description = "" if isinstance(record, dict) else f" in {describe(record)}"
        raise InputError(f"{place}{key} is missing{description}; {_RERUN[program]}")
    return record[key]


def _people(record: Any, key: str, place: str, program: str) -> list[Array]:
    """The keypoints of each person of a frame, which are under `key` or, if that is empty, the
    record itself. People without keypoints are left out.
    """
    listed = _member(record, key, place, program) if key else record
    if not isinstance(listed, list):
        raise InputError(f"{place}{key} must be a list, got {describe(listed)}; {_RERUN[program]}")
    every = (_keypoints(each, f"{place}{key}[{n}]", program) for n, each in enumerate(listed))
    return [each for each in every if len(each) > 0]


def _people_of_frame(content: Any, place: object, program: str) -> list[Array]:
    """The people of a frame, from the content of its file."""
    if program in (_PIFPAF, _YOLO, _PICTURES):
        return _people(content, "", f"{place}: ", program)
    key = "bodies" if isinstance(content, dict) and "bodies" in content else "people"
    return _people(content, key, f"{place}: ", program)


def read_json_people(place: Path) -> CameraPeople:
    """The people of one camera: from a JSON file with all frames (which may be the only one of a
    folder), or from a file per frame.
    """
    if not place.is_dir():
        return read_one_file(place)
    if (place / _SEP_JSON).is_dir() and len(numbered(place, FRAME_FILE)) == 0:
        return read_frame_files(place / _SEP_JSON)
    lists = _lists(place)
    if [each.name for each in lists] == [_ALL_FRAMES]:
        return read_one_file(lists[0])
    if len(lists) == 1:
        items = JsonItems(lists[0], _LISTS)
        first = next(iter(items), None)
        of_a_picture = (
            isinstance(first, dict) and "keypoints" in first and items.key == "instance_info"
        )
        if not of_a_picture and (
            items.key is not None or (items.found and (first is None or _known(first)))
        ):
            return read_one_file(lists[0])
    return read_frame_files(place)


def _joints_of_meta(meta: Any) -> str | tuple[str, ...] | None:
    """The joints in MMPose's `meta_info`: names, or the name of a data set; None if it has
    neither.
    """
    if not isinstance(meta, dict):
        return None
    names, count = meta.get("keypoint_id2name"), meta.get("num_keypoints")
    if isinstance(names, dict):
        count = count if type(count) is int and 0 <= count <= len(names) else len(names)
        names = [names.get(str(place)) for place in range(count)]
    if named := _texts(names):
        return named
    data_set = meta.get("dataset_name")
    return data_set if isinstance(data_set, str) else None


def _texts(names: Any) -> tuple[str, ...]:
    """A list of texts as a tuple; empty for any other value."""
    listed = isinstance(names, list) and all(isinstance(name, str) for name in names)
    return tuple(names) if listed else ()


def _joints_of_categories(categories: Any, used: set[int | str | None]) -> tuple[str, ...] | None:
    """The joint names of the `used` categories in COCO's `categories`; None if there are none, or
    if they differ.
    """
    found = set[tuple[str, ...]]()
    for each in categories if isinstance(categories, list) else []:
        named = _texts(each.get("keypoints")) if isinstance(each, dict) else ()
        if named and (None in used or each.get("id") in used):
            found.add(named)
    return found.pop() if len(found) == 1 else None


# A file per frame.


def read_frame_files(folder: Path) -> CameraPeople:
    """Read a file per frame of one camera; InputError naming file, key and cure.

    Frame numbers are in the file names. Missing files in between are frames without people
    (`gaps`).
    """
    found = numbered(folder, FRAME_FILE)
    if len(found) == 0:
        lists = sorted(each.name for each in _lists(folder))
        what = (
            "there is no *_keypoints.json (OpenPose) or *_000000.json (Pose2Sim) in this folder; "
            "write the detections of one of them into it"
        )
        if len(lists) > 1:
            names = " ".join(lists[:4])
            what = f"there are several JSON files without frame numbers ({names}); keep only one"
        raise InputError(f"{folder}: {what}")
    program, joints = _OPENPOSE, None
    if not found[0][1].name.endswith("_keypoints.json"):
        program, joints = _program_of_frames([file for _, file in found])
    in_order(found)
    first, last = found[0][0], found[-1][0]
    # If more frames are missing than this, the numbers are not frame numbers.
    if last - first + 1 > 2 * len(found) + 1000:
        problem = f"{len(found)} files are numbered from {first} to {last}"
        raise InputError(
            f"{folder}: {problem}; number them by the frames of the recording, or {_RERUN[program]}"
        )
    gaps = tuple(
        (one + 1, other - 1) for (one, _), (other, _) in pairwise(found) if other > one + 1
    )
    read = partial(_people_of_file, program=program, joints=joints)
    blocks = frame_blocks(folder, program, found, read)
    return CameraPeople(
        folder, program, blocks, first, last, gaps=gaps, rerun=_RERUN[program], joints=joints
    )


def _program_of_frames(files: list[Path]) -> tuple[str, str | tuple[str, ...] | None]:
    """The program that wrote a file per frame, identified by the first file with people, and the
    joint names in it.
    """
    program, joints = _POSE2SIM, None
    # Maximum number of files without people that are read before the program is identified.
    for n, file in enumerate(files[:100]):
        content = read_json(file, most=MIDDLE)
        if isinstance(content, dict):
            if n == 0:
                joints = _joints_of_meta(content.get("meta_info"))
            if "instance_info" in content:
                return _PICTURES, joints
            if "bodies" in content:
                return _SEPARATE, "openpose coco"
            return program, joints
        program = _PIFPAF if ".predictions." in file.name else _PICTURES
        people = (
            [each for each in content if isinstance(each, dict)]
            if isinstance(content, list)
            else []
        )
        if len(people) == 0:
            continue
        keypoints = next((each["keypoints"] for each in people if "keypoints" in each), None)
        if isinstance(keypoints, dict) or "box" in people[0]:
            return _YOLO, None
        flat = isinstance(keypoints, list) and not isinstance(next(iter(keypoints), None), list)
        return (_PIFPAF if flat else _PICTURES), None
    return program, joints


def _people_of_file(file: Path, program: str, joints: str | tuple[str, ...] | None) -> list[Array]:
    """Keypoints of the people of a frame."""
    content = read_json(file, most=MIDDLE)
    if program == _PICTURES and isinstance(content, dict):
        if _joints_of_meta(content.get("meta_info")) != joints:
            raise InputError(
                f"{file}: its meta_info names other joints than the first file; give the files "
                "of one model"
            )
        content = content.get("instance_info")
    return _people_of_frame(content, file, program)


# One file with all frames.


def _lists(folder: Path) -> list[Path]:
    return [each for each in folder.glob("*.json") if not each.name.startswith(".")]


def _known(item: Any) -> bool:
    """Whether `item` of a JSON list is a person, or a picture's people, in a supported format."""
    return isinstance(item, dict) and ("image_id" in item or "instances" in item)


def read_one_file(path: Path) -> CameraPeople:
    """Read a file with all frames of one camera; InputError naming file, key and cure."""
    with open_regular(path) as stream:
        begin = stream.read(64).lstrip(b"\xef\xbb\xbf \t\r\n").replace(b" ", b"")
    if begin.startswith(b'{"frame":'):
        return _camera(path, _PIFPAF, _lines_of_video(path))
    items = JsonItems(path, _LISTS)
    if items.key is None and not items.found and isinstance(items.value, dict):
        content = read_json(path, most=BIG)
        values = (each for each in content.values() if isinstance(each, dict))
        if any(each.keys() & {"people", "bodies"} for each in values):
            return _camera(path, _SEPARATE, _frames_by_name(path, content))
    if items.key is not None and not items.found:
        raise InputError(
            f"{path}: the file must be a list, got {describe(items.value)}; {_RERUN[_COCO]}"
        )
    every = iter(items)
    first = next(every, None)
    if not items.found or (items.key is None and first is not None and not _known(first)):
        found = "a list" if items.found else describe(items.value)
        raise InputError(
            f"{path}: recognised as JSON ({found}), but a list of people with image_id (COCO, "
            "AlphaPose) or of frames with instances (MMPose) is expected; give one of these"
        )
    program = _COCO
    if items.key == "instance_info" or (isinstance(first, dict) and "instances" in first):
        program = _VIDEO
    elif isinstance(first, dict) and isinstance(first.get("image_id"), str):
        program = _ALPHAPOSE
    again, used = every if first is None else chain([first], every), Categories()
    return _camera(path, program, _records(again, path, program, used), items.others, used)


Record = tuple[str, int | str, list[Array]]
"""A place for messages, the number of a frame or the name of a picture, and people in it."""
Categories = set[int | str | None]


def _frames_by_name(path: Path, content: dict[str, Any]) -> Iterator[Record]:
    """AlphaPose's records of --format open and cmu: people by name of the picture."""
    for name, frame in content.items():
        place = f"{path}: {name[:40]!r}"
        yield place, name, _people_of_frame(frame, place, _SEPARATE)


def _lines_of_video(path: Path) -> Iterator[Record]:
    """OpenPifPaf's records of a video, a line of JSON per frame."""
    for number, line in enumerate(read_text(path, most=LARGE).splitlines(), start=1):
        if line.strip():
            place, record = f"{path}: line {number}", parse_json(line, path)
            people = _people(record, "predictions", f"{place}:", _PIFPAF)
            yield place, _member(record, "frame", f"{place}:", _PIFPAF), people


def _records(items: Iterable[Any], path: Path, program: str, used: Categories) -> Iterator[Record]:
    """Records of a list: of frames with people (MMPose), or of people, each with its picture, whose
    categories are added to `used`.
    """
    label = "frame_id" if program == _VIDEO else "image_id"
    for n, item in enumerate(items):
        place = f"{path}: [{n}]"
        number = _member(item, label, f"{place}.", program)
        if program == _VIDEO:
            people = _people(item, "instances", f"{place}.", program)
        else:
            people = [_keypoints(item, place, program)]
            category = item.get("category_id")
            used.add(category if isinstance(category, int | str) else None)
        yield f"{place}.{label}", number, people


def _camera(
    path: Path,
    program: str,
    records: Iterable[Record],
    others: Mapping[str, Any] | None = None,
    used: Categories | None = None,
) -> CameraPeople:
    """All people of a file with its `records`, collected in one array.

    After all records have been read, `others` has the names of pictures, joints and categories, of
    which those in `used` count. Pictures without people may be in these names only.
    """
    values, labels, counts, places = array("d"), list[int | str](), set[int](), dict[Any, str]()
    for place, label, people in records:
        if label in places and program not in (_COCO, _ALPHAPOSE):
            raise InputError(f"{place}: frame {label} occurs twice; {_RERUN[program]}")
        places.setdefault(label, place)
        check_one_model(counts, people, path, program)
        for person in people:
            values.frombytes(person.tobytes())
            labels.append(label)
    others = {} if others is None else others
    names = _names(others, path, program)
    for index, image in enumerate(names):
        places.setdefault(image, f"{path}: images[{index}]")
    frames = {each: _number(each, names.get(each), at, program) for each, at in places.items()}
    first: dict[int, int | str] = {}
    for image, frame in frames.items():
        if first.setdefault(frame, image) != image:
            problem = (
                f"the pictures {str(first[frame])[:40]!r} and {str(image)[:40]!r} have the same "
                f"frame number {frame}"
            )
            raise InputError(
                f"{path}: {problem}; {_RERUN[program]}, of one camera with a number for each "
                "picture"
            )
    joints = _joints_of_meta(others.get("meta_info"))
    joints = joints or _joints_of_categories(others.get("categories"), used or set())
    return CameraPeople(
        path,
        program,
        _in_order(np.array([frames[label] for label in labels], dtype=np.intp), values),
        min(first, default=0),
        max(first, default=-1),
        every_frame=False,
        lists_people=program != _VIDEO,
        rerun=_RERUN[program],
        joints="openpose coco" if program == _SEPARATE else joints,
    )


def _in_order(frames: Index, values: "array[float]") -> Iterator[PeopleBlock]:
    """People with `frames` (N,) and the numbers of their keypoints, sorted by frame, in blocks of
    frames.
    """
    if len(frames) > 0:
        keypoints, order = (
            np.frombuffer(values).reshape(len(frames), -1, 3),
            np.argsort(frames, kind="stable"),
        )
        for index in np.split(order, np.flatnonzero(np.diff(frames[order] // BLOCK_FRAMES)) + 1):
            yield PeopleBlock(frames[index], keypoints[index])


def _names(others: Mapping[str, Any], path: Path, program: str) -> dict[int | str, str | None]:
    """File names of the pictures of a COCO data set by id, including pictures without people."""
    names, images = {}, others.get("images")
    for index, image in enumerate(images if isinstance(images, list) else []):
        one = image.get("id") if isinstance(image, dict) else None
        if type(one) not in (int, str):
            raise InputError(
                f"{path}: images[{index}].id must be a whole number or text; {_RERUN[program]}"
            )
        names[one] = str(image["file_name"]) if "file_name" in image else None
    return names


def _number(image: Any, name: str | None, place: str, program: str) -> int:
    """Frame number of a picture: the last number in its name; without a name, its id, if that is a
    number.
    """
    if type(image) not in (int, str):
        raise InputError(
            f"{place} must be a whole number or text, got {describe(image)}; {_RERUN[program]}"
        )
    if name is None and isinstance(image, int):
        if 0 <= image < MOST_FRAME:
            return image
        raise InputError(
            f"{place} '{image}' is not a frame number; {_RERUN[program]}, of numbered pictures"
        )
    name = str(image) if name is None else name
    if (number := last_number(Path(name).stem)) in (None, MOST_FRAME):
        raise InputError(
            f"{place} {name[:40]!r} has no frame number; {_RERUN[program]}, of numbered pictures"
        )
    return number
