"""The detection text of 4D Association: joint candidates of one camera, with part affinities.

Zhang et al., "4D Association Graph for Realtime Multi-person Motion Capture", CVPR 2020. The file
is a stream of numbers; docs/detection_files.md gives their order.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from shapepose_fg.core.arrays import Array, Index
from shapepose_fg.core.camera import Camera
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.greedy_matching import match_best_first
from shapepose_fg.core.skeleton import BODY_25, COCO_18, Skeleton
from shapepose_fg.core.storage.files import SMALL, text_pieces
from shapepose_fg.core.validation import is_number
from shapepose_fg.io.detection_table import BLOCK_FRAMES
from shapepose_fg.io.detections.people import OVERSHOOT
from shapepose_fg.io.detections.view_streams import ViewCandidates, ViewStream

_SPACE = " \n\t"
"""Characters at which pieces of text end, so that no number, multi-byte character or line end is
split."""
SKELETON_TYPES = (
    "SKEL19",
    "SKEL17",
    "SKEL15",
    "COCO18",
    "BODY25",
    "OPTITRACK21",
    "SHELF15",
    "MPIIHAND21",
)
"""Names of the format's skeleton types, by number."""


@dataclass(frozen=True)
class TextSkeleton:
    """The joints and limbs that are listed in a file; `skeleton` may have further (computed)
    joints.
    """

    number: int
    """Number of the skeleton in the file's first line."""
    joints: tuple[str, ...]
    """The joints with candidates in the file, in order; these are the first joints of
    `skeleton`."""
    limbs: tuple[tuple[int, int], ...]
    """The limbs with affinities in the file, in order."""
    skeleton: Skeleton
    """The skeleton of the detections that are read."""

    @property
    def limb_of(self) -> Index:
        """(J, J) index of the limb from one joint to another, -1 if there is none."""
        table = np.full((len(self.joints), len(self.joints)), -1, dtype=np.intp)
        table[tuple(np.array(self.limbs).T)] = np.arange(len(self.limbs))
        return table


_COCO_LIMBS = (
    "1-8 8-9 9-10 1-11 11-12 12-13 1-2 2-3 3-4 2-16 1-5 5-6 6-7 5-17 1-0 0-14 0-15 14-16 15-17"
)

TEXT_SKELETONS = {
    each.skeleton.name: each
    for each in (
        TextSkeleton(SKELETON_TYPES.index("BODY25"), BODY_25.joints, BODY_25.limbs, BODY_25),
        TextSkeleton(
            SKELETON_TYPES.index("COCO18"),
            COCO_18.joints[:18],
            tuple((int(a), int(b)) for a, b in (limb.split("-") for limb in _COCO_LIMBS.split())),
            COCO_18,
        ),
    )
}
"""Supported skeletons, by their names in this package."""


def _whole_words(path: Path) -> Iterator[str]:
    """Text of the file at `path` in pieces that end at white space; raises InputError as
    `files.text_pieces` does.
    """
    left = ""
    for piece in text_pieces(path):
        left += piece
        cut = 1 + max(left.rfind(space) for space in _SPACE)
        if cut == 0 and len(left) > SMALL:
            cut = len(left)
        if cut > 0:
            yield left[:cut]
            left = left[cut:]
    if left:
        yield left


class NumberStream:
    """The numbers of a file in order; only those since the last `forget` are in memory."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.first = 0
        """Number of values that were dropped from memory."""
        self.values: Array = np.zeros(0)
        """The values in memory."""
        self._pieces = _whole_words(path)
        self._most = path.stat().st_size // 2 + 1

    @property
    def known(self) -> int:
        """Number of values that have been read so far."""
        return self.first + len(self.values)

    def reaches(self, count: int) -> bool:
        """Whether the file has at least `count` values; they are then in memory."""
        if count > self._most:  # the file is too small: it need not be read to its end
            return False
        parts, known = [self.values], self.known
        while known < count and (text := next(self._pieces, None)) is not None:
            parts.append(self._numbers(text, known))
            known += len(parts[-1])
        if len(parts) > 1:
            self.values = np.concatenate(parts)
        return known >= count

    def forget(self, count: int) -> None:
        """Drop the first `count` values of the file from memory."""
        self.values, self.first = self.values[count - self.first :].copy(), count

    def refuse(self, index: int | None, problem: str, cure: str) -> InputError:
        """An error about value number `index`; None stands for a value missing at the end."""
        return InputError(f"{self.path}: line {self._line(index)}: {problem}; {cure}")

    def _numbers(self, text: str, first: int) -> Array:
        """The values of a piece of text, which must be finite; `first` is the number of values
        before it.
        """
        tokens = text.split()
        try:
            values = np.array(tokens, dtype=np.float64)
        except ValueError:
            values = np.full(1, np.nan)
        if not np.isfinite(values).all():
            bad = next(index for index, token in enumerate(tokens) if not is_number(token))
            problem = f"{tokens[bad][:20]!r} is not a finite number"
            raise self.refuse(first + bad, problem, "write the detections again")
        return values

    def _line(self, index: int | None) -> int:
        """The line, counted from 1, of a value; the last line for None or a value behind the
        last.
        """
        lines, numbers, last = 0, 0, 1
        for text in _whole_words(self.path):
            counts = [len(line.split()) for line in text.splitlines()]
            ends = numbers + np.cumsum(counts)
            if index is not None and len(ends) > 0 and index < ends[-1]:
                return lines + int(np.searchsorted(ends, index, side="right")) + 1
            numbers += sum(counts)
            last = lines + max(len(counts), 1)
            # A line that continues in the next piece is not counted as complete.
            lines += len((text + "|").splitlines()) - 1
        return last


def read_association_text(path: Path, camera: Camera) -> ViewStream:
    """Read the candidates of `camera` and their skeleton from the file at `path`; midpoints are
    computed.

    Only the header is read at once; the rest is read with the stream's blocks. InputError naming
    file, line, frame and cure.
    """
    numbers = NumberStream(path)
    kind, frame_count = _header(numbers)
    blocks = _blocks(numbers, kind, frame_count, camera)
    return ViewStream(path, frame_count, blocks, skeleton=kind.skeleton)


def _blocks(
    numbers: NumberStream, kind: TextSkeleton, frame_count: int, camera: Camera
) -> Iterator[ViewCandidates]:
    """The candidates in blocks of frames."""
    position = 2
    for start in range(0, frame_count, BLOCK_FRAMES):
        numbers.forget(position)
        frames = range(start, min(start + BLOCK_FRAMES, frame_count))
        counts, starts, position = _layout(numbers, kind, frames, frame_count, position)
        view = _candidates(numbers, kind, counts, starts - numbers.first, start, camera)
        yield with_middles(view, kind.skeleton) if kind.skeleton.middles else view
    if numbers.reaches(position + 1):
        what = f"there are more numbers after the last of the {frame_count} frames"
        raise numbers.refuse(
            position, what, "correct the number of frames in line 1, or write it again"
        )


def _candidates(
    numbers: NumberStream,
    kind: TextSkeleton,
    counts: Index,
    starts: Index,
    start: int,
    camera: Camera,
) -> ViewCandidates:
    """The candidates of the frames from `start` on; `starts` are indices into `numbers.values`."""
    block, within = _expand(counts.ravel())
    frame, joint = np.divmod(block, counts.shape[1])
    rows, values = starts[:, :-1].ravel()[block] + within, numbers.values  # rows of x
    n = counts[frame, joint]
    fractions, scores = np.column_stack([values[rows], values[rows + n]]), values[rows + 2 * n]
    bad = (scores < 0) | (scores > OVERSHOOT)
    if bad.any():
        index = int(np.argmax(bad))
        raise numbers.refuse(
            numbers.first + int(rows[index] + 2 * n[index]),
            f"a candidate's score must lie between 0 and 1, got {scores[index]:g}",
            "write the detections again; scores are the third row of each joint",
        )
    bad = np.any(np.abs(fractions) > 2, axis=1)
    if bad.any():
        index = int(np.argmax(bad))
        raise numbers.refuse(
            numbers.first + int(rows[index]),
            (
                f"a candidate is at ({fractions[index, 0]:g}, {fractions[index, 1]:g}) of the "
                "picture's size"
            ),
            "divide x by width - 1 and y by height - 1",
        )
    xy = fractions * (np.array(camera.image_size) - 1.0)
    pairs, affinity = _pairs(values, kind, counts, starts)
    return ViewCandidates.of(start + frame, joint, xy, np.minimum(scores, 1.0), pairs, affinity)


def _header(numbers: NumberStream) -> tuple[TextSkeleton, int]:
    """The skeleton, which must be supported, and the number of frames."""
    if not numbers.reaches(2):
        raise numbers.refuse(
            0, "the first line must hold skeleton type and number of frames", "write both"
        )
    number, frame_count = numbers.values[:2]
    kind = next((each for each in TEXT_SKELETONS.values() if each.number == number), None)
    if kind is None:
        known = f" ({SKELETON_TYPES[int(number)]})" if number in range(len(SKELETON_TYPES)) else ""
        raise numbers.refuse(
            0,
            f"skeleton type {number:g}{known} is not supported, only 4 (BODY_25) and 3 (COCO_18)",
            "run the detector with its BODY_25 model",
        )
    if frame_count < 1 or frame_count != int(frame_count):
        raise numbers.refuse(
            1, f"the number of frames must be 1 or more, got {frame_count:g}", "correct it"
        )
    return kind, int(frame_count)


def _layout(
    numbers: NumberStream, kind: TextSkeleton, frames: range, frame_count: int, position: int
) -> tuple[Index, Index, int]:
    """The number of candidates of each joint in each frame, and the positions of their values.

    Returns `counts` (T, J); `starts` (T, J + 1), the positions of the first x of each joint and, in
    the last column, of the first affinity of the frame; and the position of the next frame.
    `position` is that of the first frame. Each count is known only after the block before it has
    been skipped, hence a loop over blocks; within blocks the work is vectorised.
    """

    def reach(count: int, what: str) -> None:
        if not numbers.reaches(count):
            problem = f"the file ends in frame {frame} of {frame_count}, where {what} should be"
            raise numbers.refuse(None, problem, "copy or write the whole file again")

    known, counts, starts = numbers.known, [], []
    for frame in frames:
        frame_counts, frame_starts = [], []
        for name in kind.joints:
            if position >= known:
                reach(position + 1, f"the number of candidates of {name}")
                known = numbers.known
            n = numbers.values[position - numbers.first]
            if n < 0 or n != int(n):
                raise numbers.refuse(
                    position,
                    f"frame {frame} must give the number of candidates of {name}, got {n:g}",
                    (
                        "there is a number too few or too many before this line; write the "
                        "detections again"
                    ),
                )
            frame_counts.append(int(n))
            frame_starts.append(position + 1)
            position += 1 + 3 * int(n)
            if position > known:
                reach(position, f"the candidates of {name}")
                known = numbers.known
        frame_starts.append(position)
        for first, second in kind.limbs:
            position += frame_counts[first] * frame_counts[second]
            if position > known:
                reach(position, f"the affinities of {kind.joints[first]}-{kind.joints[second]}")
                known = numbers.known
        counts.append(frame_counts)
        starts.append(frame_starts)
    return np.array(counts, dtype=np.intp), np.array(starts, dtype=np.intp), position


def _pairs(values: Array, kind: TextSkeleton, counts: Index, starts: Index) -> tuple[Index, Array]:
    """The pairs of candidates (E, 2) with a positive affinity, and these affinities (E,)."""
    first, second = np.array(kind.limbs).T
    sizes = counts[:, first] * counts[:, second]  # (T, L)
    block_start = starts[:, -1:] + np.cumsum(sizes, axis=1) - sizes
    block, within = _expand(sizes.ravel())
    affinity = values[block_start.ravel()[block] + within]
    used = affinity > 0
    block, within = block[used], within[used]
    row, column = np.divmod(
        within, counts[:, second].ravel()[block]
    )  # matrices are (A, B), row by row
    candidate_start = (np.cumsum(counts) - counts.ravel()).reshape(counts.shape)
    a = candidate_start[:, first].ravel()[block] + row
    b = candidate_start[:, second].ravel()[block] + column
    return np.column_stack([a, b]), affinity[used]


def _expand(sizes: Index) -> tuple[Index, Index]:
    """For every element of blocks with the given sizes: the number of its block, and its index in
    the block.
    """
    block = np.repeat(np.arange(len(sizes)), sizes)
    return block, np.arange(len(block)) - (np.cumsum(sizes) - sizes)[block]


def with_middles(view: ViewCandidates, skeleton: Skeleton) -> ViewCandidates:
    """Convert `view` from the joints of a file to the whole `skeleton`, with computed midpoints.

    A midpoint is computed for two candidates (hips) that are linked to a common neighbour (the
    neck) by affinity. Each candidate is used for one midpoint at most; pairs are processed in
    decreasing order of the smaller of their two affinities to the neighbour. A midpoint has the
    lower confidence of its two candidates, affinity 1 to both, and to every neighbour that is
    linked to both, the mean of their affinities. Pairs that are not a limb of the skeleton are left
    out.
    """
    for middle, first, second in skeleton.middles:
        view = _with_middle(view, middle, first, second)
    order = np.lexsort((view.seen.joint, view.frame))
    seen = view.seen.rows(order)
    known = np.zeros((len(skeleton), len(skeleton)), dtype=bool)
    known[tuple(np.array(skeleton.limbs).T)] = True
    present = np.flatnonzero(known[tuple(seen.joint[seen.pairs].T)])
    present = present[np.argsort(seen.pairs[present, 0], kind="stable")]
    return ViewCandidates(
        view.frame[order], replace(seen, pairs=seen.pairs[present], affinity=seen.affinity[present])
    )


def _with_middle(view: ViewCandidates, middle: int, first: int, second: int) -> ViewCandidates:
    """`view` with candidates of the joint `middle`, the midpoint of `first` and `second`,
    appended.
    """
    frame, seen = view.frame, view.seen
    one, other = seen.joint[seen.pairs].T
    to_first, to_second = (
        np.flatnonzero(np.asarray(other == end) & (one != middle)) for end in (first, second)
    )
    # Links of a neighbour to one end, combined with its links to the other end.
    left, right = _equal_pairs(seen.pairs[to_first, 0], seen.pairs[to_second, 0])
    left, right = to_first[left], to_second[right]
    neighbour, a, b = seen.pairs[left, 0], seen.pairs[left, 1], seen.pairs[right, 1]
    lesser = np.minimum(seen.affinity[left], seen.affinity[right])
    picked = match_best_first(a, b, lesser)
    picked = picked[np.argsort(a[picked], kind="stable")]
    a_made, b_made = a[picked], b[picked]
    made = len(frame) + np.arange(len(picked))
    # Other candidates that are linked to both ends of a midpoint.
    made_at = np.full(len(frame), -1, dtype=np.intp)
    made_at[a_made] = np.arange(len(picked))
    linked = np.flatnonzero(np.append(b_made, -1)[made_at[a]] == b)
    starts = np.concatenate([made, made, neighbour[linked]])
    ends = np.concatenate([a_made, b_made, made[made_at[a[linked]]]])
    means = (seen.affinity[left] + seen.affinity[right])[linked] / 2
    return ViewCandidates.of(
        np.concatenate([frame, frame[a_made]]),
        np.concatenate([seen.joint, np.full(len(made), middle)]),
        np.concatenate([seen.xy, (seen.xy[a_made] + seen.xy[b_made]) / 2]),
        np.concatenate(
            [seen.confidence, np.minimum(seen.confidence[a_made], seen.confidence[b_made])]
        ),
        np.concatenate([seen.pairs, np.column_stack([starts, ends])]),
        np.concatenate([seen.affinity, np.ones(2 * len(made)), means]),
    )


def _equal_pairs(left: Index, right: Index) -> tuple[Index, Index]:
    """All pairs of indices i into `left` and k into `right` with equal values, as two arrays."""
    order = np.argsort(right, kind="stable")
    low, high = (np.searchsorted(right[order], left, side=side) for side in ("left", "right"))
    i, within = _expand(high - low)
    return i, order[low[i] + within]
