"""A JSON file per frame: OpenPose's, Pose2Sim's (RTMLib's people written in OpenPose's way), MMPose's of pictures.

Pose2Sim leaves `_keypoints` out of the names, writes NaN for people that it dropped, and `{}` for people that a
camera does not see.
"""

import re
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

from pydantic import BaseModel, ConfigDict, FiniteFloat, TypeAdapter

from shapepose_fg.core.errors import InputError
from shapepose_fg.core.storage.files import MIDDLE, read_json, read_text
from shapepose_fg.io.detection_table import BLOCK_FRAMES
from shapepose_fg.io.detections.people import CameraPeople, PeopleBlock
from shapepose_fg.io.validation import validated, validated_list

_FILE = re.compile(r"(\d+)(_keypoints)?\.json$")
"""How the file of a frame is named."""
_OPENPOSE, _POSE2SIM, _MMPOSE = "OpenPose's JSON", "Pose2Sim's JSON", "MMPose's JSON of pictures"
_RERUN = {
    _OPENPOSE: "run OpenPose again with --write_json --keypoint_scale 0",
    _POSE2SIM: "run Pose2Sim's pose estimation again",
    _MMPOSE: "run MMPose again with --pred-out-dir",
}
_MOST = 10**12
"""No frame has a higher number."""
_LONGEST_GAP = 1000
"""Frames that may be missing, and as many as there are: more are numbers of something else."""


class _Person(BaseModel):
    """A person of a frame; hands and face are passed over."""

    model_config = ConfigDict(strict=True, extra="allow")
    pose_keypoints_2d: list[float] | None = None


class _Frame(BaseModel):
    model_config = ConfigDict(strict=True)
    people: list[_Person]


class _Instance(BaseModel):
    """A person of a frame, as MMPose writes it."""

    model_config = ConfigDict(strict=True)
    keypoints: list[list[FiniteFloat]]
    keypoint_scores: list[FiniteFloat]


_INSTANCES = TypeAdapter(list[_Instance])


def frame_files(folder: Path) -> list[Path]:
    """Files of a folder that are named after a frame, in order of their names."""
    # macOS leaves ._000000_keypoints.json beside each file that it copies.
    found = [each for each in folder.iterdir() if _FILE.search(each.name) and not each.name.startswith(".")]
    return sorted(each for each in found if each.is_file())


def frame_number(file: Path) -> int:
    """The number of the frame that a file is named after."""
    match = _FILE.search(file.name)
    if match is None:
        raise ValueError(f"{file.name} is not named after a frame")
    return int(match[1])


def read_frame_files(folder: Path) -> CameraPeople:
    """The frames that one camera saw; InputError naming file, key and cure.

    A frame's number is in its file's name. No people are seen in frames whose files are missing in between
    (`gaps`).
    """
    files = frame_files(folder)
    if len(files) == 0:
        lists = sorted(each.name for each in folder.glob("*.json") if not each.name.startswith("."))
        if len(lists) > 1:
            names = " ".join(lists[:4])
            raise InputError(
                f"{folder}: several JSON files without frame numbers ({names}); leave the one to be read"
            )
        raise InputError(
            f"{folder}: no *_keypoints.json (OpenPose) or *_000000.json (Pose2Sim) in this folder; run OpenPose"
            " or Pose2Sim's pose estimation into it"
        )
    program = _OPENPOSE
    if not files[0].name.endswith("_keypoints.json"):
        program = _MMPOSE if read_text(files[0], most=MIDDLE).lstrip()[:1] == "[" else _POSE2SIM
    numbered = _numbered(folder, files, _RERUN[program])
    numbers = list(numbered)
    gaps = tuple((one + 1, other - 1) for one, other in pairwise(numbers) if other > one + 1)
    blocks = _blocks(folder, program, numbered)
    return CameraPeople(folder, program, blocks, numbers[0], numbers[-1], gaps=gaps, rerun=_RERUN[program])


def _numbered(folder: Path, files: list[Path], rerun: str) -> dict[int, Path]:
    """The frames' files by the frames' numbers, which rise."""
    numbered = sorted((frame_number(file), file) for file in files)
    first, last = numbered[0][0], numbered[-1][0]
    if last >= _MOST:
        raise InputError(
            f"{numbered[-1][1]}: no frame has so high a number; number them by the recording's frames"
        )
    for (number, file), (following, other) in pairwise(numbered):
        if following == number:
            raise InputError(f"{other}: frame {number} is also in {file.name}; keep one recording in a folder")
    if last - first + 1 > 2 * len(numbered) + _LONGEST_GAP:
        raise InputError(
            f"{folder}: {len(numbered)} files are numbered from {first} to {last}; number them"
            f" by the frames of the recording, or {rerun}"
        )
    return dict(numbered)


def _blocks(folder: Path, program: str, files: dict[int, Path]) -> Iterator[PeopleBlock]:
    """The people of the files, block by block."""
    read = _instances if program == _MMPOSE else _people
    counts, numbers = set[int](), list(files)
    for start in range(0, len(numbers), BLOCK_FRAMES):
        frames, people = list[int](), list[list[float]]()
        for number in numbers[start : start + BLOCK_FRAMES]:
            found = read(files[number], _RERUN[program])
            people += found
            frames += [number] * len(found)
        counts |= {len(person) // 3 for person in people}
        if len(counts) > 1:
            listing = " and ".join(map(str, sorted(counts)))
            raise InputError(
                f"{folder}: recognised as {program}, with people of {listing} keypoints; give those of one model"
            )
        yield PeopleBlock.of(frames, people)


def _people(file: Path, rerun: str) -> list[list[float]]:
    """Flat keypoints of the people of a frame; people without keypoints are left out."""
    found = []
    for number, person in enumerate(validated(_Frame, read_json(file, most=MIDDLE), file, rerun).people):
        values, place = person.pose_keypoints_2d, f"{file}: people[{number}].pose_keypoints_2d"
        if values is None and person.model_extra:
            raise InputError(f"{place} is missing; {rerun}")
        if values is None or len(values) == 0:
            continue
        if len(values) % 3 != 0:
            raise InputError(
                f"{place} must hold x, y and score of each keypoint, got {len(values)} numbers; {rerun}"
            )
        if any(value in (float("inf"), float("-inf")) for value in values):
            raise InputError(f"{place} holds Infinity; {rerun}")
        found.append(values)
    return found


def _instances(file: Path, rerun: str) -> list[list[float]]:
    """Flat keypoints of the people of a picture of MMPose."""
    found = []
    for number, person in enumerate(validated_list(_INSTANCES, read_json(file, most=MIDDLE), file, rerun)):
        scores = person.keypoint_scores
        if len(person.keypoints) != len(scores) or any(len(each) != 2 for each in person.keypoints):
            raise InputError(
                f"{file}: [{number}].keypoints must hold x and y for each of the {len(scores)}"
                f" keypoint_scores; {rerun}"
            )
        found.append(
            [value for (x, y), score in zip(person.keypoints, scores, strict=True) for value in (x, y, score)]
        )
    return found
