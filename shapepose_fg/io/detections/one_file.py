"""A JSON file per camera with all its frames: COCO's keypoint results, AlphaPose's, and MMPose's of a video."""

import re
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, TypeAdapter, ValidationError

from shapepose_fg.errors import InputError
from shapepose_fg.files import read_json
from shapepose_fg.io.detections.people import CameraPeople, PeopleBlock
from shapepose_fg.io.validation import describe, first_problem, key_text

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


_RESULTS = TypeAdapter(list[_Result])
_FRAMES = TypeAdapter(list[_VideoFrame])


def is_one_file(value: Any) -> bool:
    """Whether a JSON file of one camera holds all its frames."""
    if isinstance(value, dict):
        return "instance_info" in value or "annotations" in value
    return isinstance(value, list) and all(
        isinstance(each, dict) and ("image_id" in each or "instances" in each) for each in value[:1]
    )


def read_one_file(path: Path) -> CameraPeople:
    """Read all frames that one camera saw; InputError naming file, key and cure."""
    value = read_json(path)
    if not is_one_file(value):
        raise InputError(
            f"{path}: recognised as JSON ({describe(value)}), expected a list of people with image_id (COCO,"
            " AlphaPose) or of frames with instances (MMPose); give one of these"
        )
    if isinstance(value, dict) and "annotations" in value:
        return _results(path, value["annotations"], _picture_names(value))
    if isinstance(value, dict):
        return _video(path, value["instance_info"])
    if len(value) > 0 and "instances" in value[0]:
        return _video(path, value)
    return _results(path, value, {})


def _results(path: Path, value: Any, names: dict[int, str]) -> CameraPeople:
    """A list of people, each with the picture that it is of. Pictures without people are not in it."""
    first = value[0] if isinstance(value, list) and len(value) > 0 else None
    program = _ALPHAPOSE if isinstance(first, dict) and isinstance(first.get("image_id"), str) else _COCO
    people = _validated(_RESULTS, value, path, program)
    frames, rows = [], []
    for index, person in enumerate(people):
        if len(person.keypoints) % 3 != 0 or len(person.keypoints) == 0:
            raise InputError(
                f"{path}: [{index}].keypoints must hold x, y and score of each keypoint, got"
                f" {len(person.keypoints)} numbers; {_RERUN[program]}"
            )
        frames.append(_number(person.image_id, names, f"{path}: [{index}].image_id", program))
        rows.append(person.keypoints)
    return _camera(path, program, frames, rows, frames)


def _video(path: Path, value: Any) -> CameraPeople:
    """A list of frames, each with its people."""
    frames, rows, numbers = [], [], []
    for index, frame in enumerate(_validated(_FRAMES, value, path, _MMPOSE)):
        numbers.append(frame.frame_id)
        for person in frame.instances:
            if len(person.keypoints) != len(person.keypoint_scores):
                raise InputError(
                    f"{path}: [{index}].instances: {len(person.keypoints)} keypoints have"
                    f" {len(person.keypoint_scores)} keypoint_scores; {_RERUN[_MMPOSE]}"
                )
            frames.append(frame.frame_id)
            pairs = zip(person.keypoints, person.keypoint_scores, strict=True)
            rows.append([number for (x, y), score in pairs for number in (x, y, score)])
    return _camera(path, _MMPOSE, frames, rows, numbers)


def _camera(
    path: Path, program: str, frames: list[int], rows: list[list[float]], listed: list[int]
) -> CameraPeople:
    """The people `rows` in the order of their `frames`; `listed` are all frames that the file knows."""
    counts = sorted({len(row) // 3 for row in rows})
    if len(counts) > 1:
        raise InputError(
            f"{path}: recognised as {program}, with people of {' and '.join(map(str, counts))} keypoints; give the"
            " detections of one model"
        )
    every = PeopleBlock.of(frames, rows)
    order = np.argsort(every.frame, kind="stable")
    blocks = iter([PeopleBlock(every.frame[order], every.keypoints[order])])
    first, last = (min(listed), max(listed)) if listed else (0, -1)
    return CameraPeople(path, program, blocks, first, last, every_frame=False, rerun=_RERUN[program])


def _validated(adapter: TypeAdapter, value: Any, path: Path, program: str) -> Any:
    try:
        return adapter.validate_python(value)
    except ValidationError as error:
        place, problem = first_problem(error)
        raise InputError(f"{path}: {key_text(place)} {problem}; {_RERUN[program]}") from None


def _picture_names(value: dict[str, Any]) -> dict[int, str]:
    """Names of the pictures of a COCO data set by their ids."""
    images = value.get("images")
    if not isinstance(images, list) or not all(isinstance(each, dict) for each in images):
        return {}
    return {each["id"]: str(each["file_name"]) for each in images if "id" in each and "file_name" in each}


def _number(image: int | str, names: dict[int, str], place: str, program: str) -> int:
    """The frame of a picture: its id, or the last number in its name."""
    if isinstance(image, int):
        if image not in names and 0 <= image < _MOST:
            return image
        image = names.get(image, str(image))
    match = _FRAME_NUMBER.search(Path(image).stem) if len(image) <= _LONGEST_NAME else None
    if match is None or len(match[1]) > len(str(_MOST)):
        raise InputError(f"{place} {image[:40]!r} has no frame number; {_RERUN[program]}, of numbered pictures")
    return int(match[1])
