"""The detection text of 4D Association: joint candidates of one camera, with part affinities.

Zhang et al., "4D Association Graph for Realtime Multi-person Motion Capture", CVPR 2020. The file is a
stream of numbers; docs/conventions.md gives their order.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.camera import Camera
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.skeleton import Skeleton
from shapepose_fg.io.detection_table import BLOCK_FRAMES
from shapepose_fg.io.detections.association_skeletons import (
    SKELETON_TYPES,
    TEXT_SKELETONS,
    TextSkeleton,
    with_middles,
)
from shapepose_fg.io.detections.number_stream import NumberStream
from shapepose_fg.io.detections.scores import OVERSHOOT
from shapepose_fg.io.detections.view_streams import ViewCandidates, ViewStream


def read_association_text(path: Path, camera: Camera) -> tuple[ViewStream, Skeleton]:
    """The candidates that `camera` saw, of `path`, and their skeleton; middle joints are made.

    Of the file only the beginning is read before the stream's blocks are asked for. InputError naming file, line,
    frame and cure.
    """
    numbers = NumberStream(path)
    kind, frame_count = _header(numbers)
    return ViewStream(path, frame_count, _blocks(numbers, kind, frame_count, camera)), kind.skeleton


def _blocks(
    numbers: NumberStream, kind: TextSkeleton, frame_count: int, camera: Camera
) -> Iterator[ViewCandidates]:
    """The candidates of one block of frames after the other."""
    position = 2
    for start in range(0, frame_count, BLOCK_FRAMES):
        numbers.forget(position)
        frames = range(start, min(start + BLOCK_FRAMES, frame_count))
        counts, starts, position = _layout(numbers, kind, frames, frame_count, position)
        view = _candidates(numbers, kind, counts, starts - numbers.first, start, camera)
        yield with_middles(view, kind) if kind.skeleton.middles else view
    if numbers.reaches(position + 1):
        more = numbers.count() - position
        raise numbers.refuse(
            position,
            f"{more} numbers follow the last of the {frame_count} frames",
            "correct the number of frames in line 1, or write the detections again",
        )


def _candidates(
    numbers: NumberStream,
    kind: TextSkeleton,
    counts: NDArray[np.intp],
    starts: NDArray[np.intp],
    start: int,
    camera: Camera,
) -> ViewCandidates:
    """The candidates of the frames from `start` on; `starts` are places in `numbers.values`."""
    frame, joint, rows = _candidate_rows(counts, starts)
    values = numbers.values
    n = counts[frame, joint]
    fractions = np.column_stack([values[rows], values[rows + n]])
    _check(numbers, rows, fractions, values[rows + 2 * n], n)
    pairs, affinity = _pairs(values, kind, counts, starts)
    return ViewCandidates(
        frame=start + frame,
        joint=joint,
        xy=fractions * (np.array(camera.image_size) - 1.0),
        confidence=np.minimum(values[rows + 2 * n], 1.0),
        pairs=pairs,
        affinity=affinity,
    )


def _header(numbers: NumberStream) -> tuple[TextSkeleton, int]:
    """The skeleton, if it is one that is read, and the number of frames."""
    if not numbers.reaches(2):
        raise numbers.refuse(0, "the first line must hold skeleton type and number of frames", "write both")
    number, frame_count = numbers.values[:2]
    kind = next((each for each in TEXT_SKELETONS.values() if each.number == number), None)
    if kind is None:
        known = f" ({SKELETON_TYPES[int(number)]})" if number in range(len(SKELETON_TYPES)) else ""
        raise numbers.refuse(
            0,
            f"skeleton type {number:g}{known} is not read here, only 4 (BODY_25) and 3 (COCO_18)",
            "run the detector with its BODY_25 model",
        )
    if frame_count < 1 or frame_count != int(frame_count):
        raise numbers.refuse(1, f"the number of frames must be 1 or more, got {frame_count:g}", "correct it")
    return kind, int(frame_count)


def _layout(
    numbers: NumberStream, kind: TextSkeleton, frames: range, frame_count: int, position: int
) -> tuple[NDArray[np.intp], NDArray[np.intp], int]:
    """How many candidates each joint of each frame has, and where the numbers of each block start.

    Returns `counts` (T, J), `starts` (T, J + 1), the first x of a joint, and in the last column the first affinity
    of the frame; and where the next frame begins. `position` is where the first does. Each count is known only
    when the one before has been passed, so this is a loop, over blocks; everything inside the blocks is done in
    arrays.
    """
    counts, starts = [], []
    for frame in frames:
        frame_counts, frame_starts = [], []
        for name in kind.joints:
            if not numbers.reaches(position + 1):
                raise _cut(numbers, frame, f"the number of candidates of {name}", frame_count)
            n = numbers.values[position - numbers.first]
            if n < 0 or n != int(n):
                raise numbers.refuse(
                    position,
                    f"frame {frame} must give the number of candidates of {name}, got {n:g}",
                    "a number is missing or too many before this line: write the detections again",
                )
            frame_counts.append(int(n))
            frame_starts.append(position + 1)
            position += 1 + 3 * int(n)
            if not numbers.reaches(position):
                raise _cut(numbers, frame, f"the candidates of {name}", frame_count)
        frame_starts.append(position)
        for first, second in kind.limbs:
            position += frame_counts[first] * frame_counts[second]
            if not numbers.reaches(position):
                limb = f"{kind.joints[first]}-{kind.joints[second]}"
                raise _cut(numbers, frame, f"the affinities of {limb}", frame_count)
        counts.append(frame_counts)
        starts.append(frame_starts)
    return np.array(counts, dtype=np.intp), np.array(starts, dtype=np.intp), position


def _cut(numbers: NumberStream, frame: int, what: str, frame_count: int) -> InputError:
    """The file ends too early."""
    return numbers.refuse(
        None,
        f"the file ends in frame {frame} of {frame_count}, where {what} should be",
        "copy or write it again whole",
    )


def _candidate_rows(
    counts: NDArray[np.intp], starts: NDArray[np.intp]
) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp]]:
    """Frame (D,), joint (D,) and place of x in the stream (D,) of every candidate."""
    block, within = _expand(counts.ravel())
    frame, joint = np.divmod(block, counts.shape[1])
    return frame, joint, starts[:, :-1].ravel()[block] + within


def _pairs(
    values: NDArray[np.float64], kind: TextSkeleton, counts: NDArray[np.intp], starts: NDArray[np.intp]
) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """The pairs of candidates (E, 2) with an affinity above 0, and that affinity (E,)."""
    first, second = np.array(kind.limbs).T
    sizes = counts[:, first] * counts[:, second]  # (T, L)
    block_start = starts[:, -1:] + np.cumsum(sizes, axis=1) - sizes
    block, within = _expand(sizes.ravel())
    affinity = values[block_start.ravel()[block] + within]
    used = affinity > 0
    block, within = block[used], within[used]
    row, column = np.divmod(within, counts[:, second].ravel()[block])  # matrices are (A, B), row by row
    candidate_start = (np.cumsum(counts) - counts.ravel()).reshape(counts.shape)
    a = candidate_start[:, first].ravel()[block] + row
    b = candidate_start[:, second].ravel()[block] + column
    return np.column_stack([a, b]), affinity[used]


def _expand(sizes: NDArray[np.intp]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """For every element of blocks of these sizes: its block, and its place within the block."""
    block = np.repeat(np.arange(len(sizes)), sizes)
    return block, np.arange(len(block)) - (np.cumsum(sizes) - sizes)[block]


def _check(
    numbers: NumberStream,
    rows: NDArray[np.intp],
    fractions: NDArray[np.float64],
    scores: NDArray[np.float64],
    n: NDArray[np.intp],
) -> None:
    """Refuse scores that are no scores and positions that are no parts of the picture."""
    bad = (scores < 0) | (scores > OVERSHOOT)
    if bad.any():
        index = int(np.argmax(bad))
        raise numbers.refuse(
            numbers.first + int(rows[index] + 2 * n[index]),
            f"a candidate's score must lie between 0 and 1, got {scores[index]:g}",
            "write the detections again: scores are the third row of each joint",
        )
    bad = np.any(np.abs(fractions) > 2, axis=1)
    if bad.any():
        index = int(np.argmax(bad))
        raise numbers.refuse(
            numbers.first + int(rows[index]),
            f"a candidate lies at ({fractions[index, 0]:g}, {fractions[index, 1]:g}) of the picture's size",
            "divide x by width - 1 and y by height - 1",
        )
