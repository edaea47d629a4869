"""Scores a reconstruction of the Shelf recording: PCP@0.5, MPJPE and recall against its annotation.

Precision is not computed: not all visible people are annotated, so a prediction without an
annotation may be correct.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.arrays import Array, Whole
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.frame_times import spans_of
from shapepose_fg.core.run_summary import covered_frames
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.evaluation.metrics import People, PlainPeople
from shapepose_fg.evaluation.shelf_annotation import SHELF_JOINTS

LIMB_ENDS = {
    "left upper arm": ("LShoulder", "LElbow"),
    "right upper arm": ("RShoulder", "RElbow"),
    "left lower arm": ("LElbow", "LWrist"),
    "right lower arm": ("RElbow", "RWrist"),
    "left upper leg": ("LHip", "LKnee"),
    "right upper leg": ("RHip", "RKnee"),
    "left lower leg": ("LKnee", "LAnkle"),
    "right lower leg": ("RKnee", "RAnkle"),
    "head": ("Neck", "HeadTop"),
    "torso": ("Neck", "MidHip"),
}
"""The joints at the ends of each limb."""
LIMB_NAMES = tuple(LIMB_ENDS)
"""The 10 scored limbs."""
LIMBS = np.array([[SHELF_JOINTS.index(joint) for joint in ends] for ends in LIMB_ENDS.values()])
"""(10, 2) indices of their ends in `SHELF_JOINTS`."""
ACTORS = (0, 1, 2)
"""The scored ids of the annotation: actors 1, 2 and 3."""
MISSING_JOINT_M, RECALL_M = 0.5, 0.2
"""Distance that a missing joint counts as when predictions are matched, and largest distance of a
recalled joint, m."""


@dataclass(frozen=True)
class ShelfScore:
    """Result of `evaluate_shelf`."""

    limbs_right: NDArray[np.int64]
    """(3, 10) number of correct limbs, by actor and limb."""
    limbs_all: NDArray[np.int64]
    """(3, 10) number of annotated limbs, by actor and limb."""
    mpjpe_mm: float
    """Mean distance of joints from the annotation, millimetres, over people who were found (mean
    joint distance under 0.5 m)."""
    recall: float
    """Share of the actors' annotated joints with a prediction within 0.2 m."""
    people_found: int
    """Number of annotated people with a prediction at a mean joint distance under 0.5 m."""
    people: int
    """Number of annotated people who were scored: the actors, in the scored frames."""
    frames: int
    """Number of scored frames: annotated, and reconstructed."""
    frames_annotated: int
    """Number of frames with an annotated actor."""

    @property
    def pcp(self) -> Array:
        """(3,) PCP of each actor, per cent; NaN for one who is not in the scored frames."""
        return _percent(self.limbs_right.sum(axis=1), self.limbs_all.sum(axis=1))

    @property
    def pcp_average(self) -> float:
        """Mean of the actors' PCP, per cent: the figure that papers call Avg."""
        scored = self.pcp[np.isfinite(self.pcp)]
        return float(scored.mean()) if len(scored) else float("nan")

    @property
    def pcp_pooled(self) -> float:
        """Share of correct limbs among all, of all actors, per cent."""
        return float(_percent(self.limbs_right.sum(), self.limbs_all.sum()))


def evaluate_shelf(
    people: People, ground_truth: PlainPeople, frames: Iterable[int] | None = None
) -> ShelfScore:
    """Score `people` against the annotated actors, in `frames` or in all annotated frames.

    Each annotated person is matched with the prediction of the frame that has the smallest mean
    joint distance; two people may have the same one. A missing joint counts 0.5 m in the matching,
    and its limbs are wrong. A limb is correct if the mean error of its two ends is at most half its
    annotated length. Without `frames`, a reconstruction is scored on the frames in `run["frames"]`
    ([start, stop] or several), if this entry exists. InputError if no annotated frame is left to
    score.
    """
    scored = acted = np.isin(ground_truth.person, ACTORS)
    frames = _frames_run(people) if frames is None else frames
    if frames is not None:
        scored = acted & np.isin(ground_truth.frame, np.fromiter(frames, dtype=np.int64))
    if not scored.any():
        raise InputError(
            "none of the reconstructed frames is annotated; reconstruct annotated frames:"
            f" {_spans(np.unique(ground_truth.frame[acted]))}"
        )
    truth, frame = ground_truth.joints[scored], ground_truth.frame[scored]
    distance = _distances(truth, frame, people)
    found = (
        np.where(np.isfinite(distance), distance, MISSING_JOINT_M).mean(axis=1) < MISSING_JOINT_M
    )
    length = np.linalg.norm(truth[:, LIMBS[:, 0]] - truth[:, LIMBS[:, 1]], axis=2)
    right = (
        distance[:, LIMBS].mean(axis=2) <= 0.5 * length
    )  # a missing end (NaN) makes the limb wrong
    member = ground_truth.person[scored, None] == np.array(ACTORS)
    known = np.isfinite(distance) & found[:, None]
    return ShelfScore(
        limbs_right=member.T.astype(np.int64) @ right,
        limbs_all=np.repeat(member.sum(axis=0)[:, None], len(LIMBS), axis=1),
        mpjpe_mm=1e3 * float(distance[known].mean()) if known.any() else float("nan"),
        recall=float((distance <= RECALL_M).mean()),
        people_found=int(found.sum()),
        people=len(frame),
        frames=len(np.unique(frame)),
        frames_annotated=len(np.unique(ground_truth.frame[acted])),
    )


def _distances(truth: Array, frame: Whole, people: People) -> Array:
    """(G, 15) distances of the joints of the predictions of annotated people (G, 15, 3), metres;
    NaN if the joint or the prediction is missing.
    """
    joints = np.asarray(people.joints, dtype=np.float64)
    if tuple(getattr(people, "joint_names", BODY_25.joints)) != BODY_25.joints:
        raise InputError(
            "the people's joints are not those of BODY_25, which this protocol maps to Shelf's 15"
        )
    joints = shelf_joints(joints)
    person, row = np.nonzero(frame[:, None] == np.asarray(people.frame)[None, :])
    distance = np.linalg.norm(joints[row] - truth[person], axis=2)
    cost = np.where(np.isfinite(distance), distance, MISSING_JOINT_M).mean(axis=1)
    order = np.lexsort((cost, person))
    first, where = np.unique(person[order], return_index=True)
    taken = np.full(truth.shape[:2], np.nan)
    taken[first] = distance[order[where]]
    return taken


def shelf_joints(body25: Array) -> Array:
    """Map BODY_25 joints (N, 25, 3), metres, z up, to Shelf's (N, 15, 3); NaN stays NaN.

    The hips, limbs and MidHip are the joints of the same name. With s and e the midpoints of
    shoulders and ears, Neck is s + 0.5 (e - s) and HeadTop is Neck + 0.125 f + 0.145 z, metres,
    with f the unit vector of (neck - midhip) x (RShoulder - LShoulder). The mapping is fixed:
    tuning it on the annotation would overfit. If one ear is unknown, e is the other ear projected
    on the plane halfway between the shoulders, in which the midpoint of two mirrored ears lies.
    """
    body25 = np.asarray(body25, dtype=np.float64)
    if body25.ndim != 3 or body25.shape[1:] != (25, 3):
        raise ValueError(f"body25 must be (N, 25, 3), got {body25.shape}")
    named = ("RShoulder", "LShoulder", "MidHip", "Neck", "REar", "LEar")
    right, left, midhip, neck, right_ear, left_ear = (
        body25[:, BODY_25.index(name)] for name in named
    )
    shoulders, across = 0.5 * (right + left), _unit(right - left)
    ear = np.where(np.isfinite(right_ear), right_ear, left_ear)
    mirrored = ear - np.sum((ear - shoulders) * across, axis=1, keepdims=True) * across
    middle = 0.5 * (right_ear + left_ear)
    middle = np.where(np.isfinite(middle), middle, mirrored)
    result = np.empty((len(body25), 15, 3))
    result[:, :12] = body25[:, [BODY_25.index(name) for name in SHELF_JOINTS[:12]]]
    result[:, 12] = shoulders + 0.5 * (middle - shoulders)
    result[:, 13] = (
        result[:, 12] + 0.125 * _unit(np.cross(neck - midhip, right - left)) + [0.0, 0.0, 0.145]
    )
    result[:, 14] = midhip
    return result


def _unit(vectors: Array) -> Array:
    """Unit vectors (N, 3); NaN for vectors of length zero."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors / np.where(length > 0, length, np.nan)


def _frames_run(people: People) -> Iterable[int] | None:
    """The frames that the reconstruction covers, if it states them."""
    try:
        spans = covered_frames(getattr(people, "run", None) or {})
    except ValueError as error:
        raise InputError(f"run.json: {error}; restore the file") from None
    return None if spans is None else [frame for span in spans for frame in span]


def _spans(frames: Whole) -> str:
    """Frames in words: "0-100, 216-230"."""
    spans = spans_of(frames.tolist())
    return (
        ", ".join(f"{span[0]}-{span[-1]}" if len(span) > 1 else f"{span[0]}" for span in spans)
        or "none"
    )


def _percent(part: Any, whole: Any) -> Array:
    """100 part / whole, NaN if `whole` is 0."""
    whole = np.asarray(whole, dtype=np.float64)
    return 100 * np.asarray(part) / np.where(whole > 0, whole, np.nan)
