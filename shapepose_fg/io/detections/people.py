"""People of one camera as detectors write them, and taken apart into candidates with affinities."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.io.detection_table import ViewCandidates
from shapepose_fg.skeleton import Skeleton


@dataclass(frozen=True)
class CameraPeople:
    """The people that one camera saw in a recording, keypoint by keypoint, in the detector's own order."""

    source: Path
    """The file or folder that they come from, for messages."""
    program: str
    """Which program's format it was recognised as, for messages."""
    frame: NDArray[np.intp]
    """(N,) number of each person's frame, as the files say it; not falling."""
    keypoints: NDArray[np.float64]
    """(N, K, 3) x, y in pixels, score; a score of 0 (or less, or not a number) is a joint that was not seen."""
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


def candidates_of(people: CameraPeople, skeleton: Skeleton, first: int, last: int) -> ViewCandidates:
    """The joints of people as candidates, with affinity 1 between those of one person that a limb joins.

    So that grouped and ungrouped detections walk the same way. Frames run from number `first` to `last`. Joints
    that the skeleton makes are the middles of two that were seen, as sure as the less sure of them.
    """
    joints = _joints(people.keypoints, skeleton)
    frame = people.frame - first
    person, joint = np.nonzero(joints[..., 2] > 0)
    order = np.lexsort((person, joint, frame[person]))
    person, joint = person[order], joint[order]
    row = np.full(joints.shape[:2], -1, dtype=np.intp)
    row[person, joint] = np.arange(len(person))
    pairs = row[:, np.array(skeleton.limbs)].reshape(
        -1, 2
    )  # people are in the order of their frames: so are pairs
    pairs = pairs[np.all(pairs >= 0, axis=1)]
    return ViewCandidates(
        source=people.source,
        frame_count=last - first + 1,
        frame=frame[person],
        joint=joint,
        xy=joints[person, joint, :2],
        confidence=joints[person, joint, 2],
        pairs=pairs,
        affinity=np.ones(len(pairs)),
        first_number=first,
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
