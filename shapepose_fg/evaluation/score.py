"""Scores people in 3D against a truth: PCP, MPJPE, PA-MPJPE, MOTA, IDF1, HOTA, and the coverage of
the covariances.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.arrays import Array, Mask
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.frame_times import spans_of
from shapepose_fg.core.joint_names import body_points
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.evaluation.metrics import (
    CORRECT_M,
    MAX_DISTANCE_M,
    PlainPeople,
    covariance_calibration,
    known_mean,
    match_people,
    mean_distance,
)
from shapepose_fg.evaluation.shelf import ACTORS, LIMB_ENDS, SHELF_JOINTS, shelf_joints
from shapepose_fg.evaluation.track_metrics import TrackFrame, TrackMetrics, track_metrics

FIGURES = {
    "pcp": "PCP, %",
    "mpjpe_mm": "MPJPE, mm",
    "pa_mpjpe_mm": "PA-MPJPE, mm",
    "recall": "recall, %",
    "mota": "MOTA, %",
    "idf1": "IDF1, %",
    "hota": "HOTA, %",
    "det_a": "DetA, %",
    "ass_a": "AssA, %",
    "inside_50": "in 50 % region, %",
    "inside_95": "in 95 % region, %",
}
"""Figures of a table, with headings."""


@dataclass(frozen=True)
class Score:
    """Result of `score`: per cent and millimetres; NaN if there is nothing to measure."""

    figures: dict[str, float]
    """The values of `FIGURES`."""
    limbs: dict[str, float]
    """PCP of each limb that both have, over all people, %."""
    people: dict[int, float]
    """PCP of each true person, %."""
    tracks: TrackMetrics | None
    """Metrics of identities, as shares; None if the predictions have no identities."""
    joints: tuple[str, ...]
    """The compared joints: those that both have, by name."""
    frames: int
    """Number of scored frames."""
    found: int
    """Number of true people, over all frames, who are matched with a prediction."""
    notes: tuple[str, ...]
    """What was not scored, and why, one sentence each."""

    def as_dict(self) -> dict[str, Any]:
        """All scores by name, for JSON; None instead of NaN."""

        def plain(values: dict[Any, float]) -> dict[str, float | None]:
            return {
                str(key): value if np.isfinite(value) else None for key, value in values.items()
            }

        tracks = {} if self.tracks is None else plain(vars(self.tracks))
        parts = {"pcp_limb": plain(self.limbs), "pcp_person": plain(self.people), "tracks": tracks}
        about = {
            "joints": list(self.joints),
            "frames": self.frames,
            "found": self.found,
            "notes": list(self.notes),
        }
        return plain(self.figures) | parts | about


def score(people: PlainPeople, truth: PlainPeople, frames: Iterable[int] | None = None) -> Score:
    """Score `people` against `truth`, both in metres in the same world, in the frames that both
    cover, or in those of them that are in `frames`. InputError if there is none, or no common
    joint.

    - Joints are mapped by name (`body_points`); only common ones are compared. BODY_25 is mapped to
      Shelf's annotation by `shelf_joints`.
    - The distance d of two people is the mean over the joints of the truth, in metres; a joint that
      is missing in the prediction counts 0.5 m.
    - PCP: each true person takes the prediction with the smallest d. A limb is correct if the mean
      error of its ends is at most half its true length. The figure is the mean over people.
    - MPJPE and PA-MPJPE: over people who are matched one to one (Hungarian, d under 0.5 m). PA
      aligns each person by the best similarity transform (Procrustes).
    - Recall: share of the true joints that are within 0.2 m of those of the prediction with the
      smallest d.
    - MOTA, IDF1, HOTA: `track_metrics` with the similarity max(0, 1 - d / 1 m), so that a match in
      MOTA and IDF1 has d of at most 0.5 m.
    - Coverage: share of the matched joints inside the 50 % and 95 % ellipsoids.

    If not everybody in view is annotated, predictions that are farther than 0.5 m from all
    annotated people are left out.
    """
    people, truth, notes = _comparable(people, truth)
    scored = _scored_frames(people, truth, frames)
    people, truth = (
        _rows(each, np.isin(each.frame, scored) & _known(each.joints).any(axis=1))
        for each in (people, truth)
    )
    tracked, nearest = list[TrackFrame](), np.full(truth.joints.shape, np.nan)
    for frame in scored.tolist():
        at, rows = (np.flatnonzero(each.frame == frame) for each in (truth, people))
        distance = mean_distance(people.joints[rows], truth.joints[at][:, None])
        if len(rows) > 0:
            nearest[at] = people.joints[rows[distance.argmin(axis=1)]]
        near = truth.complete | (distance < MAX_DISTANCE_M).any(axis=0)
        similarity = np.maximum(0, 1 - distance[:, near] / (2 * MAX_DISTANCE_M))
        tracked.append(TrackFrame(truth.person[at], people.person[rows[near]], similarity))
    limbs, persons, correct, count = _limbs(nearest, truth)
    matched, true, covariance = _matched(people, truth, scored)
    near_joints = np.linalg.norm(nearest - truth.joints, axis=2) <= CORRECT_M
    inside = covariance_calibration(matched - true, covariance).coverage
    tracks = track_metrics(tracked) if people.identified else None
    figures = dict.fromkeys(FIGURES, float("nan")) | {
        "pcp": known_mean(_percent(correct.sum(axis=1), count.sum(axis=1))),
        "mpjpe_mm": 1e3 * known_mean(np.linalg.norm(matched - true, axis=2)),
        "pa_mpjpe_mm": 1e3 * known_mean(np.linalg.norm(aligned(matched, true) - true, axis=2)),
        "recall": float(_percent(np.sum(near_joints), _known(truth.joints).sum())),
        "inside_50": 100 * inside[0.5],
        "inside_95": 100 * inside[0.95],
    }
    if tracks is not None:
        figures |= {
            name: 100 * getattr(tracks, name) for name in ("mota", "idf1", "hota", "det_a", "ass_a")
        }
    return Score(
        figures,
        dict(zip(limbs, _percent(correct.sum(axis=0), count.sum(axis=0)).tolist(), strict=True)),
        dict(zip(persons, _percent(correct.sum(axis=1), count.sum(axis=1)).tolist(), strict=True)),
        tracks,
        people.joint_names,
        len(scored),
        len(matched),
        notes,
    )


def aligned(joints: Array, truth: Array) -> Array:
    """(M, J, 3) `joints` moved by the similarity transform that brings each person closest to
    `truth`, both (M, J, 3).

    Procrustes: s R x + t with least squared distances over the joints that both have; at least
    three of them, else NaN. Reflections are excluded.
    """
    both = (_known(joints) & _known(truth))[..., None]
    weight = both / np.maximum(both.sum(axis=1, keepdims=True), 1)
    centre, target = ((weight * np.where(both, x, 0)).sum(axis=1, keepdims=True)
                      for x in (joints, truth))  # fmt: skip
    x, y = (np.where(both, each - mid, 0) for each, mid in ((joints, centre), (truth, target)))
    U, size, Vt = np.linalg.svd(y.swapaxes(1, 2) @ x)
    sign = np.ones_like(size)
    sign[:, 2] = np.sign(np.linalg.det(U @ Vt))
    scale = (size * sign).sum(axis=1) / np.maximum((x**2).sum(axis=(1, 2)), 1e-12)
    moved = scale[:, None, None] * ((joints - centre) @ ((U * sign[:, None]) @ Vt).swapaxes(1, 2))
    return np.where(both.sum(axis=1, keepdims=True) >= 3, moved + target, np.nan)


def _comparable(
    people: PlainPeople, truth: PlainPeople
) -> tuple[PlainPeople, PlainPeople, tuple[str, ...]]:
    """Both with their common joints, and notes on what is left out."""
    notes, known = list[str](), truth.joint_names
    if not truth.complete:
        truth = _rows(truth, np.isin(truth.person, ACTORS))
        notes.append(
            "not everybody is annotated: predictions farther than "
            f"{MAX_DISTANCE_M} m from all annotated people are not counted"
        )
    points = [body_points(each.joint_names) for each in (people, truth)]
    if known == SHELF_JOINTS:
        points[1] = list(known)  # Shelf's Neck is the chin's height, not between the shoulders
        if people.joint_names == BODY_25.joints:
            missing = np.full((len(people.frame), 15, 3, 3), np.nan)
            for place, name in enumerate(SHELF_JOINTS):
                if name not in ("Neck", "HeadTop") and people.covariance is not None:
                    missing[:, place] = people.covariance[:, BODY_25.index(name)]
            joints = shelf_joints(people.joints)
            people = replace(people, joints=joints, covariance=missing)
            points[0] = list(known)
        else:
            points[0] = [name if name != "Neck" else "" for name in points[0]]
    common = [name for name in points[1] if name and name in points[0]]
    if len(common) == 0:
        raise InputError(
            f"the result ({' '.join(people.joint_names)}) and the truth ({' '.join(known)}) have "
            "no joint in common; compare results with other joints"
        )
    if lacking := [name for name in known if name and body_points(known)[known.index(name)] == ""]:
        notes.append(f"joints of the truth without a known name: {' '.join(lacking)}")
    chosen = [
        _joints(each, [own.index(name) for name in common], tuple(common))
        for each, own in zip((people, truth), points, strict=True)
    ]
    return chosen[0], chosen[1], tuple(notes)


def _joints(people: PlainPeople, index: list[int], names: tuple[str, ...]) -> PlainPeople:
    """The joints `index` of the people, with new names."""
    covariance = None if people.covariance is None else people.covariance[:, index]
    joints = np.asarray(people.joints, dtype=np.float64)[:, index]
    return replace(people, joints=joints, covariance=covariance, joint_names=names)


def _rows(people: PlainPeople, index: Mask) -> PlainPeople:
    """The rows of people that a mask (N,) selects."""
    covariance = None if people.covariance is None else people.covariance[index]
    columns = {name: getattr(people, name)[index] for name in ("frame", "person", "joints")}
    return replace(people, **columns, covariance=covariance)


def _scored_frames(
    people: PlainPeople, truth: PlainPeople, frames: Iterable[int] | None
) -> NDArray[np.int64]:
    """The frames with somebody that both cover, in rising order."""
    every = np.unique(np.concatenate([people.frame, truth.frame])).astype(np.int64)

    def covers(each: PlainPeople) -> Mask:
        spans = [(every >= span.start) & (every < span.stop) for span in each.covered or ()]
        return np.logical_or.reduce([np.isin(every, each.frame), *spans])

    annotated = scored = every[covers(truth)]
    if people.covered is not None:
        scored = every[covers(truth) & covers(people)]
    if frames is not None:
        frames = frames if isinstance(frames, range) else set(frames)
        scored = np.array([frame for frame in scored.tolist() if frame in frames], dtype=np.int64)
    if len(scored) == 0:
        spans = spans_of(annotated[annotated >= 0].tolist())[:9]
        listed = ", ".join(f"{span[0]}-{span[-1]}" for span in spans)
        if listed:
            advice = f"reconstruct annotated frames: {listed}"
        elif len(annotated) > 0:
            advice = "all annotated frames are before frame 0, check --offset"
        else:
            advice = "the truth has no people, check --truth"
        raise InputError(f"none of the reconstructed frames is annotated; {advice}")
    return scored


def _limbs(
    nearest: Array, truth: PlainPeople
) -> tuple[list[str], list[int], NDArray[np.int64], NDArray[np.int64]]:
    """Names of the limbs and numbers of the people; correct and annotated limbs (people, limbs).

    `nearest` (G, J, 3) are the predictions of the rows of the truth.
    """
    same = {"HeadTop": "Head"}
    place = {same.get(name, name): n for n, name in enumerate(truth.joint_names)}
    ends = {name: [place.get(same.get(end, end), -1) for end in pair]
            for name, pair in LIMB_ENDS.items()}  # fmt: skip
    ends = {name: pair for name, pair in ends.items() if min(pair) >= 0}
    index = np.array([*ends.values()], dtype=np.intp).reshape(-1, 2)
    length = np.linalg.norm(truth.joints[:, index[:, 0]] - truth.joints[:, index[:, 1]], axis=2)
    error = np.linalg.norm(nearest - truth.joints, axis=2)[:, index].mean(axis=2)
    persons, person_index = np.unique(truth.person, return_inverse=True)
    member = (person_index == np.arange(len(persons))[:, None]).astype(np.int64)
    return [*ends], persons.tolist(), member @ (error <= length / 2), member @ np.isfinite(length)


def _matched(
    people: PlainPeople, truth: PlainPeople, scored: NDArray[np.int64]
) -> tuple[Array, Array, Array]:
    """Joints (M, J, 3) of matched predictions and of the truth, and covariances (M, J, 3, 3), NaN
    where unknown.
    """
    at = np.searchsorted(scored, truth.frame)
    order = np.argsort(at, kind="stable")
    place = np.empty(len(at), dtype=np.intp)  # number of each person within the frame
    place[order] = np.arange(len(at)) - np.searchsorted(at[order], at[order])
    table = np.full((len(scored), place.max(initial=0) + 1, *truth.joints.shape[1:]), np.nan)
    table[at, place] = truth.joints
    matches = match_people(people.frame, people.joints, table, scored.tolist())
    joints = people.joints[matches.row]
    covariance = np.full((*joints.shape, 3), np.nan)
    if people.covariance is not None:
        given = people.covariance[matches.row]
        exact = ~(np.trace(given, axis1=-2, axis2=-1) > 0)
        covariance = np.where(exact[..., None, None], np.nan, given)
    return joints, table[matches.frame, matches.person], covariance


def _known(joints: Array) -> Mask:
    """(..., J) which joints (..., J, 3) have a position."""
    return np.asarray(np.isfinite(joints).all(axis=-1))


def _percent(part: Any, whole: Any) -> Array:
    """100 part / whole; NaN where `whole` is 0."""
    return 100 * part / np.where(whole > 0, whole, np.nan)
