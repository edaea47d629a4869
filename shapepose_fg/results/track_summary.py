"""Summary of the identities of a result: frames, gaps, stature and walked distance."""

from dataclasses import dataclass

import numpy as np

from shapepose_fg.body.model.smpl_file import SmplArrays
from shapepose_fg.body.shapes import statures_m
from shapepose_fg.core.arrays import Array, Index
from shapepose_fg.core.frame_times import ASSUMED_FPS
from shapepose_fg.core.reconstruction import Known, OpenedReconstruction, Reconstruction

_STEP_S = 0.5
"""Walked distance is measured between mean positions over this time, s; this averages out joint
noise."""
_STILL_M = 0.05
"""Steps between mean positions shorter than this, m, are noise and are ignored."""


@dataclass(frozen=True)
class TrackSummary:
    """Summary of one identity."""

    person: int
    """Identity."""
    first: int
    """First frame."""
    last: int
    """Last frame."""
    rows: int
    """Number of frames with this identity."""
    gaps: int
    """Number of gaps between the first and the last frame."""
    stature_m: float
    """Height of the person's mean body in T-pose, m; NaN without a body."""
    confidence: float
    """Mean confidence of the person's joints, 0 to 1."""
    seen: float
    """Share of the person's estimated joints that a view saw; NaN if the result does not record
    it."""
    walked_m: float
    """Walked distance, m, summed over half seconds; steps under 5 cm are ignored."""


MOST_ROWS = 40_000
"""Maximum number of rows of a saved result that are in memory at once, about 400 MB, plus those of
one person."""


def list_saved_tracks(
    opened: OpenedReconstruction, body: SmplArrays | None = None
) -> list[TrackSummary]:
    """`list_tracks` of a saved result, loading a few people at a time."""
    numbers, counts = np.unique(opened.person, return_counts=True)
    group = (np.cumsum(counts) - counts) // MOST_ROWS
    return [
        track
        for n in np.unique(group)
        for track in list_tracks(
            opened.people(numbers[group == n].tolist(), observations=False), body
        )
    ]


def list_tracks(
    people: Reconstruction, body: SmplArrays | None = None, every: int = 1
) -> list[TrackSummary]:
    """Summaries of the identities of `people`, by number; statures need the model `body` and are
    NaN without it.

    `people` has rows for each frame, or for every `every`-th frame.
    """
    order = np.lexsort((people.frame, people.person))
    persons, first = np.unique(people.person[order], return_index=True)
    if len(persons) == 0:
        return []
    tracks = np.split(order, first[1:])
    betas = np.stack([_mean_betas(people.betas[rows]) for rows in tracks])
    statures = np.full(len(tracks), np.nan) if body is None else statures_m(betas, body)
    return [
        _summary(people, int(person), rows, float(stature), every)
        for person, rows, stature in zip(persons, tracks, statures, strict=True)
    ]


def _mean_betas(betas: Array) -> Array:
    """(10,) mean shape of one person's rows (N, 10); NaN if no row has a body."""
    fitted = np.isfinite(betas).all(axis=1)
    return betas[fitted].mean(axis=0) if fitted.any() else np.full(betas.shape[1], np.nan)


def _summary(
    people: Reconstruction, person: int, rows: Index, stature_m: float, every: int
) -> TrackSummary:
    """Summary of the identity in `rows`, sorted by frame."""
    frame, known = people.frame[rows], people.known[rows]
    placed = np.isfinite(people.joints[rows]).all(axis=-1)
    recorded = placed & (known != Known.UNKNOWN)
    return TrackSummary(
        person=person,
        first=int(frame[0]),
        last=int(frame[-1]),
        rows=len(rows),
        gaps=int((np.diff(frame) > every).sum()),
        stature_m=stature_m,
        confidence=float(people.confidence[rows].mean()),
        seen=float(Known.observed(known[recorded]).mean()) if recorded.any() else float("nan"),
        walked_m=_walked_m(people, rows),
    )


def _walked_m(people: Reconstruction, rows: Index) -> float:
    """Walked distance of the mean of the known joints, m; the hips may be hidden."""
    count = np.isfinite(people.joints[rows].sum(axis=-1)).sum(axis=1)
    rows, count = rows[count > 0], count[count > 0]
    if len(rows) == 0:
        return 0.0
    middle = np.nansum(people.joints[rows], axis=1) / count[:, None]
    time_s = people.time_s[rows]
    time_s = np.where(np.isfinite(time_s), time_s, people.frame[rows] / ASSUMED_FPS)
    _, step = np.unique(np.floor((time_s - time_s[0]) / _STEP_S), return_inverse=True)
    size = np.bincount(step)
    place = np.stack([np.bincount(step, middle[:, axis]) / size for axis in range(3)], axis=1)
    apart_m = np.linalg.norm(np.diff(place, axis=0), axis=1)
    return float(apart_m[apart_m > _STILL_M].sum())
