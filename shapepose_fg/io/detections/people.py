"""What one camera saw, block by block: candidates, or people as detectors write them; all cameras put together.

People are given scores from 0 to 1, and taken apart into candidates.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from shapepose_fg.core.arrays import Array, Index, Mask
from shapepose_fg.core.camera import Camera, Rig
from shapepose_fg.core.detections import Detections
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.skeleton import Skeleton
from shapepose_fg.core.storage.kept_arrays import KeptArrays
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

    frame: Index
    """(D,) frame of each candidate, from 0."""
    seen: Detections
    """The candidates, of view 0, pixels as measured; pairs join two of one frame."""

    @classmethod
    def of(
        cls, frame: Index, joint: Index, xy: Array, confidence: Array, pairs: Index, affinity: Array
    ) -> "ViewCandidates":
        """Of columns as in `Detections`."""
        return cls(frame, Detections(np.zeros_like(joint), joint, xy, confidence, pairs, affinity))

    def only(self, keep: Mask) -> "ViewCandidates":
        """The candidates of the mask `keep` (D,), and the pairs between them."""
        return self if keep.all() else ViewCandidates(self.frame[keep], self.seen.only(keep))


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


def assemble(views: Sequence[ViewStream], rig: Rig, skeleton: Skeleton, kept: KeptArrays) -> DetectionTable:
    """Put the views of a recording together, one `ViewStream` per camera of `rig`, undistorted; held by `kept`.

    Raises InputError where the views hold different numbers of frames or do not fit their pictures.
    """
    first = views[0]
    for view in views[1:]:
        if (view.frame_count, view.first_number) == (first.frame_count, first.first_number):
            continue
        for each in views:  # what is wrong with their files goes first
            for _ in each.blocks:
                pass
        what = f"holds {view.frame_count} frames", f"holds {first.frame_count}"
        if view.frame_count == first.frame_count:
            what = f"starts at frame {view.first_number}", f"starts at frame {first.first_number}"
        raise InputError(f"{view.source} {what[0]}, but {first.source} {what[1]}; give the same frames of each")
    ideal = [_Undistorted(view.source, camera) for view, camera in zip(views, rig.cameras, strict=True)]
    for n, blocks in enumerate(zip(*(view.blocks for view in views), strict=True)):
        seen = [each.undistorted(block) for each, block in zip(ideal, blocks, strict=True)]
        stop = min((n + 1) * BLOCK_FRAMES, first.frame_count)
        keep_block(kept, n, *_together(seen, range(n * BLOCK_FRAMES, stop)))
    notes = tuple(note for each in ideal for reason in each.reasons for note in reason.note())
    return DetectionTable(skeleton, kept, first.frame_count, tuple(view.source for view in views), notes)


def _together(views: Sequence[ViewCandidates], frames: range) -> tuple[Detections, Index, Index]:
    """The candidates of all views in some frames, and (T + 1,) where candidates and pairs of each frame begin."""
    counts = [len(view.frame) for view in views]
    offsets = np.cumsum([0, *counts[:-1]])
    every = Detections(
        np.repeat(np.arange(len(views)), counts),
        np.concatenate([view.seen.joint for view in views]),
        np.concatenate([view.seen.xy for view in views]),
        np.concatenate([view.seen.confidence for view in views]),
        np.concatenate([view.seen.pairs + offset for view, offset in zip(views, offsets, strict=True)]),
        np.concatenate([view.seen.affinity for view in views]),
    )
    frame = np.concatenate([view.frame for view in views])
    # Views come in order and each is sorted by frame: a stable sort leaves (frame, view, joint).
    order = np.argsort(frame, kind="stable")
    frame, every = frame[order], every.rows(order)
    pair_frame = frame[every.pairs[:, 0]]
    pair_order = np.argsort(pair_frame, kind="stable")
    edges = np.arange(frames.start, frames.stop + 1)
    start, pair_frame = np.searchsorted(frame, edges), pair_frame[pair_order]
    pairs = every.pairs[pair_order] - start[pair_frame - frames.start][:, None]
    every = replace(every, pairs=pairs, affinity=every.affinity[pair_order])
    return every, start, np.searchsorted(pair_frame, edges)


class _LeftOut:
    """Candidates of a camera that were left out for one reason."""

    def __init__(self, what: str, cure: str) -> None:
        self._what, self._cure, self._count, self._of, self._first = what, cure, 0, 0, ""

    def add(self, out: Mask, words: Callable[[int], str]) -> None:
        """Take in which candidates (D,) of a block are left out; `words` say where one of them is."""
        if self._count == 0 and out.any():
            self._first = words(int(np.argmax(out)))
        self._count += int(out.sum())
        self._of += len(out)

    def note(self) -> list[str]:
        """A sentence, if there were some; InputError where there are so many that it cannot be by chance."""
        if self._count > _STRAY * self._of:
            raise InputError(f"{self._first}; {self._cure}")
        return [f"{self._first}; {self._count} {self._what} of {self._of} were left out"] if self._count else []


class _Undistorted:
    """One camera's candidates with the pixels of a camera without distortion, and those that were left out."""

    def __init__(self, source: Path, camera: Camera) -> None:
        self.source, self.camera = source, camera
        self.reasons = (
            _LeftOut("such joints", "give detections made on pictures of the calibrated size"),
            _LeftOut("joints", "check the distortion coefficients in the calibration"),
        )

    def undistorted(self, view: ViewCandidates) -> ViewCandidates:
        """A block."""
        camera, (width, height), xy = self.camera, self.camera.image_size, view.seen.xy
        size = np.array([width, height], dtype=np.float64)
        outside = np.any((xy < -MARGIN * size) | (xy > (1 + MARGIN) * size), axis=1)

        def where(row: int) -> str:
            return (
                f"{self.source}: frame {view.frame[row]} has a joint at pixel ({xy[row, 0]:.0f},"
                f" {xy[row, 1]:.0f}), far outside the {width} x {height} picture of the calibration"
            )

        self.reasons[0].add(outside, where)
        certain = view.only(~outside & (view.seen.confidence >= _LEAST_SCORE))
        straight = camera.undistort(certain.seen.xy)
        undone = np.asarray(~np.isfinite(straight).all(axis=1))
        what = f"{self.source}: the distortion of camera {camera.name} cannot be undone at frame"
        self.reasons[1].add(undone, lambda row: f"{what} {certain.frame[row]}")
        return replace(certain, seen=replace(certain.seen, xy=straight)).only(~undone)


OVERSHOOT = 1.1
"""Heat maps that are enlarged overshoot a little: scores up to this are cut at 1 without a word."""
_RARE = 0.01
"""Scores are divided by what this share of them exceeds: the highest alone would be decided by one outlier."""
_MOST_LOOKED_AT = 4_000_000
"""Of more scores than this every second, third ... is looked at for that."""
_OCCLUDED = 0.5
"""The score of a keypoint that an annotator marked though it was hidden: COCO's visibility 1 of 2."""


@dataclass(frozen=True)
class PeopleBlock:
    """People of some frames, keypoint by keypoint, in the detector's own order."""

    frame: Index
    """(N,) number of each person's frame, as the files say it; not falling."""
    keypoints: Array
    """(N, K, 3) x, y in pixels, score; a score of 0 (or less, or not a number) is a joint that was not seen."""

    @classmethod
    def of(cls, frames: list[int], people: list[list[float]]) -> "PeopleBlock":
        """Of flat keypoints, as many of each person."""
        count = len(people[0]) // 3 if len(people) > 0 else 0
        keypoints = np.array(people, dtype=np.float64).reshape(len(people), count, 3)
        return cls(np.array(frames, dtype=np.intp), keypoints)

    @property
    def scores(self) -> Array:
        """(S,) of keypoints that were seen."""
        every = self.keypoints[..., 2].ravel()
        return every[np.isfinite(every) & (every > 0)]


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
    """Whether the files list every frame, those without people too. Where not, frames may be missing at both
    ends, and the other cameras tell how long the recording is."""
    lists_people: bool = False
    """Whether a frame is known by its people only: the first that is listed need not be the recording's first."""
    gaps: tuple[tuple[int, int], ...] = ()
    """First and last number of frames in between that are missing from the files: no people are seen in them."""
    rerun: str = "write the detections again"
    """How the program makes pixels of the calibrated pictures."""


class KeptPeople:
    """All people of one camera, read to the end and kept; and what must be known of all of them."""

    def __init__(self, camera: CameraPeople, kept: KeptArrays, name: str) -> None:
        """Read them, into `kept` under names that begin with `name`."""
        self.camera, self._kept, self._names = camera, kept, list[str]()
        self.keypoint_count: int | None = None
        """K, None without people."""
        self.farthest: float | None = None
        """The largest coordinate of a keypoint that was seen, pixels; None where there is none."""
        self.score_count, self.top_score, self.visibilities = 0, 0.0, True
        """How many scores there are, the highest, and whether none is another number than 1 and 2."""
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

    def blocks(self, *, last_time: bool = False) -> Iterator[PeopleBlock]:
        """The people in the order of their frames; the last time they are not kept any longer."""
        for name in self._names:
            block = PeopleBlock(*(self._kept.array(name, key) for key in ("frame", "keypoints")))
            if last_time:
                self._kept.drop(name)
            yield block


Scores = Callable[[Array], Array]
"""Turns a detector's scores (...) into ones from 0 to 1."""


def score_rule(people: Sequence[KeptPeople]) -> tuple[Scores, str | None]:
    """How the scores of all cameras become probabilities; and what is said of it, None where they were before.

    - COCO's visibilities (only 0, 1 and 2, and a 2 among them): 2 is 1, and 1, hidden, is 0.5.
    - Scores that exceed 1.1: divided by the score that 1 in 100 exceeds, if that is above 1, then cut at 1.
      RTMPose's are heights of two curves and lie mostly under 1; others' are a few units, or per cent.
    """
    top = max(each.top_score for each in people)
    if top == 2 and all(each.visibilities for each in people):
        note = "scores are COCO's visibilities: 2 was read as 1, and 1, a hidden joint, as 0.5"
        return lambda score: np.where(score == 1, _OCCLUDED, score / 2), note
    if top <= OVERSHOOT:
        return lambda score: np.minimum(score, 1.0), None
    step = -(-sum(each.score_count for each in people) // _MOST_LOOKED_AT)
    looked_at = np.concatenate([block.scores[::step] for each in people for block in each.blocks()])
    scale = max(1.0, float(np.quantile(looked_at, 1 - _RARE)))
    divided = f"divided by {scale:.3g}, which 1 in 100 exceeds, and " if scale > 1 else ""
    note = f"scores reach {top:.3g}, so they are no probabilities: they were {divided}cut at 1"
    return lambda score: np.minimum(score / scale, 1.0), note


def candidates_of(people: KeptPeople, rule: Scores, skeleton: Skeleton, first: int, last: int) -> ViewStream:
    """The joints of people as candidates, with affinity 1 between those of one person that a limb joins.

    So that grouped and ungrouped detections walk the same way. Frames run from number `first` to `last`. Joints
    that the skeleton makes are the middles of two that were seen, as sure as the less sure of them.
    """
    count = last - first + 1

    def blocks() -> Iterator[ViewCandidates]:
        """In blocks of `BLOCK_FRAMES` frames, of people in blocks of any length."""
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
            yield _candidates(frame[:own] - first, keypoints[:own], rule, skeleton)
            waiting = PeopleBlock(frame[own:], keypoints[own:])

    return ViewStream(people.camera.source, count, blocks(), first)


def _candidates(frame: Index, keypoints: Array, rule: Scores, skeleton: Skeleton) -> ViewCandidates:
    """The joints of the people of some frames."""
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
