"""Reads people from JSON: a file per frame (OpenPose, Pose2Sim, MMPose of pictures, OpenPifPaf,
Ultralytics, AlphaPose's sep-json), or one file per camera with all its frames (COCO's keypoint
results, AlphaPose, MMPose of a video, OpenPifPaf of a video).

Pose2Sim (RTMLib's people in OpenPose's format) has no `_keypoints` in the file names, NaN for
people that it dropped, and `{}` for people that a camera does not see.
"""

from collections.abc import Iterable, Iterator, Mapping
from functools import partial
from itertools import chain, islice, pairwise
from math import inf
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import AliasChoices, BaseModel, Field, FiniteFloat, TypeAdapter

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
from shapepose_fg.io.camera_names import MOST_FRAME, in_order, last_number, numbered
from shapepose_fg.io.detection_table import BLOCK_FRAMES
from shapepose_fg.io.detections.people import (
    CameraPeople,
    PeopleBlock,
    check_one_model,
    frame_blocks,
)
from shapepose_fg.io.json_items import JsonItems
from shapepose_fg.io.validation import describe, validated, validated_list

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
_LONGEST_GAP = 1000
"""Maximum ratio of missing to existing frames; a larger ratio means that the numbers are not frame
numbers."""
FRAME_FILE = r"(_keypoints|(\.\w{1,5})?\.predictions)?\.json"
"""Pattern of what follows the frame number in file names."""
_ALL_FRAMES, _SEP_JSON = "alphapose-results.json", "sep-json"
"""AlphaPose's file with all frames, and its folder with a file per frame (--format open and
cmu)."""
_LISTS = ("annotations", "instance_info")
"""Keys of the list if the file is an object: COCO's data sets, and MMPose."""


class _Person(BaseModel, strict=True, extra="allow"):
    """A person in OpenPose's format, or in AlphaPose's formats `open` and `cmu`; hands and face are
    ignored.
    """

    pose_keypoints_2d: list[float] | None = None
    joints: list[float] | None = None

    def flat(self, place: str, program: str) -> list[float]:
        """x, y and score of each keypoint; empty if the person has none."""
        values = self.joints if self.pose_keypoints_2d is None else self.pose_keypoints_2d
        if values is None and self.model_extra:
            raise InputError(f"{place}.pose_keypoints_2d is missing; {_RERUN[program]}")
        return _checked(values or [], f"{place}.pose_keypoints_2d", program)


class _Frame(BaseModel, strict=True):
    people: list[_Person] = Field(validation_alias=AliasChoices("people", "bodies"))


class _Instance(BaseModel, strict=True):
    """A person in MMPose's format."""

    keypoints: list[Annotated[list[FiniteFloat], Field(min_length=2, max_length=2)]]
    keypoint_scores: list[FiniteFloat]

    def flat(self, place: str, program: str) -> list[float]:
        """x, y and score of each keypoint."""
        if len(self.keypoints) != len(self.keypoint_scores):
            problem = (
                f"there are {len(self.keypoints)} keypoints, but {len(self.keypoint_scores)} "
                "keypoint_scores"
            )
            raise InputError(f"{place}: {problem}; {_RERUN[program]}")
        pairs = zip(self.keypoints, self.keypoint_scores, strict=True)
        return [number for (x, y), score in pairs for number in (x, y, score)]


class _VideoFrame(BaseModel, strict=True):
    """A frame of a video in MMPose's format."""

    frame_id: Annotated[int, Field(ge=0, lt=MOST_FRAME)]
    instances: list[_Instance]


class _Flat(BaseModel, strict=True):
    """A person in OpenPifPaf's format."""

    keypoints: Annotated[list[float], Field(min_length=1)]

    def flat(self, place: str, program: str) -> list[float]:
        """x, y and score of each keypoint."""
        return _checked(self.keypoints, f"{place}.keypoints", program)


class _Result(_Flat):
    """A person in COCO's result format."""

    image_id: int | str
    category_id: int | str | None = None


class _PifPafFrame(BaseModel, strict=True):
    """A frame of a video in OpenPifPaf's format."""

    frame: Annotated[int, Field(ge=0, lt=MOST_FRAME)]
    predictions: list[_Flat]


class _Columns(BaseModel, strict=True):
    """The keypoints of a person in Ultralytics' format."""

    x: list[FiniteFloat]
    y: list[FiniteFloat]
    visible: list[FiniteFloat] | None = None


class _Object(BaseModel, strict=True):
    """A detected person, or other object, in Ultralytics' format."""

    keypoints: _Columns | None = None

    def flat(self, place: str, program: str) -> list[float]:
        """x, y and score of each keypoint; keypoints with a low score are at 0 0."""
        own = self.keypoints
        if own is None:
            return []
        scores = [1.0] * len(own.x) if own.visible is None else own.visible
        if not len(own.x) == len(own.y) == len(scores):
            raise InputError(
                f"{place}.keypoints must have the same number of x, y and visible; "
                f"{_RERUN[program]}"
            )
        rows = zip(own.x, own.y, scores, strict=True)
        return [number for x, y, score in rows for number in (x, y, score if x or y else 0.0)]


_LIST_OF = {
    _PIFPAF: TypeAdapter(list[_Flat]),
    _YOLO: TypeAdapter(list[_Object]),
    _PICTURES: TypeAdapter(list[_Instance]),
}
"""Validators of a frame's people, for programs that write them as a list; others write an object
(`_Frame`)."""
_RESULTS, _FRAMES = TypeAdapter(list[_Result]), TypeAdapter(list[_VideoFrame])


def _checked(values: list[float], place: str, program: str) -> list[float]:
    """Check flat keypoints; a joint that was not detected may be NaN."""
    if len(values) % 3 != 0:
        problem = f"must hold x, y and score of each keypoint, got {len(values)} numbers"
        raise InputError(f"{place} {problem}; {_RERUN[program]}")
    if inf in values or -inf in values:
        raise InputError(f"{place} holds Infinity; {_RERUN[program]}")
    return values


def _people(content: Any, place: object, program: str) -> list[list[float]]:
    """Flat keypoints of the people of a frame; people without keypoints are skipped."""
    if program in _LIST_OF:
        key, people = "", validated_list(_LIST_OF[program], content, place, _RERUN[program])
    else:
        key, people = "people", validated(_Frame, content, place, _RERUN[program]).people
    every = (each.flat(f"{place}: {key}[{number}]", program) for number, each in enumerate(people))
    return [each for each in every if each]


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
    if last - first + 1 > 2 * len(found) + _LONGEST_GAP:
        problem = f"{len(found)} files are numbered from {first} to {last}"
        raise InputError(
            f"{folder}: {problem}; number them by the frames of the recording, or {_RERUN[program]}"
        )
    gaps = tuple(
        (one + 1, other - 1) for (one, _), (other, _) in pairwise(found) if other > one + 1
    )
    blocks = frame_blocks(
        folder, program, found, partial(_people_of_file, program=program, joints=joints)
    )
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


def _people_of_file(
    file: Path, program: str, joints: str | tuple[str, ...] | None
) -> list[list[float]]:
    """Flat keypoints of the people of a frame."""
    content = read_json(file, most=MIDDLE)
    if program == _PICTURES and isinstance(content, dict):
        if _joints_of_meta(content.get("meta_info")) != joints:
            raise InputError(
                f"{file}: its meta_info names other joints than the first file; give the files "
                "of one model"
            )
        content = content.get("instance_info")
    return _people(content, file, program)


# One file with all frames.


def _lists(folder: Path) -> list[Path]:
    return [each for each in folder.glob("*.json") if not each.name.startswith(".")]


def _known(item: Any) -> bool:
    """Whether this is an item of a list in one of the programs' formats."""
    return isinstance(item, dict) and ("image_id" in item or "instances" in item)


def read_one_file(path: Path) -> CameraPeople:
    """Read a file with all frames of one camera; InputError naming file, key and cure."""
    if (lines := _pifpaf_video(path)) is not None:
        return lines
    items = JsonItems(path, _LISTS)
    is_object = items.key is None and not items.found and isinstance(items.value, dict)
    if is_object and (named := _by_picture(path)) is not None:
        return named
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
    again = every if first is None else chain([first], every)
    if items.key == "instance_info" or (isinstance(first, dict) and "instances" in first):
        return _video(_Collected(path, _VIDEO), again, items.others)
    program = (
        _ALPHAPOSE if isinstance(first, dict) and isinstance(first.get("image_id"), str) else _COCO
    )
    return _results(_Collected(path, program), again, items.others)


class _Collected:
    """Collects the people of one file in arrays while they are read."""

    def __init__(self, path: Path, program: str) -> None:
        self.path, self.program = path, program
        self._keypoints, self._counts = list[Array](), set[int]()

    def valid(
        self, kind: TypeAdapter[list[Any]], items: Iterable[Any]
    ) -> Iterator[tuple[int, list[Any]]]:
        """The validated items in batches, with the index of each batch's first item."""
        items, start = iter(items), 0
        # Number of items that are validated together: as Python objects they need
        # several times the memory of arrays.
        while len(some := list(islice(items, 1024))) > 0:
            yield start, validated_list(kind, some, self.path, _RERUN[self.program], start)
            start += len(some)

    def add(self, rows: list[list[float]]) -> None:
        """Add people with flat keypoints."""
        check_one_model(self._counts, rows, self.path, self.program)
        if len(rows) > 0:
            self._keypoints.append(
                np.array(rows, dtype=np.float64).reshape(len(rows), len(rows[0]) // 3, 3)
            )

    def camera(
        self, frames: list[int], listed: tuple[int, int], joints: str | tuple[str, ...] | None
    ) -> CameraPeople:
        """All people, with their `frames` (N); `listed` are the first and last frame number in the
        file.
        """
        blocks, rerun = self._in_order(np.array(frames, dtype=np.intp)), _RERUN[self.program]
        how = {
            "every_frame": False,
            "lists_people": self.program != _VIDEO,
            "rerun": rerun,
            "joints": joints,
        }
        return CameraPeople(self.path, self.program, blocks, *listed, **how)

    def _in_order(self, frames: Index) -> Iterator[PeopleBlock]:
        """People sorted by frame, with `frames` (N,), in blocks of frames."""
        if len(frames) == 0:
            return
        order, parts = np.argsort(frames, kind="stable"), self._keypoints
        cuts = np.flatnonzero(np.diff(frames[order] // BLOCK_FRAMES)) + 1
        starts = np.cumsum([0, *map(len, parts)])
        for index in np.split(order, cuts):
            part = np.searchsorted(starts, index, side="right") - 1
            keypoints = np.empty((len(index), *parts[0].shape[1:]))
            for n in np.unique(part).tolist():
                keypoints[part == n] = parts[n][index[part == n] - starts[n]]
            yield PeopleBlock(frames[index], keypoints)


def _pifpaf_video(path: Path) -> CameraPeople | None:
    """Read OpenPifPaf's file of a video, a line of JSON per frame; None for other files."""
    with open_regular(path) as stream:
        begin = stream.read(64).lstrip(b"\xef\xbb\xbf \t\r\n").replace(b" ", b"")
    if not begin.startswith(b'{"frame":'):
        return None
    people, frames, last = _Collected(path, _PIFPAF), list[int](), -1
    lines = read_text(path, most=LARGE).splitlines()
    for number, line in enumerate(lines, start=1):
        if not line.strip():
            continue
        one = validated(_PifPafFrame, parse_json(line, path), path, _RERUN[_PIFPAF])
        if one.frame <= last:
            raise InputError(
                f"{path}: line {number}: frame numbers must increase; {_RERUN[_PIFPAF]}"
            )
        last = one.frame
        place = f"{path}: line {number}"
        people.add([each.flat(place, _PIFPAF) for each in one.predictions])
        frames += [one.frame] * len(one.predictions)
    return people.camera(frames, (min(frames, default=0), last), None)


def _by_picture(path: Path) -> CameraPeople | None:
    """Read AlphaPose's file of --format open and cmu: people by name of the picture; None for other
    files.
    """
    content = read_json(path, most=BIG)
    kinds = {key for each in content.values() for key in (each if isinstance(each, dict) else ())}
    if len(content) == 0 or not kinds & {"people", "bodies"}:
        return None
    people, numbers, frames = _Collected(path, _SEPARATE), list[int](), list[int]()
    for name, frame in content.items():
        place = f"{path}: {name[:40]!r}"
        numbers.append(_number(name, None, place, _SEPARATE))
        people.add(flat := _people(frame, place, _SEPARATE))
        frames += [numbers[-1]] * len(flat)
    return people.camera(frames, (min(numbers), max(numbers)), "openpose coco")


def _results(people: _Collected, items: Iterable[Any], others: Mapping[str, Any]) -> CameraPeople:
    """Read a list of people, each with the picture to which it belongs. Pictures without people are
    not listed.

    `others` has the names of the pictures after all items have been read.
    """
    path, program, images = people.path, people.program, list[int | str]()
    categories = set[int | str | None]()
    for start, results in people.valid(_RESULTS, items):
        images += [person.image_id for person in results]
        categories |= {person.category_id for person in results}
        people.add(
            [
                person.flat(f"{path}: [{index}]", program)
                for index, person in enumerate(results, start)
            ]
        )
    names = _names(others, path, program)
    frames: dict[int | str, int] = {}
    known = [(image, f"[{index}].image_id") for index, image in enumerate(images)]
    known += [(image, f"images[{index}]") for index, image in enumerate(names)]
    for image, place in known:
        if image not in frames:
            frames[image] = _number(image, names.get(image), f"{path}: {place}", program)
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
    listed = (min(first), max(first)) if first else (0, -1)
    joints = _joints_of_categories(others.get("categories"), categories)
    return people.camera([frames[image] for image in images], listed, joints)


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


def _number(image: int | str, name: str | None, place: str, program: str) -> int:
    """Frame number of a picture: the last number in its name; without a name, its id, if that is a
    number.
    """
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


def _video(people: _Collected, items: Iterable[Any], others: Mapping[str, Any]) -> CameraPeople:
    """Read a list of frames, each with its people; `others` has `meta_info` after all items have
    been read.
    """
    frames, first, last = list[int](), MOST_FRAME, -1
    for start, found in people.valid(_FRAMES, items):
        rows = list[list[float]]()
        for index, frame in enumerate(found, start):
            first, last = min(first, frame.frame_id), max(last, frame.frame_id)
            frames += [frame.frame_id] * len(frame.instances)
            rows += [
                each.flat(f"{people.path}: [{index}].instances", _VIDEO) for each in frame.instances
            ]
        people.add(rows)
    joints = _joints_of_meta(others.get("meta_info"))
    return people.camera(frames, (first, last) if last >= 0 else (0, -1), joints)
