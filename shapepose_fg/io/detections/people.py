"""People of one camera as detectors write them: stored, with scores scaled to 0 to 1, and divided into
candidates.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from shapepose_fg.core.arrays import Array, Index
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.skeleton import Skeleton
from shapepose_fg.core.storage.kept_arrays import KeptArrays
from shapepose_fg.io.detection_table import BLOCK_FRAMES
from shapepose_fg.io.detections.view_streams import ViewCandidates, ViewStream

OVERSHOOT = 1.1
"""Largest score that is cut at 1 without a note: enlarged heat maps overshoot a little."""
_RARE = 0.01
"""Share of scores above the one that all are divided by: the maximum would depend on one outlier."""
_MOST_LOOKED_AT = 4_000_000
"""Number of scores above which only every second, third ... of them is used to find how they are scaled."""
_BLOCKS_LOOKED_AT = 10
"""Number of blocks of a camera's people that are compared with a body."""
_OCCLUDED = 0.5
"""Score of a keypoint that an annotator marked as hidden: COCO's visibility 1 of 2."""


@dataclass(frozen=True)
class PeopleBlock:
    """People of some frames, keypoint by keypoint, in the detector's own order."""

    frame: Index
    """(N,) number of each person's frame in the files; not falling."""
    keypoints: Array
    """(N, K, 3) x, y in pixels, score; a score of 0 (or less, or not a number) is a joint that was not seen."""

    @classmethod
    def of(cls, frames: list[int], people: list[list[float]]) -> "PeopleBlock":
        """Block of flat keypoints, equally many for each person."""
        count = len(people[0]) // 3 if len(people) > 0 else 0
        keypoints = np.array(people, dtype=np.float64).reshape(len(people), count, 3)
        return cls(np.array(frames, dtype=np.intp), keypoints)

    @classmethod
    def dense(cls, frame: Index, points: Array) -> "PeopleBlock":
        """Block of `points` (F, P, K, 3) of P people in the frames `frame` (F,), rising; NaN is not seen."""
        seen = np.asarray(np.isfinite(points).all(axis=3))
        row, person = np.nonzero(seen.any(axis=2))
        return cls(frame[row], np.where(seen[..., None], points, 0.0)[row, person])

    @property
    def scores(self) -> Array:
        """(S,) scores of the keypoints that were seen."""
        every = self.keypoints[..., 2].ravel()
        return every[np.isfinite(every) & (every > 0)]


def check_one_model(known: set[int], people: Sequence[list[float]], source: Path, program: str) -> None:
    """Add numbers of keypoints to `known`; InputError where there are several."""
    known |= {len(person) // 3 for person in people}
    if len(known) > 1:
        counts = " and ".join(map(str, sorted(known)))
        what = f"recognised as {program}, but people have {counts} keypoints"
        raise InputError(f"{source}: {what}; give the detections of one model")


def frame_blocks(
    folder: Path, program: str, files: Sequence[tuple[int, Path]], read: Callable[[Path], list[list[float]]]
) -> Iterator[PeopleBlock]:
    """The people of numbered files of frames, block by block; `read` gives flat keypoints of a file's people."""
    counts = set[int]()
    for start in range(0, len(files), BLOCK_FRAMES):
        frames, people = list[int](), list[list[float]]()
        for number, file in files[start : start + BLOCK_FRAMES]:
            found = read(file)
            people += found
            frames += [number] * len(found)
        check_one_model(counts, people, folder, program)
        yield PeopleBlock.of(frames, people)


@dataclass(frozen=True)
class CameraPeople:
    """The people that one camera saw in a recording."""

    source: Path
    """The file or folder that they come from, for messages."""
    program: str
    """Program whose format was recognised, for messages."""
    blocks: Iterator[PeopleBlock]
    """The people in the order of their frames, in blocks of frames that are read one by one."""
    first: int
    """Number of the first frame."""
    last: int
    """Number of the last frame."""
    every_frame: bool = True
    """Whether the files list every frame, also those without people. If not, frames may be missing at both
    ends, and the other cameras define the length of the recording."""
    lists_people: bool = False
    """Whether only frames with people are listed: the first of them need not be the recording's first."""
    gaps: tuple[tuple[int, int], ...] = ()
    """First and last number of frames in between that are missing from the files: no people are seen in them."""
    rerun: str = "write the detections again"
    """Instruction for running the program on the calibrated pictures."""
    joints: str | tuple[str, ...] | None = None
    """Names of the keypoints in the files, in their order and in the program's words; or the program's name of
    the whole layout ("coco", "BODY_25B"); None where the files have neither."""


@dataclass(frozen=True)
class DeclaredJoints:
    """Joints from the settings of a project; names in the detections' own files have precedence."""

    joints: str | tuple[str, ...]
    """As in `CameraPeople.joints`."""
    source: str
    """Place of the statement, for messages: "Config.toml: pose.pose_model"."""


class KeptPeople:
    """All people of one camera, stored, with statistics of all of them."""

    def __init__(self, camera: CameraPeople, kept: KeptArrays, name: str) -> None:
        """Read them, and store them in `kept` under names that begin with `name`."""
        self.camera, self._kept, self._names = camera, kept, list[str]()
        self.keypoint_count: int | None = None
        """K, None without people."""
        self.farthest: float | None = None
        """The largest coordinate of a keypoint that was seen, pixels; None where there is none."""
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
        """(N, K, 2) positions of at most `most` people, spread over the recording; NaN where not seen."""
        count = self.keypoint_count or 0
        names = self._names[:: -(-len(self._names) // _BLOCKS_LOOKED_AT) if self._names else 1]
        parts = [np.asarray(self._kept.array(name, "keypoints")) for name in names]
        every = np.concatenate([np.zeros((0, count, 3)), *(part[:: -(-len(part) // most)] for part in parts)])
        every = every[:: -(-len(every) // most) if len(every) > 0 else 1]
        return np.where(every[..., 2:] > 0, every[..., :2], np.nan)

    def blocks(self, *, last_time: bool = False) -> Iterator[PeopleBlock]:
        """The people in the order of their frames; with `last_time` they are dropped as they are read."""
        for name in self._names:
            block = PeopleBlock(*(self._kept.array(name, key) for key in ("frame", "keypoints")))
            if last_time:
                self._kept.drop(name)
            yield block


Scores = Callable[[Array], Array]
"""Function that maps a detector's scores (...) to 0 to 1."""


def score_rule(people: Sequence[KeptPeople]) -> tuple[Scores, str | None]:
    """The mapping of all cameras' scores to probabilities, and a note on it; None where they are probabilities.

    - COCO's visibilities (only 0, 1 and 2, and a 2 among them): 2 is 1, and 1, hidden, is 0.5.
    - Scores that exceed 1.1: divided by the score that 1 in 100 exceeds, if that is above 1, then cut at 1.
      RTMPose's are heights of two curves and lie mostly under 1; others' are a few units, or per cent.
    """
    top = max(each.top_score for each in people)
    if top == 2 and all(each.visibilities for each in people):
        note = "scores are COCO visibilities: 2 (visible) is read as 1, and 1 (hidden) as 0.5"
        return lambda score: np.where(score == 1, _OCCLUDED, score / 2), note
    if top <= OVERSHOOT:
        return lambda score: np.minimum(score, 1.0), None
    step = -(-sum(each.score_count for each in people) // _MOST_LOOKED_AT)
    looked_at = np.concatenate([block.scores[::step] for each in people for block in each.blocks()])
    scale = max(1.0, float(np.quantile(looked_at, 1 - _RARE)))
    divided = f"divided by {scale:.3g}, their 99 % quantile, and " if scale > 1 else ""
    note = f"scores reach {top:.3g}, so they are not probabilities: they were {divided}clipped to 1"
    return lambda score: np.minimum(score / scale, 1.0), note


def candidates_of(people: KeptPeople, rule: Scores, skeleton: Skeleton, first: int, last: int) -> ViewStream:
    """The joints of people as candidates, with affinity 1 between those of one person that a limb joins.

    Grouped and ungrouped detections are thus processed alike. Frames run from number `first` to `last`. Joints
    that the skeleton adds are the middles of two that were seen, with the lower of their scores.
    """
    count = last - first + 1

    def blocks() -> Iterator[ViewCandidates]:
        """Blocks of `BLOCK_FRAMES` frames, from people in blocks of any length."""
        waiting = PeopleBlock(np.zeros(0, dtype=np.intp), np.zeros((0, skeleton.keypoint_count, 3)))
        given = people.blocks(last_time=True)
        for start in range(0, count, BLOCK_FRAMES):
            end = first + min(start + BLOCK_FRAMES, count)
            parts = [waiting] if len(waiting.frame) > 0 else []
            while (len(parts) == 0 or parts[-1].frame[-1] < end) and (part := next(given, None)):
                parts.append(part)
            frame = np.concatenate([part.frame for part in parts] or [waiting.frame])
            keypoints = np.concatenate([part.keypoints for part in parts] or [waiting.keypoints])
            own = int(np.searchsorted(frame, end))
            yield joints_of_people(frame[:own] - first, keypoints[:own], rule, skeleton)
            waiting = PeopleBlock(frame[own:], keypoints[own:])

    return ViewStream(people.camera.source, count, blocks(), first)


def joints_of_people(frame: Index, keypoints: Array, rule: Scores, skeleton: Skeleton) -> ViewCandidates:
    """The joints of N people of some `frame` (N,), of `keypoints` (N, K, 3), as candidates of one view."""
    joints = _joints(keypoints, rule, skeleton)
    person, joint = np.nonzero(joints[..., 2] > 0)
    order = np.lexsort((person, joint, frame[person]))
    person, joint = person[order], joint[order]
    row = np.full(joints.shape[:2], -1, dtype=np.intp)
    row[person, joint] = np.arange(len(person))
    # People are in the order of their frames: so are pairs.
    pairs = row[:, np.array(skeleton.limbs)].reshape(-1, 2)
    pairs = pairs[np.all(pairs >= 0, axis=1)]
    xy, score = joints[person, joint, :2], joints[person, joint, 2]
    return ViewCandidates.of(frame[person], joint, xy, score, pairs, np.ones(len(pairs)))


def _joints(keypoints: Array, rule: Scores, skeleton: Skeleton) -> Array:
    """(N, J, 3) the skeleton's joints with scores from 0 to 1, 0 0 0 where not seen."""
    target = np.arange(len(skeleton)) if skeleton.keypoints is None else np.array(skeleton.keypoints)
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
