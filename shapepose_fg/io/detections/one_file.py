"""A JSON file per camera with all its frames: COCO's keypoint results, AlphaPose's, and MMPose's of a video."""

import re
from collections.abc import Iterable, Iterator, Mapping
from itertools import chain, islice
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, TypeAdapter

from shapepose_fg.core.errors import InputError
from shapepose_fg.io.detection_table import BLOCK_FRAMES
from shapepose_fg.io.detections.people import CameraPeople, PeopleBlock
from shapepose_fg.io.json_items import JsonItems
from shapepose_fg.io.validation import describe, validated_list

_COCO, _ALPHAPOSE, _MMPOSE = "COCO's keypoint results", "AlphaPose's JSON", "MMPose's JSON of a video"
_RERUN = {
    _COCO: "write the results again, in pixels",
    _ALPHAPOSE: "run AlphaPose again with --format coco",
    _MMPOSE: "run MMPose again with --save-predictions or --pred-out-dir",
}
_MOST = 10**12
"""No frame has a higher number."""
_LONGEST_NAME = 4096
"""Characters of a picture's path: the search takes the square of them."""
_FRAME_NUMBER = re.compile(r"(\d+)\D*$")
"""The last number in the name of a picture."""
_LISTS = ("annotations", "instance_info")
"""Keys of the list where the file is an object: those of COCO's data sets and of MMPose."""
_AT_ONCE = 1024
"""Items that are checked together: as Python's numbers they take several times the memory of an array."""


class _Result(BaseModel):
    """A person of COCO's results."""

    model_config = ConfigDict(strict=True)
    image_id: int | str
    keypoints: list[float]


class _Instance(BaseModel):
    """A person of MMPose."""

    model_config = ConfigDict(strict=True)
    keypoints: list[Annotated[list[FiniteFloat], Field(min_length=2, max_length=2)]]
    keypoint_scores: list[FiniteFloat]


class _VideoFrame(BaseModel):
    """A frame of MMPose."""

    model_config = ConfigDict(strict=True)
    frame_id: Annotated[int, Field(ge=0, lt=_MOST)]
    instances: list[_Instance]


_RESULTS, _FRAMES = TypeAdapter(list[_Result]), TypeAdapter(list[_VideoFrame])


def is_one_file(path: Path) -> bool:
    """Whether all frames of one camera are in a JSON file, or in the only one of a folder."""
    if path.is_dir():
        lists = _lists(path)
        return len(lists) == 1 and _holds_all(lists[0])
    return path.is_file()


def _lists(folder: Path) -> list[Path]:
    return [each for each in folder.glob("*.json") if not each.name.startswith(".")]


def _holds_all(path: Path) -> bool:
    items = JsonItems(path, _LISTS)
    return items.key is not None or (items.found and _known(next(iter(items), {"image_id": None})))


def read_one_file(path: Path) -> CameraPeople:
    """Read all frames that one camera saw; InputError naming file, key and cure."""
    path = _lists(path)[0] if path.is_dir() else path
    items = JsonItems(path, _LISTS)
    if items.key is not None and not items.found:
        raise InputError(f"{path}: the file must be a list, got {describe(items.value)}; {_RERUN[_COCO]}")
    every = iter(items)
    first = next(every, None)
    if not items.found or (items.key is None and first is not None and not _known(first)):
        found = "a list" if items.found else describe(items.value)
        raise InputError(
            f"{path}: recognised as JSON ({found}), expected a list of people with image_id (COCO,"
            " AlphaPose) or of frames with instances (MMPose); give one of these"
        )
    again = every if first is None else chain([first], every)
    if items.key == "instance_info" or (isinstance(first, dict) and "instances" in first):
        return _video(path, again)
    program = _ALPHAPOSE if isinstance(first, dict) and isinstance(first.get("image_id"), str) else _COCO
    return _results(path, program, again, items.others)


def _known(item: Any) -> bool:
    """Whether this is an item of one of the programs' lists."""
    return isinstance(item, dict) and ("image_id" in item or "instances" in item)


def _checked(adapter: Any, items: Iterable[Any], path: Path, program: str) -> Iterator[tuple[int, list[Any]]]:
    """The items, some at a time, and the index of the first of them."""
    items, start = iter(items), 0
    while len(some := list(islice(items, _AT_ONCE))) > 0:
        yield start, validated_list(adapter, some, path, _RERUN[program], start)
        start += len(some)


def _results(path: Path, program: str, items: Iterable[Any], others: Mapping[str, Any]) -> CameraPeople:
    """A list of people, each with the picture that it is of. Pictures without people are not in it.

    `others` has the pictures' names when all items have been read.
    """
    people, images = _People(path, program), list[int | str]()
    for start, results in _checked(_RESULTS, items, path, program):
        for index, person in enumerate(results, start):
            if len(person.keypoints) % 3 != 0 or len(person.keypoints) == 0:
                raise InputError(
                    f"{path}: [{index}].keypoints must hold x, y and score of each keypoint, got"
                    f" {len(person.keypoints)} numbers; {_RERUN[program]}"
                )
        images += [person.image_id for person in results]
        people.add([person.keypoints for person in results])
    pictures = _pictures(others, path, program)
    frames: dict[int | str, int] = {}
    known = [(image, f"[{index}].image_id") for index, image in enumerate(images)]
    known += [(image, f"images[{index}]") for index, image in enumerate(pictures)]
    for image, place in known:
        if image not in frames:
            frames[image] = _number(image, pictures.get(image), f"{path}: {place}", program)
    first: dict[int, int | str] = {}
    for image, frame in frames.items():
        if first.setdefault(frame, image) != image:
            raise InputError(
                f"{path}: the pictures {str(first[frame])[:40]!r} and {str(image)[:40]!r} are both frame {frame};"
                f" {_RERUN[program]}, of one camera with a number for each picture"
            )
    listed = (min(first), max(first)) if first else (0, -1)
    return people.camera([frames[image] for image in images], listed)


def _video(path: Path, items: Iterable[Any]) -> CameraPeople:
    """A list of frames, each with its people."""
    people, frames, first, last = _People(path, _MMPOSE), list[int](), _MOST, -1
    for start, found in _checked(_FRAMES, items, path, _MMPOSE):
        rows = list[list[float]]()
        for index, frame in enumerate(found, start):
            first, last = min(first, frame.frame_id), max(last, frame.frame_id)
            for person in frame.instances:
                if len(person.keypoints) != len(person.keypoint_scores):
                    raise InputError(
                        f"{path}: [{index}].instances: {len(person.keypoints)} keypoints have"
                        f" {len(person.keypoint_scores)} keypoint_scores; {_RERUN[_MMPOSE]}"
                    )
                frames.append(frame.frame_id)
                pairs = zip(person.keypoints, person.keypoint_scores, strict=True)
                rows.append([number for (x, y), score in pairs for number in (x, y, score)])
        people.add(rows)
    return people.camera(frames, (first, last) if last >= 0 else (0, -1))


def _pictures(others: Mapping[str, Any], path: Path, program: str) -> dict[int | str, str | None]:
    """The pictures of a COCO data set by their ids, those without people too: the names of their files."""
    pictures = {}
    images = others.get("images")
    for index, image in enumerate(images if isinstance(images, list) else []):
        one = image.get("id") if isinstance(image, dict) else None
        if type(one) not in (int, str):
            raise InputError(f"{path}: images[{index}].id must be a whole number or text; {_RERUN[program]}")
        pictures[one] = str(image["file_name"]) if "file_name" in image else None
    return pictures


def _number(image: int | str, name: str | None, place: str, program: str) -> int:
    """The frame of a picture: the last number in its name, or its id where that is a number and it has no name."""
    if name is None and isinstance(image, int):
        if 0 <= image < _MOST:
            return image
        raise InputError(f"{place} '{image}' is no frame's number; {_RERUN[program]}, of numbered pictures")
    name = str(image) if name is None else name
    match = _FRAME_NUMBER.search(Path(name).stem) if len(name) <= _LONGEST_NAME else None
    if match is None or len(match[1]) > len(str(_MOST)):
        raise InputError(f"{place} {name[:40]!r} has no frame number; {_RERUN[program]}, of numbered pictures")
    return int(match[1])


class _People:
    """People as they are read, in arrays."""

    def __init__(self, path: Path, program: str) -> None:
        self._path, self._program = path, program
        self._keypoints, self._counts = list[NDArray[np.float64]](), set[int]()

    def add(self, rows: list[list[float]]) -> None:
        """Take in people with flat keypoints."""
        self._counts |= {len(row) // 3 for row in rows}
        if len(self._counts) > 1:
            raise InputError(
                f"{self._path}: recognised as {self._program}, with people of"
                f" {' and '.join(map(str, sorted(self._counts)))} keypoints; give the detections of one model"
            )
        if len(rows) > 0:
            self._keypoints.append(np.array(rows, dtype=np.float64).reshape(len(rows), len(rows[0]) // 3, 3))

    def camera(self, frames: list[int], listed: tuple[int, int]) -> CameraPeople:
        """All of them, who are in these `frames` (N); `listed` are the first and last that the file knows."""
        blocks = self._in_order(np.array(frames, dtype=np.intp))
        rerun = _RERUN[self._program]
        return CameraPeople(self._path, self._program, blocks, *listed, every_frame=False, rerun=rerun)

    def _in_order(self, frames: NDArray[np.intp]) -> Iterator[PeopleBlock]:
        """People in the order of their frames (N,), some frames at a time."""
        parts = self._keypoints
        if len(frames) == 0:
            return
        order = np.argsort(frames, kind="stable")
        cuts = np.flatnonzero(np.diff(frames[order] // BLOCK_FRAMES)) + 1
        starts = np.cumsum([0, *map(len, parts)])
        for index in np.split(order, cuts):
            part = np.searchsorted(starts, index, side="right") - 1
            keypoints = np.empty((len(index), *parts[0].shape[1:]))
            for n in np.unique(part).tolist():
                keypoints[part == n] = parts[n][index[part == n] - starts[n]]
            yield PeopleBlock(frames[index], keypoints)
