"""The detection text of 4D Association: joint candidates of one camera, with part affinities.

Zhang et al., "4D Association Graph for Realtime Multi-person Motion Capture", CVPR 2020. The file is a
stream of numbers; docs/conventions.md gives their order.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.camera import Camera
from shapepose_fg.errors import InputError
from shapepose_fg.files import read_text
from shapepose_fg.io.detection_table import ViewCandidates
from shapepose_fg.io.detections.association_skeletons import (
    SKELETON_TYPES,
    TEXT_SKELETONS,
    TextSkeleton,
    with_middles,
)
from shapepose_fg.skeleton import Skeleton

_OVERSHOOT = 1.1
"""Heat maps that are enlarged overshoot a little: scores up to this are read as 1."""


def read_association_text(path: Path, camera: Camera) -> tuple[ViewCandidates, Skeleton]:
    """Read the candidates that `camera` saw from `path`, and their skeleton; middle joints are made.

    InputError naming file, line, frame and cure.
    """
    text = read_text(path)
    stream = _Stream(path, text, _numbers(path, text))
    kind, frame_count = _header(stream)
    counts, starts = _layout(stream, kind, frame_count)
    frame, joint, rows = _candidate_rows(counts, starts)
    values = stream.values
    n = counts[frame, joint]
    fractions = np.column_stack([values[rows], values[rows + n]])
    _check(stream, rows, fractions, values[rows + 2 * n], n)
    pairs, affinity = _pairs(values, kind, counts, starts)
    view = ViewCandidates(
        source=path,
        frame_count=frame_count,
        frame=frame,
        joint=joint,
        xy=fractions * (np.array(camera.image_size) - 1.0),
        confidence=np.minimum(values[rows + 2 * n], 1.0),
        pairs=pairs,
        affinity=affinity,
    )
    return (with_middles(view, kind) if kind.skeleton.middles else view), kind.skeleton


class _Stream:
    """The numbers of a file, and where in the file each of them stands."""

    def __init__(self, path: Path, text: str, values: NDArray[np.float64]) -> None:
        self.path = path
        self.text = text
        self.values = values

    def line(self, index: int) -> int:
        """The line, from 1, on which number `index` stands."""
        lines = self.text.splitlines()
        ends = np.cumsum([len(line.split()) for line in lines])
        return min(int(np.searchsorted(ends, index, side="right")) + 1, len(lines))

    def refuse(self, index: int, problem: str, cure: str) -> InputError:
        """An error about number `index`."""
        return InputError(f"{self.path}: line {self.line(index)}: {problem}; {cure}")


def _numbers(path: Path, text: str) -> NDArray[np.float64]:
    """All numbers of the file, finite."""
    tokens = text.split()
    try:
        values = np.array(tokens, dtype=np.float64)
        bad = int(np.argmin(np.isfinite(values))) if not np.isfinite(values).all() else None
    except ValueError:
        values, bad = np.zeros(0), _first_bad(tokens)
    if bad is not None:
        stream = _Stream(path, text, values)
        raise stream.refuse(bad, f"{tokens[bad][:20]!r} is not a finite number", "write the detections again")
    return values


def _first_bad(tokens: Sequence[str]) -> int:
    """The first token that is no number."""
    for index, token in enumerate(tokens):
        try:
            np.float64(token)
        except ValueError:
            return index
    raise AssertionError("one of the tokens is no number")


def _header(stream: _Stream) -> tuple[TextSkeleton, int]:
    """The skeleton, if it is one that is read, and the number of frames."""
    values = stream.values
    if len(values) < 2:
        raise stream.refuse(0, "the first line must hold skeleton type and number of frames", "write both")
    kind = next((each for each in TEXT_SKELETONS.values() if each.number == values[0]), None)
    if kind is None:
        known = f" ({SKELETON_TYPES[int(values[0])]})" if values[0] in range(len(SKELETON_TYPES)) else ""
        raise stream.refuse(
            0,
            f"skeleton type {values[0]:g}{known} is not read here, only 4 (BODY_25) and 3 (COCO_18)",
            "run the detector with its BODY_25 model",
        )
    if values[1] < 1 or values[1] != int(values[1]):
        raise stream.refuse(1, f"the number of frames must be 1 or more, got {values[1]:g}", "correct it")
    return kind, int(values[1])


def _layout(stream: _Stream, kind: TextSkeleton, frame_count: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """How many candidates each joint of each frame has, and where the numbers of each block start.

    Returns `counts` (T, J) and `starts` (T, J + 1): the first x of a joint, and in the last column the
    first affinity of the frame. Each count is known only when the one before has been passed, so this is
    a loop, over blocks; everything inside the blocks is done in arrays.
    """
    values, total = stream.values, len(stream.values)
    counts, starts = [], []
    position = 2
    for frame in range(frame_count):
        frame_counts, frame_starts = [], []
        for name in kind.joints:
            if position >= total:
                raise _cut(stream, frame, f"the number of candidates of {name}", frame_count)
            n = values[position]
            if n < 0 or n != int(n):
                raise stream.refuse(
                    position,
                    f"frame {frame} must give the number of candidates of {name}, got {n:g}",
                    "a number is missing or too many before this line: write the detections again",
                )
            frame_counts.append(int(n))
            frame_starts.append(position + 1)
            position += 1 + 3 * int(n)
            if position > total:
                raise _cut(stream, frame, f"the candidates of {name}", frame_count)
        frame_starts.append(position)
        for first, second in kind.limbs:
            position += frame_counts[first] * frame_counts[second]
            if position > total:
                limb = f"{kind.joints[first]}-{kind.joints[second]}"
                raise _cut(stream, frame, f"the affinities of {limb}", frame_count)
        counts.append(frame_counts)
        starts.append(frame_starts)
    if position < total:
        raise stream.refuse(
            position,
            f"{total - position} numbers follow the last of the {frame_count} frames",
            "correct the number of frames in line 1, or write the detections again",
        )
    return np.array(counts, dtype=np.intp), np.array(starts, dtype=np.intp)


def _cut(stream: _Stream, frame: int, what: str, frame_count: int) -> InputError:
    """The file ends too early."""
    return stream.refuse(
        len(stream.values),
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
    stream: _Stream,
    rows: NDArray[np.intp],
    fractions: NDArray[np.float64],
    scores: NDArray[np.float64],
    n: NDArray[np.intp],
) -> None:
    """Refuse scores that are no scores and positions that are no parts of the picture."""
    bad = (scores < 0) | (scores > _OVERSHOOT)
    if bad.any():
        index = int(np.argmax(bad))
        raise stream.refuse(
            int(rows[index] + 2 * n[index]),
            f"a candidate's score must lie between 0 and 1, got {scores[index]:g}",
            "write the detections again: scores are the third row of each joint",
        )
    bad = np.any(np.abs(fractions) > 2, axis=1)
    if bad.any():
        index = int(np.argmax(bad))
        raise stream.refuse(
            int(rows[index]),
            f"a candidate lies at ({fractions[index, 0]:g}, {fractions[index, 1]:g}) of the picture's size",
            "divide x by width - 1 and y by height - 1",
        )
