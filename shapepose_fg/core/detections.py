"""2D joint candidates of all views of one frame, and the affinities between them."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import numpy as np

from shapepose_fg.core.arrays import Array, Index, Mask
from shapepose_fg.core.camera import Rig
from shapepose_fg.core.skeleton import Skeleton


@dataclass(frozen=True)
class Detections:
    """The 2D joint candidates of one frame in all views, and their part affinities."""

    view: Index
    """(D,) index of the camera in the rig."""
    joint: Index
    """(D,) index of the joint in the skeleton."""
    xy: Array
    """(D, 2) position, undistorted pixels."""
    confidence: Array
    """(D,) the detector's score, 0 to 1."""
    pairs: Index
    """(E, 2) pairs of candidates of one view that are connected by a limb, the limb's first joint
    first."""
    affinity: Array
    """(E,) affinity of each pair: support of the image that both belong to one person; 0 for pairs
    that are not listed."""
    place: Index = None  # type: ignore[assignment]
    """(D,) index of each candidate among those of its view in the recording, independent of later
    filtering; by default counted in these detections."""
    mirrored: Array = None  # type: ignore[assignment]
    """(D,) probability that the candidate belongs to the other side of the body
    (`tracking/sides.py`); 0 by default."""

    def __post_init__(self) -> None:
        count = len(self.view)
        if self.place is None:
            object.__setattr__(self, "place", _place_in_view(self.view))
        if self.mirrored is None:
            object.__setattr__(self, "mirrored", np.zeros(count))
        names = ("view", "joint", "confidence", "place", "mirrored")
        shapes = dict[str, tuple[int, ...]].fromkeys(names, (count,)) | {"xy": (count, 2)}
        shapes |= {"pairs": (len(self.affinity), 2), "affinity": (len(self.affinity),)}
        for name, shape in shapes.items():
            if np.shape(getattr(self, name)) != shape:
                raise ValueError(f"{name} must be {shape}, got {np.shape(getattr(self, name))}")

    def __len__(self) -> int:
        return len(self.view)

    @cached_property
    def columns(self) -> tuple[Index, Index, Array, Index, Array]:
        """View, joint, xy, pairs and affinity in the order that kernels expect."""
        whole = (
            np.require(each, np.intp, ["C", "W"]) for each in (self.view, self.joint, self.pairs)
        )
        view, joint, pairs = whole
        return (
            view,
            joint,
            np.require(self.xy, float, ["C", "W"]),
            pairs,
            np.require(self.affinity, float, ["C", "W"]),
        )

    @cached_property
    def rank(self) -> Array:
        """(D,) rank by content, 0 to 1, which breaks ties independently of the order of the
        candidates.
        """
        rank = np.empty(len(self))
        rank[np.lexsort((*self.xy.T, self.confidence))] = np.arange(len(self)) / max(len(self), 1)
        return rank

    @cached_property
    def order(self) -> Index:
        """(D,) indices of the candidates sorted by joint, then by view, then from left to right."""
        return np.lexsort((self.xy[:, 0], self.view, self.joint))

    @cached_property
    def ties(self) -> tuple[Index, Index, Array]:
        """Pairs by candidate, in CSR form: (D + 1,) offsets, (2 E,) the other candidate of each
        pair, and (2 E,) affinities.
        """
        ends = self.pairs.ravel()
        by_end = np.argsort(ends, kind="stable")
        begin = np.searchsorted(ends[by_end], np.arange(len(self) + 1))
        other = np.require(self.pairs[:, ::-1], np.intp).ravel()[by_end]
        return begin, other, np.repeat(np.require(self.affinity, float), 2)[by_end]

    def with_sides(self, joint: Index, mirrored: Array, mirror: Index) -> "Detections":
        """The candidates, some as the joint of the other side: `joint` (D,) is that of each or its
        `mirror` (J,), and `mirrored` (D,) the probability that this is wrong.

        Affinities between a candidate that changed its side and one that did not are left out.
        Raises ValueError for any other joint.
        """
        first, second = self.pairs.T
        wrong, middle = joint != self.joint, mirror[self.joint] == self.joint
        if np.any(joint[wrong] != mirror[self.joint[wrong]]):
            raise ValueError("its detections are of other joints")
        whole = (wrong[first] == wrong[second]) | middle[first] | middle[second]
        pairs, affinity = self.pairs[whole], self.affinity[whole]
        return replace(self, joint=joint, pairs=pairs, affinity=affinity, mirrored=mirrored)

    def only(self, keep: Mask) -> "Detections":
        """The candidates selected by the mask `keep` (D,), and the affinities between them."""
        return self.rows(np.flatnonzero(keep))

    def rows(self, index: Index) -> "Detections":
        """The candidates `index` (K,), without repetitions, in that order, and the affinities
        between them.
        """
        place = np.full(len(self), -1, dtype=np.intp)
        place[index] = np.arange(len(index))
        pairs = place[self.pairs]
        both = (pairs >= 0).all(axis=1)
        return Detections(
            self.view[index],
            self.joint[index],
            self.xy[index],
            self.confidence[index],
            pairs[both],
            self.affinity[both],
            self.place[index],
            self.mirrored[index],
        )

    @classmethod
    def joined(cls, parts: Sequence["Detections"]) -> "Detections":
        """Concatenate the candidates of one or more parts, with the affinities within each part."""
        names = ("view", "joint", "xy", "confidence", "affinity", "place", "mirrored")
        columns = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
        starts = np.cumsum([0, *(len(part) for part in parts)])
        pairs = np.concatenate(
            [part.pairs + start for part, start in zip(parts, starts, strict=False)]
        )
        return cls(pairs=pairs, **columns)

    @classmethod
    def empty(cls) -> "Detections":
        """A frame without detections."""
        none = np.zeros(0, dtype=np.intp)
        return cls(
            none, none, np.zeros((0, 2)), np.zeros(0), np.zeros((0, 2), dtype=np.intp), np.zeros(0)
        )


def _place_in_view(view: Index) -> Index:
    """(D,) index of each detection among those of the same view."""
    order = np.argsort(view, kind="stable")
    place = np.empty(len(view), dtype=np.intp)
    place[order] = np.arange(len(view)) - np.searchsorted(view[order], view[order])
    return place


@dataclass(frozen=True)
class Input:
    """The input from all cameras for one frame."""

    frame: int
    """Number of the frame in the recording."""
    time_s: Array
    """(V,) times of exposure of the views, seconds."""
    detections: Detections
    """The detections in all views."""
    rig: Rig
    """The cameras at the times of the views."""
    key: bool = True
    """Whether new people are searched for in the frame. Detections of frames between keyframes are
    not thinned."""


class DetectionSequence(Protocol):
    """Frames of detections, in order: the type that readers and the simulator return, and that the
    pipeline takes.

    Any object with these members can be used; a list of `Detections` in a `Recording` is the
    simplest.
    """

    @property
    def skeleton(self) -> Skeleton:
        """The detector's joints."""
        ...

    def __len__(self) -> int: ...

    def __getitem__(self, frame: int, /) -> Detections: ...


@dataclass(frozen=True)
class Recording:
    """A sequence of detections held in memory."""

    skeleton: Skeleton
    """The detector's joints."""
    frames: Sequence[Detections]
    """One entry per frame, frame 0 first."""

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, frame: int, /) -> Detections:
        return self.frames[frame]

    def __iter__(self) -> Iterator[Detections]:
        return iter(self.frames)


@dataclass(frozen=True)
class DerivedFrames:
    """Base of recordings that are derived frame by frame from another one, for example with some
    detections left out.
    """

    frames: DetectionSequence
    """The original recording."""

    @property
    def skeleton(self) -> Skeleton:
        """The detector's joints."""
        return self.frames.skeleton

    @property
    def first(self) -> int:
        """Number of the first frame in the recording."""
        return getattr(self.frames, "first", 0)

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, frame: int, /) -> Detections:
        return self.frames[frame]
