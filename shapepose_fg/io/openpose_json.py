"""OpenPose's JSON output: a folder per camera, a file per frame, people with 25 keypoints.

Its people are taken apart again: keypoints become candidates, with affinity 1 between two joints of one
person and 0 otherwise, so that grouped and ungrouped detections walk the same way.
"""

import re
from itertools import pairwise
from pathlib import Path
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, ValidationError

from shapepose_fg.errors import InputError
from shapepose_fg.files import read_text
from shapepose_fg.io.detection_table import ViewCandidates
from shapepose_fg.io.validation import first_problem, key_text
from shapepose_fg.skeleton import BODY_25

_FILE = re.compile(r"(?:^|_)(\d+)_keypoints\.json$")
"""How OpenPose names the file of a frame."""
_OVERSHOOT = 1.1
"""Heat maps that are enlarged overshoot a little: scores up to this are read as 1."""
_LIMBS = np.array(BODY_25.limbs)
_KEYPOINT_CURES = {
    54: "these are COCO's 18 keypoints: run OpenPose with --model_pose BODY_25",
    45: "these are MPI's 15 keypoints: run OpenPose with --model_pose BODY_25",
}
_CURE = "run OpenPose again with --model_pose BODY_25 --write_json"


class _Person(BaseModel):
    """A person of a frame; hands and face are passed over."""

    model_config = ConfigDict(strict=True)
    pose_keypoints_2d: Annotated[list[FiniteFloat], Field(min_length=75, max_length=75)]


class _Frame(BaseModel):
    """The file of one frame."""

    model_config = ConfigDict(strict=True)
    people: list[_Person]


def read_openpose_folder(folder: Path) -> ViewCandidates:
    """Read the frames that one camera saw; InputError naming file, key and cure.

    A frame's number is in its file's name. Numbers must follow each other; the first file is frame 0.
    """
    first_number, files = _files(folder)
    people = [_people(file) for file in files]
    counts = np.array([len(each) for each in people], dtype=np.intp)
    keypoints = np.concatenate(people)  # (N, J, 3)
    person_frame = np.repeat(np.arange(len(files)), counts)
    score = keypoints[..., 2]
    bad = (score < 0) | (score > _OVERSHOOT)
    if bad.any():
        person, joint = np.argwhere(bad)[0]
        file = files[person_frame[person]]
        raise InputError(
            f"{file}: the score of a {BODY_25.joints[joint]} must lie between 0 and 1, got"
            f" {score[person, joint]:g}; {_CURE}"
        )
    person, joint = np.nonzero(score > 0)  # OpenPose writes 0 0 0 for a joint that it did not see
    _refuse_normalised(folder, keypoints[person, joint, :2])
    order = np.lexsort((person, joint, person_frame[person]))
    person, joint = person[order], joint[order]
    return ViewCandidates(
        source=folder,
        frame_count=len(files),
        frame=person_frame[person],
        joint=joint,
        xy=keypoints[person, joint, :2],
        confidence=np.minimum(score[person, joint], 1.0),
        first_number=first_number,
        **_pairs(person, joint, person_frame),
    )


def _files(folder: Path) -> tuple[int, list[Path]]:
    """The number of the first frame, and the frames' files, in order and without a gap."""
    numbered = [
        (int(match[1]), file)
        for file in folder.iterdir()
        if (match := _FILE.search(file.name)) is not None and file.is_file()
    ]
    if len(numbered) == 0:
        raise InputError(f"{folder}: no *_keypoints.json in this folder; {_CURE} into it")
    numbered.sort()
    for (number, file), (following, other) in pairwise(numbered):
        if following == number:
            raise InputError(f"{other}: frame {number} is also in {file.name}; keep one recording in a folder")
        if following > number + 1:
            digits = _FILE.search(file.name)[1]  # type: ignore[index]
            missing = file.with_name(
                file.name.replace(f"{digits}_keypoints", f"{number + 1:0{len(digits)}d}_keypoints")
            )
            raise InputError(
                f"{missing}: this frame is missing, {other.name} comes next; {_CURE}"
                " (a frame without people has a file too)"
            )
    return numbered[0][0], [file for _, file in numbered]


def _people(file: Path) -> NDArray[np.float64]:
    """Keypoints (P, J, 3) of the people of a frame."""
    try:
        frame = _Frame.model_validate_json(read_text(file))
    except ValidationError as error:
        place, problem = first_problem(error)
        cure = _CURE
        if place[-1:] == ("pose_keypoints_2d",) and isinstance(error.errors()[0]["input"], list):
            cure = _KEYPOINT_CURES.get(len(error.errors()[0]["input"]), _CURE)
        raise InputError(f"{file}: {key_text(place)} {problem}; {cure}") from None
    return np.array([person.pose_keypoints_2d for person in frame.people]).reshape(-1, len(BODY_25), 3)


def _refuse_normalised(folder: Path, xy: NDArray[np.float64]) -> None:
    """Refuse keypoints that are parts of the picture's size instead of pixels."""
    if len(xy) > 0 and np.abs(xy).max() <= 1:
        raise InputError(
            f"{folder}: all keypoints lie between -1 and 1; run OpenPose with --keypoint_scale 0, which"
            " writes pixels"
        )


def _pairs(
    person: NDArray[np.intp], joint: NDArray[np.intp], person_frame: NDArray[np.intp]
) -> dict[str, NDArray]:
    """The limbs of every person whose two ends were seen, with affinity 1, sorted by frame."""
    row = np.full((len(person_frame), len(BODY_25)), -1, dtype=np.intp)
    row[person, joint] = np.arange(len(person))
    pairs = row[:, _LIMBS].reshape(-1, 2)  # people are in the order of their frames, so pairs are too
    pairs = pairs[np.all(pairs >= 0, axis=1)]
    return {"pairs": pairs, "affinity": np.ones(len(pairs))}
