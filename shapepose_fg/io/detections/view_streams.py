"""What one camera saw, block by block, and the blocks of all cameras put together as a table of the recording."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.camera import Camera, Rig
from shapepose_fg.core.detections import Detections
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.skeleton import Skeleton
from shapepose_fg.core.storage.kept_arrays import InMemory, KeptArrays
from shapepose_fg.io.detection_table import BLOCK_FRAMES, DetectionTable, keep_block

MARGIN = 0.25
"""How far outside the picture a detector may place a joint, as a part of the picture's size."""
_STRAY = 0.01
"""Up to this share of a camera's joints may have no place in its picture: they are left out, and it is said. More
are detections of other pictures, or another camera's calibration."""
_LEAST_SCORE = 1e-6
"""Below this a detector says that it saw nothing; products of such scores are 0."""


@dataclass(frozen=True)
class ViewCandidates:
    """All candidates that one camera saw in some frames, sorted by frame and then by joint."""

    frame: NDArray[np.intp]
    """(D,) frame of each candidate, from 0."""
    joint: NDArray[np.intp]
    """(D,) joint of each candidate."""
    xy: NDArray[np.float64]
    """(D, 2) position, pixels."""
    confidence: NDArray[np.float64]
    """(D,) the detector's score, 0 to 1."""
    pairs: NDArray[np.intp]
    """(E, 2) candidates (rows of this table) that a limb joins, both in one frame; sorted by frame."""
    affinity: NDArray[np.float64]
    """(E,) how well the image supports the pair."""


@dataclass(frozen=True)
class ViewStream:
    """All candidates that one camera saw in a recording, in blocks of `BLOCK_FRAMES` frames."""

    source: Path
    """The file or folder that they come from, for messages."""
    frame_count: int
    """T, frames that the source holds, seen or empty."""
    blocks: Iterator[ViewCandidates]
    """The blocks in order, each read when it is asked for; the last may have fewer frames."""
    first_number: int = 0
    """What the source itself calls its first frame."""
    skeleton: Skeleton | None = None
    """Whose joints the candidates are, where the source says it."""


def assemble(
    views: Sequence[ViewStream], rig: Rig, skeleton: Skeleton, kept: KeptArrays | None = None
) -> DetectionTable:
    """Put the views of a recording together, one `ViewStream` per camera of `rig`, undistorted; held by `kept`.

    Raises InputError where the views hold different numbers of frames or do not fit their pictures.
    """
    _refuse_different(views)
    kept = InMemory() if kept is None else kept
    ideal = [_Undistorted(view.source, camera) for view, camera in zip(views, rig.cameras, strict=True)]
    for n, blocks in enumerate(zip(*(view.blocks for view in views), strict=True)):
        seen = [each.undistorted(block) for each, block in zip(ideal, blocks, strict=True)]
        stop = min((n + 1) * BLOCK_FRAMES, views[0].frame_count)
        keep_block(kept, n, *_together(seen, range(n * BLOCK_FRAMES, stop)))
    notes = tuple(note for each in ideal for note in each.notes())
    return DetectionTable(skeleton, kept, views[0].frame_count, tuple(view.source for view in views), notes)


def _refuse_different(views: Sequence[ViewStream]) -> None:
    """InputError where views hold other frames; what is wrong with their files goes first."""
    first = views[0]
    for view in views[1:]:
        if (view.frame_count, view.first_number) == (first.frame_count, first.first_number):
            continue
        for each in views:
            for _ in each.blocks:
                pass
        what = f"holds {view.frame_count} frames", f"holds {first.frame_count}"
        if view.frame_count == first.frame_count:
            what = f"starts at frame {view.first_number}", f"starts at frame {first.first_number}"
        raise InputError(
            f"{view.source} {what[0]}, but {first.source} {what[1]}; give the same frames of every camera"
        )


def _together(
    views: Sequence[ViewCandidates], frames: range
) -> tuple[Detections, NDArray[np.intp], NDArray[np.intp]]:
    """The candidates of all views in some frames, and (T + 1,) where candidates and pairs of each frame begin."""
    counts = [len(view.frame) for view in views]
    frame = np.concatenate([view.frame for view in views])
    # Views come in order and each is sorted by frame: a stable sort leaves (frame, view, joint).
    order = np.argsort(frame, kind="stable")
    new_row = np.empty_like(order)
    new_row[order] = np.arange(len(order))
    offsets = np.cumsum([0, *counts[:-1]])
    pairs = np.concatenate([view.pairs + offset for view, offset in zip(views, offsets, strict=True)])
    pair_frame = frame[pairs[:, 0]]
    pair_order = np.argsort(pair_frame, kind="stable")
    edges = np.arange(frames.start, frames.stop + 1)
    candidate_start = np.searchsorted(frame[order], edges)
    first = candidate_start[pair_frame[pair_order] - frames.start]
    candidates = Detections(
        view=np.repeat(np.arange(len(views)), counts)[order],
        joint=np.concatenate([view.joint for view in views])[order],
        xy=np.concatenate([view.xy for view in views])[order],
        confidence=np.concatenate([view.confidence for view in views])[order],
        pairs=new_row[pairs[pair_order]] - first[:, None],
        affinity=np.concatenate([view.affinity for view in views])[pair_order],
    )
    return candidates, candidate_start, np.searchsorted(pair_frame[pair_order], edges)


class _LeftOut:
    """Candidates of a camera that were left out for one reason."""

    def __init__(self, cure: str) -> None:
        self._cure, self._count, self._of, self._first = cure, 0, 0, ""

    def add(self, out: NDArray[np.bool_], words: Callable[[int], str]) -> None:
        """Take in which candidates (D,) of a block are left out; `words` say where one of them is."""
        if self._count == 0 and out.any():
            self._first = words(int(np.argmax(out)))
        self._count += int(out.sum())
        self._of += len(out)

    def note(self, what: str) -> list[str]:
        """A sentence, if there were some; InputError where there are so many that it cannot be by chance."""
        if self._count > _STRAY * self._of:
            raise InputError(f"{self._first}; {self._cure}")
        return [f"{self._first}; {self._count} {what} of {self._of} were left out"] if self._count > 0 else []


class _Undistorted:
    """One camera's candidates with the pixels of a camera without distortion, and those that were left out."""

    def __init__(self, source: Path, camera: Camera) -> None:
        self.source, self.camera = source, camera
        self._outside = _LeftOut("give detections made on pictures of the calibrated size")
        self._undone = _LeftOut("check the distortion coefficients in the calibration")

    def undistorted(self, view: ViewCandidates) -> ViewCandidates:
        """A block."""
        size = np.array(self.camera.image_size, dtype=np.float64)
        outside = np.any((view.xy < -MARGIN * size) | (view.xy > (1 + MARGIN) * size), axis=1)
        self._outside.add(
            outside,
            lambda row: (
                f"{self.source}: frame {view.frame[row]} has a joint at pixel ({view.xy[row, 0]:.0f},"
                f" {view.xy[row, 1]:.0f}), far outside the {self.camera.image_size[0]} x"
                f" {self.camera.image_size[1]} picture of the calibration"
            ),
        )
        certain = view.confidence >= _LEAST_SCORE
        seen = _only(view, ~outside & certain)
        xy = self.camera.undistort(seen.xy)
        undone = np.asarray(~np.isfinite(xy).all(axis=1))
        self._undone.add(
            undone,
            lambda row: (
                f"{self.source}: the distortion of camera {self.camera.name} cannot be undone"
                f" at frame {seen.frame[row]}"
            ),
        )
        return _only(replace(seen, xy=xy), ~undone)

    def notes(self) -> list[str]:
        """Sentences about candidates that were left out; InputError where the calibration must be another's."""
        return self._outside.note("such joints") + self._undone.note("joints")


def _only(view: ViewCandidates, keep: NDArray[np.bool_]) -> ViewCandidates:
    """The candidates of the mask `keep` (D,), and the pairs between them."""
    if keep.all():
        return view
    place = np.cumsum(keep) - 1
    both = keep[view.pairs].all(axis=1)
    rows = (view.frame[keep], view.joint[keep], view.xy[keep], view.confidence[keep])
    return ViewCandidates(*rows, place[view.pairs[both]], view.affinity[both])
