"""People in YOLO's labels: a text file a frame, a line a person, everything as parts of the picture's size."""

from pathlib import Path

import numpy as np

from shapepose_fg.core.errors import InputError
from shapepose_fg.core.storage.files import MIDDLE, read_text
from shapepose_fg.io.camera_names import in_order, numbered
from shapepose_fg.io.detections.people import CameraPeople, frame_blocks
from shapepose_fg.io.validation import is_number

_YOLO = "YOLO's labels"
_RERUN = "run yolo pose again with save_txt=True"
_BOX = 5
"""Number of values in front of the keypoints: class, and middle, width and height of the box."""


def label_files(folder: Path) -> list[tuple[int, Path]]:
    """The files of frames in a folder, or in its folder labels, with their numbers; none where there is none."""
    return numbered(folder, r"\.txt") or numbered(folder / "labels", r"\.txt")


def read_yolo(folder: Path, image_size: tuple[int, int]) -> CameraPeople:
    """The people of one camera whose pictures have `image_size` (width, height).

    Frames without people have no file. InputError naming file, line and cure.
    """
    found = in_order(label_files(folder))

    def read(file: Path) -> list[list[float]]:
        lines = enumerate(read_text(file, may_be_empty=True, most=MIDDLE).splitlines(), start=1)
        return [_person(file, line, text.split(), image_size) for line, text in lines if text.strip()]

    blocks, ends = frame_blocks(folder, _YOLO, found, read), (found[0][0], found[-1][0])
    return CameraPeople(folder, _YOLO, blocks, *ends, every_frame=False, lists_people=True, rerun=_RERUN)


def _person(file: Path, line: int, words: list[str], image_size: tuple[int, int]) -> list[float]:
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
    points[(points[:, :2] == 0).all(axis=1), 2] = 0  # points that are hardly seen are in the corner 0 0
    points[:, :2] *= image_size
    return points.ravel().tolist()
