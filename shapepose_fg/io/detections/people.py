"""People of one camera as detectors write them, and taken apart into candidates with affinities."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.skeleton import Skeleton
from shapepose_fg.io.detection_table import BLOCK_FRAMES
from shapepose_fg.io.detections.view_streams import ViewCandidates, ViewStream


@dataclass(frozen=True)
class PeopleBlock:
    """People of some frames, keypoint by keypoint, in the detector's own order."""

    frame: NDArray[np.intp]
    """(N,) number of each person's frame, as the files say it; not falling."""
    keypoints: NDArray[np.float64]
    """(N, K, 3) x, y in pixels, score; a score of 0 (or less, or not a number) is a joint that was not seen."""

    @classmethod
    def of(cls, frames: list[int], people: list[list[float]]) -> "PeopleBlock":
        """Of flat keypoints, as many of each person."""
        count = len(people[0]) // 3 if len(people) > 0 else 0
        keypoints = np.array(people, dtype=np.float64).reshape(len(people), count, 3)
        return cls(np.array(frames, dtype=np.intp), keypoints)


@dataclass(frozen=True)
class CameraPeople:
    """The people that one camera saw in a recording."""

    source: Path
    """The file or folder that they come from, for messages."""
    program: str
    """Which program's format it was recognised as, for messages."""
    blocks: Iterator[PeopleBlock]
    """The people in the order of their frames, some frames at a time, read when they are asked for."""
    first: int
    """Number of the first frame."""
    last: int
    """Number of the last frame."""
    every_frame: bool = True
    """Whether the files list every frame, those in which nobody is too. Where not, frames may be missing at both
    ends, and the other cameras tell how long the recording is."""
    gaps: tuple[tuple[int, int], ...] = ()
    """First and last number of frames in between that are missing from the files: nobody is seen in them."""
    rerun: str = "write the detections again"
    """How the program makes pixels of the calibrated pictures."""


def candidates_of(people: CameraPeople, skeleton: Skeleton, first: int, last: int) -> ViewStream:
    """The joints of people as candidates, with affinity 1 between those of one person that a limb joins.

    So that grouped and ungrouped detections walk the same way. Frames run from number `first` to `last`. Joints
    that the skeleton makes are the middles of two that were seen, as sure as the less sure of them.
    """
    count = last - first + 1
    return ViewStream(people.source, count, _blocks(people.blocks, skeleton, first, count), first)


def _blocks(blocks: Iterator[PeopleBlock], skeleton: Skeleton, first: int, count: int) -> Iterator[ViewCandidates]:
    """Candidates in blocks of `BLOCK_FRAMES` frames, of people in blocks of any length."""
    waiting = PeopleBlock(np.zeros(0, dtype=np.intp), np.zeros((0, skeleton.keypoint_count, 3)))
    for start in range(0, count, BLOCK_FRAMES):
        end = first + min(start + BLOCK_FRAMES, count)
        parts = [waiting]
        while (len(parts[-1].frame) == 0 or parts[-1].frame[-1] < end) and (part := next(blocks, None)):
            parts.append(part)
        filled = [part for part in parts if len(part.frame) > 0] or parts[:1]
        frame = np.concatenate([part.frame for part in filled])
        keypoints = np.concatenate([part.keypoints for part in filled])
        own = int(np.searchsorted(frame, end))
        yield _candidates(frame[:own] - first, keypoints[:own], skeleton)
        waiting = PeopleBlock(frame[own:], keypoints[own:])


def _candidates(frame: NDArray[np.intp], keypoints: NDArray[np.float64], skeleton: Skeleton) -> ViewCandidates:
    """The joints of the people of some frames."""
    joints = _joints(keypoints, skeleton)
    person, joint = np.nonzero(joints[..., 2] > 0)
    order = np.lexsort((person, joint, frame[person]))
    person, joint = person[order], joint[order]
    row = np.full(joints.shape[:2], -1, dtype=np.intp)
    row[person, joint] = np.arange(len(person))
    # People are in the order of their frames: so are pairs.
    pairs = row[:, np.array(skeleton.limbs)].reshape(-1, 2)
    pairs = pairs[np.all(pairs >= 0, axis=1)]
    return ViewCandidates(
        frame=frame[person],
        joint=joint,
        xy=joints[person, joint, :2],
        confidence=joints[person, joint, 2],
        pairs=pairs,
        affinity=np.ones(len(pairs)),
    )


def _joints(keypoints: NDArray[np.float64], skeleton: Skeleton) -> NDArray[np.float64]:
    """(N, J, 3) the skeleton's joints, 0 0 0 where not seen."""
    target = np.arange(len(skeleton)) if skeleton.keypoints is None else np.array(skeleton.keypoints)
    joints = np.zeros((len(keypoints), len(skeleton), 3))
    joints[:, target[target >= 0]] = keypoints[:, target >= 0]
    joints[~(np.isfinite(joints).all(axis=2) & (joints[..., 2] > 0))] = 0
    for middle, first, second in skeleton.middles:
        ends = joints[:, [first, second]]
        both = np.all(ends[..., 2] > 0, axis=1)
        joints[both, middle, :2] = ends[both, :, :2].mean(axis=1)
        joints[both, middle, 2] = ends[both, :, 2].min(axis=1)
    return joints
