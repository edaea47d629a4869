"""A whole recording of 2D candidates, stored in blocks of frames, in memory or in files."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from shapepose_fg.core.arrays import Index
from shapepose_fg.core.detections import Detections
from shapepose_fg.core.skeleton import Skeleton
from shapepose_fg.core.storage.files import BLOCK_FRAMES as BLOCK_FRAMES
from shapepose_fg.core.storage.kept_arrays import Arrays, KeptArrays

_KEPT: dict[str, Any] = {
    "view": np.int16,
    "joint": np.int16,
    "xy": np.float64,
    "confidence": np.float64,
    "pairs": np.int32,
    "affinity": np.float64,
}
"""Arrays of a stored block and their types; 28 bytes a candidate, 16 bytes an affinity."""


@dataclass(frozen=True)
class DetectionTable:
    """The candidates of all views and frames; `table[frame]` is that frame's `Detections`.

    Within a frame, candidates are sorted by view, then by joint, then in the order of the
    detector's file.
    """

    skeleton: Skeleton
    """The detector's joints."""
    kept: KeptArrays
    """Storage of the blocks (`keep_block`)."""
    frame_count: int
    """T, the number of frames of the recording."""
    sources: tuple[Path, ...] = ()
    """The file or folder from which each view was read."""
    notes: tuple[str, ...] = ()
    """Notes of the reader, a sentence each, on how the files were interpreted and what was left
    out."""
    first: int = 0
    """Number of the first frame in the files."""
    picture: Index | None = None
    """(T, V) number of each view's own frame in each frame of the table, -1 for none; None if
    numbers are equal."""
    _at_hand: dict[int, Arrays] = field(default_factory=dict, init=False, repr=False, compare=False)
    """The most recently read blocks."""

    def __len__(self) -> int:
        return self.frame_count

    def __getitem__(self, frame: int, /) -> Detections:
        if not -len(self) <= frame < len(self):
            raise IndexError(f"frame {frame} is not among the {len(self)} frames")
        number, at = divmod(frame % len(self), BLOCK_FRAMES)
        if number not in self._at_hand:
            # Number of blocks that stay in memory: windows are solved with a short
            # delay after the frame that is read.
            while len(self._at_hand) >= 4:
                del self._at_hand[next(iter(self._at_hand))]
            names = (*_KEPT, "candidate_start", "pair_start")
            self._at_hand[number] = {name: self.kept.array(_name(number), name) for name in names}
        block = self._at_hand[number]
        rows = slice(*block["candidate_start"][at : at + 2].tolist())
        links = slice(*block["pair_start"][at : at + 2].tolist())
        view, joint, xy, confidence = (
            block[name][rows] for name in ("view", "joint", "xy", "confidence")
        )
        pairs, affinity = block["pairs"][links].astype(np.intp), block["affinity"][links]
        return Detections(
            view.astype(np.intp), joint.astype(np.intp), xy, confidence, pairs, affinity
        )

    def __iter__(self) -> Iterator[Detections]:
        return (self[frame] for frame in range(len(self)))


def keep_block(
    kept: KeptArrays, number: int, candidates: Detections, start: Index, pair_start: Index
) -> None:
    """Store block `number` of a recording: the candidates of its T frames, sorted by frame.

    Indices in `pairs` are relative to the first candidate of their frame; `start` and `pair_start`
    (T + 1,) are the offsets of each frame's candidates and pairs.
    """
    arrays = {name: getattr(candidates, name).astype(dtype) for name, dtype in _KEPT.items()}
    kept.keep(_name(number), arrays | {"candidate_start": start, "pair_start": pair_start})


def _name(number: int) -> str:
    return f"seen-{number:07d}"
