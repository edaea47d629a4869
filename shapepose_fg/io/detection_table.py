"""A whole recording of 2D candidates in flat arrays; a frame of it is a slice."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.camera import Camera, Rig
from shapepose_fg.detections import Detections
from shapepose_fg.errors import InputError
from shapepose_fg.skeleton import Skeleton

MARGIN = 0.25
"""How far outside the picture a detector may place a joint, as a part of the picture's size."""
_STRAY = 0.01
"""Up to this share of a camera's joints may have no place in its picture: they are left out, and it is said. More
are detections of other pictures, or another camera's calibration."""


_LEAST_SCORE = 1e-6
"""Below this a detector says that it saw nothing; products of such scores are 0."""


@dataclass(frozen=True)
class ViewCandidates:
    """All candidates that one camera saw in a recording, sorted by frame and then by joint."""

    source: Path
    """The file or folder that they come from, for messages."""
    frame_count: int
    """T, frames that the source holds, seen or empty."""
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
    first_number: int = 0
    """What the source itself calls its first frame."""


@dataclass(frozen=True)
class DetectionTable:
    """The candidates of all views and frames; `table[frame]` is that frame's `Detections`.

    Within a frame, candidates are sorted by view, then by joint, then as the detector listed them. A
    frame's arrays are views into the table: no copy is made.
    """

    skeleton: Skeleton
    """The detector's joints."""
    candidates: Detections
    """Of all frames, one after the other; `pairs` count from the first candidate of their own frame."""
    candidate_start: NDArray[np.intp]
    """(T + 1,) where each frame's candidates begin."""
    pair_start: NDArray[np.intp]
    """(T + 1,) where each frame's pairs begin."""
    sources: tuple[Path, ...] = ()
    """The file or folder that each view was read from."""
    notes: tuple[str, ...] = ()
    """What the reader made of the files and left out, a sentence each."""

    def __len__(self) -> int:
        return len(self.candidate_start) - 1

    def __getitem__(self, frame: int, /) -> Detections:
        if not -len(self) <= frame < len(self):
            raise IndexError(f"frame {frame} is not among the {len(self)} frames")
        frame %= len(self)
        rows = slice(self.candidate_start[frame], self.candidate_start[frame + 1])
        links = slice(self.pair_start[frame], self.pair_start[frame + 1])
        every = self.candidates
        return Detections(
            every.view[rows],
            every.joint[rows],
            every.xy[rows],
            every.confidence[rows],
            every.pairs[links],
            every.affinity[links],
        )

    def __iter__(self) -> Iterator[Detections]:
        return (self[frame] for frame in range(len(self)))


def assemble(views: Sequence[ViewCandidates], rig: Rig, skeleton: Skeleton) -> DetectionTable:
    """Put the views of a recording together, one `ViewCandidates` per camera of `rig`, undistorted.

    Raises InputError where the views hold different numbers of frames or do not fit their pictures.
    """
    for view in views[1:]:
        if view.frame_count != views[0].frame_count:
            raise InputError(
                f"{view.source} holds {view.frame_count} frames, but {views[0].source} holds"
                f" {views[0].frame_count}; give the same frames of every camera"
            )
        if view.first_number != views[0].first_number:
            raise InputError(
                f"{view.source} starts at frame {view.first_number}, but {views[0].source} starts at frame"
                f" {views[0].first_number}; give the same frames of every camera"
            )
    read = [_undistorted(view, camera) for view, camera in zip(views, rig.cameras, strict=True)]
    ideal = [view for view, _ in read]
    counts = [len(view.frame) for view in ideal]
    frame = np.concatenate([view.frame for view in ideal])
    # Views come in order and each is sorted by frame: a stable sort leaves (frame, view, joint).
    order = np.argsort(frame, kind="stable")
    new_row = np.empty_like(order)
    new_row[order] = np.arange(len(order))
    offsets = np.cumsum([0, *counts[:-1]])
    pairs = np.concatenate([view.pairs + offset for view, offset in zip(ideal, offsets, strict=True)])
    pair_frame = frame[pairs[:, 0]]
    pair_order = np.argsort(pair_frame, kind="stable")
    edges = np.arange(views[0].frame_count + 1)
    candidate_start = np.searchsorted(frame[order], edges)
    pairs = new_row[pairs[pair_order]] - candidate_start[pair_frame[pair_order], None]
    candidates = Detections(
        view=np.repeat(np.arange(len(ideal)), counts)[order],
        joint=np.concatenate([view.joint for view in ideal])[order],
        xy=np.concatenate([view.xy for view in ideal])[order],
        confidence=np.concatenate([view.confidence for view in ideal])[order],
        pairs=pairs,
        affinity=np.concatenate([view.affinity for view in ideal])[pair_order],
    )
    pair_start = np.searchsorted(pair_frame[pair_order], edges)
    sources = tuple(view.source for view in views)
    notes = tuple(note for _, found in read for note in found)
    return DetectionTable(skeleton, candidates, candidate_start, pair_start, sources, notes)


def _undistorted(view: ViewCandidates, camera: Camera) -> tuple[ViewCandidates, list[str]]:
    """`view` with the pixels of a camera without distortion, and sentences about candidates that were left out.

    InputError where so many have no place that the calibration must be another's.
    """
    size = np.array(camera.image_size, dtype=np.float64)
    outside = np.any((view.xy < -MARGIN * size) | (view.xy > (1 + MARGIN) * size), axis=1)
    notes = []
    if outside.any():
        row = int(np.argmax(outside))
        x, y = view.xy[row]
        where = (
            f"{view.source}: frame {view.frame[row]} has a joint at pixel ({x:.0f}, {y:.0f}), far outside the"
            f" {camera.image_size[0]} x {camera.image_size[1]} picture of the calibration"
        )
        if outside.mean() > _STRAY:
            raise InputError(f"{where}; give detections made on pictures of the calibrated size")
        notes.append(f"{where}; {outside.sum()} such joints of {len(outside)} were left out")
        view = _only(view, ~outside)
    certain = view.confidence >= _LEAST_SCORE
    if not certain.all():
        view = _only(view, certain)
    xy = camera.undistort(view.xy)
    undone = np.asarray(np.isfinite(xy).all(axis=1))
    if not undone.all():
        where = (
            f"{view.source}: the distortion of camera {camera.name} cannot be undone at frame"
            f" {view.frame[int(np.argmin(undone))]}"
        )
        if (~undone).mean() > _STRAY:
            raise InputError(f"{where}; check the distortion coefficients in the calibration")
        notes.append(f"{where}; {(~undone).sum()} joints of {len(undone)} were left out")
        view, xy = _only(view, undone), xy[undone]
    return replace(view, xy=xy), notes


def _only(view: ViewCandidates, keep: NDArray[np.bool_]) -> ViewCandidates:
    """The candidates of the mask `keep` (D,), and the pairs between them."""
    place = np.cumsum(keep) - 1
    both = keep[view.pairs].all(axis=1)
    return replace(
        view,
        frame=view.frame[keep],
        joint=view.joint[keep],
        xy=view.xy[keep],
        confidence=view.confidence[keep],
        pairs=place[view.pairs[both]],
        affinity=view.affinity[both],
    )
