"""People of one camera in the form that detectors write: stored, scores scaled to 0 to 1, and
converted to candidates.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from shapepose_fg.core.arrays import Array, Index
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.rows import Rows
from shapepose_fg.core.skeleton import Skeleton
from shapepose_fg.core.storage.kept_arrays import KeptArrays
from shapepose_fg.io.detection_table import BLOCK_FRAMES
from shapepose_fg.io.detections.view_streams import ViewCandidates, ViewStream, in_blocks

OVERSHOOT = 1.1
"""Largest score that is clipped to 1 without a note: upsampled heat maps overshoot slightly."""


@dataclass(frozen=True)
class PeopleBlock(Rows):
    """People of consecutive frames, with their keypoints in the detector's order."""

    frame: Index
    """(N,) frame number of each person in the files; non-decreasing."""
    keypoints: Array
    """(N, K, 3) x, y in pixels, score; a score of 0 or less, or NaN, means that the joint was not
    detected."""

    @classmethod
    def dense(cls, frame: Index, points: Array) -> "PeopleBlock":
        """Make a block from `points` (F, P, K, 3) of P people in the frames `frame` (F,),
        increasing; NaN means not detected.
        """
        seen = np.asarray(np.isfinite(points).all(axis=3))
        row, person = np.nonzero(seen.any(axis=2))
        return cls(frame[row], np.where(seen[..., None], points, 0.0)[row, person])

    @property
    def scores(self) -> Array:
        """(S,) scores of the detected keypoints."""
        every = self.keypoints[..., 2].ravel()
        return every[np.isfinite(every) & (every > 0)]


def check_one_model(known: set[int], people: Sequence[Array], source: Path, program: str) -> None:
    """Add the numbers of keypoints per person to `known`; InputError if there are several."""
    known |= {len(person) for person in people}
    if len(known) > 1:
        counts = " and ".join(map(str, sorted(known)))
        what = f"recognised as {program}, but people have {counts} keypoints"
        raise InputError(f"{source}: {what}; give the detections of one model")


def frame_blocks(
    folder: Path,
    program: str,
    files: Sequence[tuple[int, Path]],
    read: Callable[[Path], list[Array]],
) -> Iterator[PeopleBlock]:
    """The people of numbered files of frames, block by block; `read` returns the keypoints (K, 3)
    of each person in a file.
    """
    counts = set[int]()
    for start in range(0, len(files), BLOCK_FRAMES):
        frames, people = list[int](), list[Array]()
        for number, file in files[start : start + BLOCK_FRAMES]:
            found = read(file)
            people += found
            frames += [number] * len(found)
        check_one_model(counts, people, folder, program)
        keypoints = np.stack(people) if people else np.zeros((0, 0, 3))
        yield PeopleBlock(np.array(frames, dtype=np.intp), keypoints)


@dataclass(frozen=True)
class CameraPeople:
    """The people that one camera detected in a recording."""

    source: Path
    """The file or folder, for messages."""
    program: str
    """Program that wrote the files, for messages."""
    blocks: Iterator[PeopleBlock]
    """The people, sorted by frame, in blocks of frames that are read one by one."""
    first: int
    """Number of the first frame."""
    last: int
    """Number of the last frame."""
    every_frame: bool = True
    """Whether the files list every frame, also those without people. If not, frames may be missing
    at both ends, and the other cameras define the length of the recording."""
    lists_people: bool = False
    """Whether only frames with people are listed; the recording may then begin before the first of
    them."""
    gaps: tuple[tuple[int, int], ...] = ()
    """First and last number of ranges of frames that are missing in the files; these frames have no
    people."""
    rerun: str = "write the detections again"
    """Advice for error messages: how to run the program on the calibrated pictures."""
    joints: str | tuple[str, ...] | None = None
    """Names of the keypoints in the files, in order, as spelled by the program; or the program's
    name of the layout ("coco", "BODY_25B"); None if the files have neither."""


@dataclass(frozen=True)
class DeclaredJoints:
    """Joints from the settings of a project; names in the detections' own files have precedence."""

    joints: str | tuple[str, ...]
    """Names of the joints or of the layout, as in `CameraPeople.joints`."""
    source: str
    """Place of the declaration, for messages: "Config.toml: pose.pose_model"."""


class KeptPeople:
    """All people of one camera in storage, with statistics."""

    def __init__(self, camera: CameraPeople, kept: KeptArrays, name: str) -> None:
        """Read all people, and store them in `kept` under names that begin with `name`."""
        self.camera, self._kept, self._names = camera, kept, list[str]()
        self.keypoint_count: int | None = None
        """K, number of keypoints per person; None without people."""
        self.farthest: float | None = None
        """The largest coordinate of a detected keypoint, pixels; None if there is none."""
        self.score_count, self.top_score, self.visibilities = 0, 0.0, True
        """Number of scores, the highest one, and whether all of them are 1 or 2."""
        for block in camera.blocks:
            if len(block.frame) == 0:
                continue
            self._names.append(f"{name}-{len(self._names):07d}")
            kept.keep(self._names[-1], {"frame": block.frame, "keypoints": block.keypoints})
            self.keypoint_count = self.keypoint_count or block.keypoints.shape[1]
            scores = block.scores
            self.score_count += len(scores)
            self.top_score = max(self.top_score, float(scores.max(initial=0.0)))
            self.visibilities &= bool(np.isin(scores, (1, 2)).all())
            xy = np.abs(block.keypoints[block.keypoints[..., 2] > 0][:, :2])
            if not np.isnan(xy).all():
                self.farthest = max(self.farthest or 0.0, float(np.nanmax(xy)))

    def some(self, most: int) -> Array:
        """(N, K, 2) positions of at most `most` people, evenly spread over the recording; NaN if
        not detected.
        """
        count = self.keypoint_count or 0
        # Number of blocks of a camera's people that are compared with the proportions
        # of a body.
        names = self._names[:: -(-len(self._names) // 10) if self._names else 1]
        parts = [np.asarray(self._kept.array(name, "keypoints")) for name in names]
        every = np.concatenate(
            [np.zeros((0, count, 3)), *(part[:: -(-len(part) // most)] for part in parts)]
        )
        every = every[:: -(-len(every) // most) if len(every) > 0 else 1]
        return np.where(every[..., 2:] > 0, every[..., :2], np.nan)

    def blocks(self, *, last_time: bool = False) -> Iterator[PeopleBlock]:
        """The people, sorted by frame. With `last_time`, blocks are deleted from storage after they
        have been read.
        """
        for name in self._names:
            block = PeopleBlock(*(self._kept.array(name, key) for key in ("frame", "keypoints")))
            if last_time:
                self._kept.drop(name)
            yield block


Scores = Callable[[Array], Array]
"""Function that maps a detector's scores (...) to 0 to 1."""


def score_rule(people: Sequence[KeptPeople]) -> tuple[Scores, str | None]:
    """The mapping of all cameras' scores to 0 to 1, and a note on it; no note if they are already
    between 0 and 1.

    - No score above 0: nothing was detected, although there are people.
    - COCO's visibility flags (only 0, 1 and 2, at least one 2): 2 becomes 1, and 1 (occluded)
      becomes 0.5.
    - Scores that exceed 1.1: divided by their 99 % quantile, if that is above 1, then clipped at 1.
      RTMPose's scores are peaks of two 1D distributions and mostly below 1; scores of other
      networks reach a few units, or are per cent.
    """
    top = max(each.top_score for each in people)
    if top == 2 and all(each.visibilities for each in people):
        note = "scores are COCO visibilities: 2 (visible) is read as 1, and 1 (hidden) as 0.5"
        # Score of a keypoint that is annotated as occluded (COCO's visibility 1).
        return lambda score: np.where(score == 1, 0.5, score / 2), note
    if top <= 0 and any(each.keypoint_count for each in people):
        return lambda score: score, (
            "all scores are 0, so that no joint counts as detected; write the detector's scores, "
            "or 1 if it has none"
        )
    if top <= OVERSHOOT:
        return lambda score: np.minimum(score, 1.0), None
    # Number of scores above which only every second, third ... of them is used to find
    # their scale.
    step = -(-sum(each.score_count for each in people) // 4_000_000)
    looked_at = np.concatenate([block.scores[::step] for each in people for block in each.blocks()])
    # The maximum would depend on a single outlier.
    scale = max(1.0, float(np.quantile(looked_at, 0.99)))
    divided = f"divided by {scale:.3g}, their 99 % quantile, and " if scale > 1 else ""
    note = f"scores reach {top:.3g}, so they are not probabilities: they were {divided}clipped to 1"
    return lambda score: np.minimum(score / scale, 1.0), note


def candidates_of(
    people: KeptPeople, rule: Scores, skeleton: Skeleton, first: int, last: int
) -> ViewStream:
    """The joints of people as candidates, with affinity 1 along the limbs of each person.

    So grouped and ungrouped detections are processed in the same way. Frames are those with numbers
    `first` to `last`. Joints that the skeleton adds are midpoints of two detected joints, with the
    lower of their scores.
    """
    count = last - first + 1
    given = (replace(each, frame=each.frame - first) for each in people.blocks(last_time=True))
    nothing = PeopleBlock(np.zeros(0, dtype=np.intp), np.zeros((0, skeleton.keypoint_count, 3)))
    cut = in_blocks(given, count, PeopleBlock.concatenate, PeopleBlock.rows, nothing)
    blocks = (joints_of_people(each.frame, each.keypoints, rule, skeleton) for each in cut)
    return ViewStream(people.camera.source, count, blocks, first)


def joints_of_people(
    frame: Index, keypoints: Array, rule: Scores, skeleton: Skeleton
) -> ViewCandidates:
    """Candidates of one view: the joints of N people with `frame` (N,) and `keypoints` (N, K,
    3).
    """
    joints = _joints(keypoints, rule, skeleton)
    person, joint = np.nonzero(joints[..., 2] > 0)
    order = np.lexsort((person, joint, frame[person]))
    person, joint = person[order], joint[order]
    row = np.full(joints.shape[:2], -1, dtype=np.intp)
    row[person, joint] = np.arange(len(person))
    # People are sorted by frame, so pairs are, too.
    pairs = row[:, np.array(skeleton.limbs)].reshape(-1, 2)
    pairs = pairs[np.all(pairs >= 0, axis=1)]
    xy, score = joints[person, joint, :2], joints[person, joint, 2]
    return ViewCandidates.of(frame[person], joint, xy, score, pairs, np.ones(len(pairs)))


def _joints(keypoints: Array, rule: Scores, skeleton: Skeleton) -> Array:
    """(N, J, 3) x, y and score (0 to 1) of the skeleton's joints; 0 0 0 if not detected."""
    target = (
        np.arange(len(skeleton)) if skeleton.keypoints is None else np.array(skeleton.keypoints)
    )
    joints = np.zeros((len(keypoints), len(skeleton), 3))
    joints[:, target[target >= 0]] = keypoints[:, target >= 0]
    joints[..., 2] = rule(joints[..., 2])
    joints[~(np.isfinite(joints).all(axis=2) & (joints[..., 2] > 0))] = 0
    for middle, first, second in skeleton.middles:
        ends = joints[:, [first, second]]
        both = np.all(ends[..., 2] > 0, axis=1)
        joints[both, middle, :2] = ends[both, :, :2].mean(axis=1)
        joints[both, middle, 2] = ends[both, :, 2].min(axis=1)
    return joints
