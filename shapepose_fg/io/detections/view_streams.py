"""What one camera saw, block by block, and the blocks of all cameras put together as a table of the recording."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
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
        if view.frame_count == first.frame_count and view.first_number == first.first_number:
            continue
        for each in views:
            for _ in each.blocks:
                pass
        if view.frame_count != first.frame_count:
            raise InputError(
                f"{view.source} holds {view.frame_count} frames, but {first.source} holds"
                f" {first.frame_count}; give the same frames of every camera"
            )
        raise InputError(
            f"{view.source} starts at frame {view.first_number}, but {first.source} starts at frame"
            f" {first.first_number}; give the same frames of every camera"
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


@dataclass
class _Left:
    """Candidates of a camera that were left out for one reason."""

    count: int = 0
    """How many."""
    of: int = 0
    """Of how many."""
    first: str = ""
    """Where the first of them is, in words."""

    @property
    def too_many(self) -> bool:
        """Whether it cannot be by chance."""
        return self.count > _STRAY * self.of


@dataclass
class _Undistorted:
    """One camera's candidates with the pixels of a camera without distortion, and those that were left out."""

    source: Path
    camera: Camera
    outside: _Left = field(default_factory=_Left)
    """Those far outside the picture."""
    undone: _Left = field(default_factory=_Left)
    """Those whose distortion cannot be undone."""

    def undistorted(self, view: ViewCandidates) -> ViewCandidates:
        """A block."""
        size = np.array(self.camera.image_size, dtype=np.float64)
        outside = np.any((view.xy < -MARGIN * size) | (view.xy > (1 + MARGIN) * size), axis=1)
        self.outside.of += len(outside)
        if outside.any():
            if self.outside.count == 0:
                row = int(np.argmax(outside))
                x, y = view.xy[row]
                self.outside.first = (
                    f"{self.source}: frame {view.frame[row]} has a joint at pixel ({x:.0f}, {y:.0f}), far outside"
                    f" the {self.camera.image_size[0]} x {self.camera.image_size[1]} picture of the calibration"
                )
            self.outside.count += int(outside.sum())
            view = _only(view, ~outside)
        certain = view.confidence >= _LEAST_SCORE
        if not certain.all():
            view = _only(view, certain)
        xy = self.camera.undistort(view.xy)
        undone = np.asarray(np.isfinite(xy).all(axis=1))
        self.undone.of += len(undone)
        if not undone.all():
            if self.undone.count == 0:
                self.undone.first = (
                    f"{self.source}: the distortion of camera {self.camera.name} cannot be undone at frame"
                    f" {view.frame[int(np.argmin(undone))]}"
                )
            self.undone.count += int((~undone).sum())
            view, xy = _only(view, undone), xy[undone]
        return replace(view, xy=xy)

    def notes(self) -> list[str]:
        """Sentences about candidates that were left out.

        InputError where so many have no place that the calibration must be another's.
        """
        notes, outside, undone = [], self.outside, self.undone
        if outside.count > 0:
            if outside.too_many:
                raise InputError(f"{outside.first}; give detections made on pictures of the calibrated size")
            notes.append(f"{outside.first}; {outside.count} such joints of {outside.of} were left out")
        if undone.count > 0:
            if undone.too_many:
                raise InputError(f"{undone.first}; check the distortion coefficients in the calibration")
            notes.append(f"{undone.first}; {undone.count} joints of {undone.of} were left out")
        return notes


def _only(view: ViewCandidates, keep: NDArray[np.bool_]) -> ViewCandidates:
    """The candidates of the mask `keep` (D,), and the pairs between them."""
    place = np.cumsum(keep) - 1
    both = keep[view.pairs].all(axis=1)
    return ViewCandidates(
        frame=view.frame[keep],
        joint=view.joint[keep],
        xy=view.xy[keep],
        confidence=view.confidence[keep],
        pairs=place[view.pairs[both]],
        affinity=view.affinity[both],
    )
