"""People in YOLO's labels: a text file per frame, a line per person, coordinates relative to the
picture's size.
"""

from pathlib import Path

import numpy as np

from shapepose_fg.core.arrays import Array
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.storage.files import MIDDLE, read_text
from shapepose_fg.core.validation import is_number
from shapepose_fg.io.camera_names import in_order, numbered
from shapepose_fg.io.detections.people import CameraPeople, frame_blocks

_YOLO = "YOLO's labels"
_RERUN = "run yolo pose again with save_txt=True"


def label_files(folder: Path) -> list[tuple[int, Path]]:
    """The label files of a folder, or of its subfolder labels, with their frame numbers; empty if
    there are none.
    """
    return numbered(folder, r"\.txt") or numbered(folder / "labels", r"\.txt")


def read_yolo(folder: Path, image_size: tuple[int, int]) -> CameraPeople:
    """Read the people of one camera; `image_size` is (width, height) of its pictures.

    Frames without people have no file. InputError naming file, line and cure.
    """
    found = in_order(label_files(folder))

    def read(file: Path) -> list[Array]:
        lines = enumerate(read_text(file, may_be_empty=True, most=MIDDLE).splitlines(), start=1)
        return [
            _person(file, line, text.split(), image_size) for line, text in lines if text.strip()
        ]

    blocks, ends = frame_blocks(folder, _YOLO, found, read), (found[0][0], found[-1][0])
    return CameraPeople(
        folder, _YOLO, blocks, *ends, every_frame=False, lists_people=True, rerun=_RERUN
    )


def _person(file: Path, line: int, words: list[str], image_size: tuple[int, int]) -> Array:
    """(K, 3) x, y and score of each keypoint; the box's confidence and a track number may follow in
    the line.
    """
    if not all(is_number(word) for word in words):
        raise InputError(f"{file}: line {line} must hold numbers; {_RERUN}")
    # Number of values before the keypoints: class, and centre, width and height of the box.
    numbers = np.array(words[5:], dtype=np.float64)
    count = len(numbers) // 3
    if count < 4:
        raise InputError(
            f"{file}: line {line} has a box but no keypoints; run a pose model: yolo pose predict"
        )
    points = numbers[: 3 * count].reshape(count, 3)
    if (
        not ((points[:, :2] > -1) & (points[:, :2] < 2)).all()
        or not ((points[:, 2] >= 0) & (points[:, 2] <= 2)).all()
    ):
        raise InputError(
            f"{file}: line {line} must hold x and y of keypoints as fractions of the picture "
            f"size, and scores; {_RERUN}"
        )
    points[(points[:, :2] == 0).all(axis=1), 2] = 0  # keypoints with a low score are at 0 0
    points[:, :2] *= image_size
    return points
