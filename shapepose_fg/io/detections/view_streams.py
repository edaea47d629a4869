"""Detections of one camera in blocks of frames, and their combination to a table of all cameras."""

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np

from shapepose_fg.core.arrays import Array, Index, Mask
from shapepose_fg.core.camera import Camera, Rig
from shapepose_fg.core.detections import Detections
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.skeleton import Skeleton
from shapepose_fg.core.storage.kept_arrays import KeptArrays
from shapepose_fg.io.detection_table import BLOCK_FRAMES, DetectionTable, keep_block

MARGIN = 0.25
"""Maximum distance of a joint outside the picture, as a share of the picture's size."""


@dataclass(frozen=True)
class ViewCandidates:
    """All candidates of one camera in some frames, sorted by frame and then by joint."""

    frame: Index
    """(D,) frame of each candidate, counted from 0."""
    seen: Detections
    """The candidates, with view 0 and distorted pixels as detected; pairs are within a frame."""

    @classmethod
    def of(
        cls, frame: Index, joint: Index, xy: Array, confidence: Array, pairs: Index, affinity: Array
    ) -> "ViewCandidates":
        """Make candidates from columns as in `Detections`."""
        return cls(frame, Detections(np.zeros_like(joint), joint, xy, confidence, pairs, affinity))

    def only(self, keep: Mask) -> "ViewCandidates":
        """The candidates selected by the mask `keep` (D,), and the pairs between them."""
        return self if keep.all() else ViewCandidates(self.frame[keep], self.seen.only(keep))


_NOTHING = ViewCandidates(Detections.empty().view, Detections.empty())


@dataclass(frozen=True)
class ViewStream:
    """All candidates of one camera in a recording, in blocks of `BLOCK_FRAMES` frames."""

    source: Path
    """The file or folder, for messages."""
    frame_count: int
    """T, number of frames in the source, including those without people."""
    blocks: Iterator[ViewCandidates]
    """The blocks in order, read one by one; the last may have fewer frames."""
    first_number: int = 0
    """Number of the first frame in the source."""
    skeleton: Skeleton | None = None
    """Skeleton of the candidates, if the source defines it."""


def assemble(
    views: Sequence[ViewStream],
    rig: Rig,
    skeleton: Skeleton,
    kept: KeptArrays,
    own_frames: bool = False,
) -> DetectionTable:
    """Combine the views of a recording, one `ViewStream` per camera of `rig`, undistorted; stored
    in `kept`.

    If they have different frames, the common ones are used, with a note; with `own_frames` all are
    used, and missing ones are empty. InputError if there are none, or if the detections do not fit
    the size of the pictures.
    """
    views, count, frame_notes = _aligned(views, own_frames)
    ideal = [
        _Undistorted(view.source, camera) for view, camera in zip(views, rig.cameras, strict=True)
    ]
    for n, blocks in enumerate(zip_longest(*(view.blocks for view in views), fillvalue=_NOTHING)):
        seen = [each.undistorted(block) for each, block in zip(ideal, blocks, strict=True)]
        stop = min((n + 1) * BLOCK_FRAMES, count)
        keep_block(kept, n, *_together(seen, range(n * BLOCK_FRAMES, stop)))
    notes = tuple(note for each in ideal for reason in each.reasons for note in reason.note())
    table = DetectionTable(
        skeleton, kept, count, tuple(view.source for view in views), (*frame_notes, *notes)
    )
    if all(view.frame_count == count for view in views):
        return table
    frame = np.arange(count)
    has = [np.where(frame < view.frame_count, frame, -1) for view in views]
    return replace(table, picture=np.column_stack(has))


def _aligned(
    views: Sequence[ViewStream], own_frames: bool
) -> tuple[Sequence[ViewStream], int, list[str]]:
    """Restrict all views to their common frames, or with `own_frames` extend them to all frames;
    returns the views, the number of frames, and a note if frames differ.
    """
    starts, stops = zip(
        *((each.first_number, each.first_number + each.frame_count) for each in views), strict=True
    )
    start, stop = (min(starts), max(stops)) if own_frames else (max(starts), min(stops))
    if {*starts} == {start} and (own_frames or {*stops} == {stop}):
        return views, stop - start, []
    spans, folder = _spans(views), views[0].source.parent
    if start >= stop:
        for view in views:  # errors in the files are reported first
            for _ in view.blocks:
                pass
        cure = "give the same frames of each camera with the same numbers"
        raise InputError(f"{folder}: no frame exists for all cameras ({spans}); {cure}")
    note = f"{folder}: frame 0 has number {start} in the files ({spans})"
    if not own_frames:
        note = (
            f"{folder}: cameras have different frames ({spans}); the {stop - start} common ones, "
            f"{start} to {stop - 1}, are used; if the cameras are unsynchronised, run "
            "`shapepose-fg synchronise`"
        )
    return (
        [_part(view, start - view.first_number, stop - start) for view in views],
        stop - start,
        [note],
    )


def _spans(views: Sequence[ViewStream]) -> str:
    """The frames of each view, in words."""
    words = ", ".join(f"{view.source.name} {_span_words(view)}" for view in views[:12])
    return words + (f" and {len(views) - 12} more" if len(views) > 12 else "")


def _span_words(view: ViewStream) -> str:
    """The number of a view's frames, and their numbers, in words."""
    if view.frame_count == 0:
        return "has none"
    return (
        f"has {view.frame_count}, {view.first_number} to {view.first_number + view.frame_count - 1}"
    )


def _part(view: ViewStream, lead: int, count: int) -> ViewStream:
    """The `count` frames of a view after its first `lead` ones. If `lead` is negative, `-lead`
    empty frames come first. All blocks of the view are read.
    """
    shifted = (replace(block, frame=block.frame - lead) for block in view.blocks)
    inside = (each.only((each.frame >= 0) & (each.frame < count)) for each in shifted)
    blocks = in_blocks(inside, count, _joined, ViewCandidates.only, _NOTHING)
    return replace(view, frame_count=count, first_number=view.first_number + lead, blocks=blocks)


def in_blocks(
    given: Iterator[Any],
    count: int,
    joined: Callable[[list[Any]], Any],
    only: Callable[[Any, Mask], Any],
    nothing: Any,
) -> Iterator[Any]:
    """Rows of `count` frames, sorted by their `frame` (N,), in blocks of `BLOCK_FRAMES` frames.

    They are `given` in blocks of any length, all of which are read; `joined` and `only` join blocks
    and select rows by a mask, and `nothing` is a block without rows.
    """
    waiting = nothing
    for end in range(BLOCK_FRAMES, count + BLOCK_FRAMES, BLOCK_FRAMES):
        parts = [waiting]
        while not np.any(parts[-1].frame[-1:] >= end) and (part := next(given, None)) is not None:
            parts.append(part)
        every = joined(parts)
        yield only(every, every.frame < end)
        waiting = only(every, every.frame >= end)
    deque(given, maxlen=0)


def _joined(parts: Sequence[ViewCandidates]) -> ViewCandidates:
    """Concatenate candidates of one view."""
    frame = np.concatenate([part.frame for part in parts])
    return ViewCandidates(frame, Detections.joined([part.seen for part in parts]))


def _together(views: Sequence[ViewCandidates], frames: range) -> tuple[Detections, Index, Index]:
    """The candidates of all views in some frames, and the offsets (T + 1,) of candidates and pairs
    of each frame.
    """
    parts = [replace(view.seen, view=np.full(len(view.frame), n)) for n, view in enumerate(views)]
    every, frame = Detections.joined(parts), np.concatenate([view.frame for view in views])
    # Views are in order and each is sorted by frame: a stable sort yields (frame, view, joint).
    order = np.argsort(frame, kind="stable")
    frame, every = frame[order], every.rows(order)
    pair_frame = frame[every.pairs[:, 0]]
    pair_order = np.argsort(pair_frame, kind="stable")
    edges = np.arange(frames.start, frames.stop + 1)
    start, pair_frame = np.searchsorted(frame, edges), pair_frame[pair_order]
    pairs = every.pairs[pair_order] - start[pair_frame - frames.start][:, None]
    every = replace(every, pairs=pairs, affinity=every.affinity[pair_order])
    return every, start, np.searchsorted(pair_frame, edges)


def in_moments(recording: DetectionTable, picture: Index, kept: KeptArrays) -> DetectionTable:
    """Regroup a recording to synchronised frame sets: view v of frame t is its own frame `picture`
    (T, V)[t, v]; -1 for none.

    Stored in `kept`.
    """
    count, views = picture.shape
    for n, begin in enumerate(range(0, count, BLOCK_FRAMES)):
        frames = range(begin, min(begin + BLOCK_FRAMES, count))
        # View by view, so that few blocks of the recording are in memory.
        seen = [_frames_of(recording, view, picture[frames, view], begin) for view in range(views)]
        keep_block(kept, n, *_together(seen, frames))
    return replace(recording, kept=kept, frame_count=count, first=0, picture=picture)


def _frames_of(recording: DetectionTable, view: int, picture: Index, begin: int) -> ViewCandidates:
    """Candidates of a view in the frames `picture`, renumbered from `begin` on; -1 for none."""
    present = np.flatnonzero(picture >= 0)
    every = [recording[frame] for frame in picture[present].tolist()]
    parts = [each.only(each.view == view) for each in every]
    frames = [
        np.full(len(part), begin + frame)
        for part, frame in zip(parts, present.tolist(), strict=True)
    ]
    return _joined([_NOTHING, *map(ViewCandidates, frames, parts)])


class _LeftOut:
    """Counts the candidates of a camera that are left out for one reason."""

    def __init__(self, cure: str, most: float) -> None:
        self._cure, self._most = cure, most
        self._count, self._of, self._first = 0, 0, ""

    def add(self, out: Mask, words: Callable[[int], str]) -> None:
        """Count the candidates `out` (D,) of a block; `words` describes one of them."""
        if self._count == 0 and out.any():
            self._first = words(int(np.argmax(out)))
        self._count += int(out.sum())
        self._of += len(out)

    def note(self) -> list[str]:
        """A sentence, if any were left out; InputError if there are too many."""
        joints = "joint" if self._count == 1 else "joints"
        share = f"{self._count} {joints} of {self._of} ({self._count / max(self._of, 1):.1%})"
        if self._count > self._most * self._of:
            raise InputError(f"{self._first}; this holds for {share} of this camera; {self._cure}")
        return [f"{self._first}; {share} left out"] if self._count else []


class _Undistorted:
    """Undistorts the candidates of one camera, and counts those that are left out."""

    def __init__(self, source: Path | str, camera: Camera) -> None:
        self.source, self.camera = source, camera
        # Maximum share of a camera's joints far outside its picture; these are left out, with a
        # note. A larger share means that the detections belong to other pictures.
        # Maximum share of a camera's joints at which its distortion cannot be inverted, as in the
        # corners of wide lenses. A larger share means that the coefficients are wrong.
        self.reasons = (
            _LeftOut("give detections from pictures of the calibrated size", 0.05),
            _LeftOut("check the distortion coefficients in the calibration", 0.5),
        )

    def undistorted(self, view: ViewCandidates) -> ViewCandidates:
        """Undistort a block."""
        camera, (width, height), xy = self.camera, self.camera.image_size, view.seen.xy
        size = np.array([width, height], dtype=np.float64)
        outside = np.any((xy < -MARGIN * size) | (xy > (1 + MARGIN) * size), axis=1)
        why = f"far outside the {width} x {height} picture of the calibration"
        self.reasons[0].add(outside, partial(self._words, view, why))
        # Score below which a joint counts as not detected; products of smaller scores
        # underflow.
        certain = view.only(~outside & (view.seen.confidence >= 1e-6))
        straight = camera.undistort(certain.seen.xy)
        undone = np.asarray(~np.isfinite(straight).all(axis=1))
        why = f"where the distortion of camera {camera.name} cannot be inverted"
        self.reasons[1].add(undone, partial(self._words, certain, why))
        return replace(certain, seen=replace(certain.seen, xy=straight)).only(~undone)

    def _words(self, view: ViewCandidates, why: str, row: int) -> str:
        """Text that identifies one left-out candidate of a block, with the reason."""
        x, y = view.seen.xy[row]
        return (
            f"{self.source}: frame {view.frame[row]} has a joint at pixel ({x:.0f}, {y:.0f}), {why}"
        )


def undistorted(view: ViewCandidates, source: Path | str, camera: Camera) -> ViewCandidates:
    """Undistorted detections of one camera; joints whose distortion cannot be inverted are left
    out.
    """
    return _Undistorted(source, camera).undistorted(view)
