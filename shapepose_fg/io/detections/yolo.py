"""People in YOLO's labels: a text file a frame, a line a person, everything as parts of the picture's size."""

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from shapepose_fg.core.errors import InputError
from shapepose_fg.core.storage.files import MIDDLE, read_text
from shapepose_fg.io.camera_names import in_order
from shapepose_fg.io.detection_table import BLOCK_FRAMES
from shapepose_fg.io.detections.people import CameraPeople, PeopleBlock
from shapepose_fg.io.validation import is_number

_YOLO = "YOLO's labels"
_RERUN = "run yolo pose again with save_txt=True"
_FRAME_FILE = re.compile(r"(\d+)\.txt$")
_BOX = 5
"""Number of values in front of the keypoints: class, and middle, width and height of the box."""


def label_files(folder: Path) -> list[tuple[int, Path]]:
    """The files of frames in a folder, or in its folder labels, with their numbers; none where there is none."""
    for place in (folder, folder / "labels"):
        if place.is_dir():
            files = [each for each in place.iterdir() if not each.name.startswith(".")]
            found = [
                (match, each) for each in files if (match := _FRAME_FILE.search(each.name)) and each.is_file()
            ]
            if found:
                return [(int(match[1]), each) for match, each in found]
    return []


def read_yolo(folder: Path, image_size: tuple[int, int]) -> CameraPeople:
    """The people of one camera whose pictures have `image_size` (width, height).

    Frames without people have no file. InputError naming file, line and cure.
    """
    numbered = in_order(label_files(folder))
    width, height = image_size

    def blocks() -> Iterator[PeopleBlock]:
        counts = set[int]()
        for start in range(0, len(numbered), BLOCK_FRAMES):
            frames, people = list[int](), list[list[float]]()
            for number, file in numbered[start : start + BLOCK_FRAMES]:
                for line, text in enumerate(read_text(file, may_be_empty=True, most=MIDDLE).splitlines(), start=1):
                    if text.strip():
                        people.append(_person(file, line, text.split()))
                        frames.append(number)
            counts |= {len(person) for person in people}
            if len(counts) > 1:
                raise InputError(f"{folder}: people have {sorted(counts)} numbers; give the labels of one model")
            block = PeopleBlock.of(frames, people)
            # Points that are hardly seen are in the corner 0 0.
            block.keypoints[(block.keypoints[..., :2] == 0).all(axis=2), 2] = 0
            block.keypoints[..., :2] *= (width, height)
            yield block

    how = {"every_frame": False, "lists_people": True, "rerun": _RERUN}
    return CameraPeople(folder, _YOLO, blocks(), numbered[0][0], numbered[-1][0], **how)


def _person(file: Path, line: int, words: list[str]) -> list[float]:
    """x, y and score of each keypoint; the box's confidence and a track's number may follow."""
    if not all(is_number(word) for word in words):
        raise InputError(f"{file}: line {line} must hold numbers; {_RERUN}")
    numbers = np.array(words[_BOX:], dtype=np.float64)
    count = len(numbers) // 3
    if count < 4:
        raise InputError(f"{file}: line {line} has a box but no keypoints; run a pose model: yolo pose predict")
    points = numbers[: 3 * count].reshape(count, 3)
    if (
        not ((points[:, :2] > -1) & (points[:, :2] < 2)).all()
        or not ((points[:, 2] >= 0) & (points[:, 2] <= 2)).all()
    ):
        raise InputError(
            f"{file}: line {line} must hold x and y of keypoints as fractions of the picture size, and scores;"
            f" {_RERUN}"
        )
    return points.ravel().tolist()
