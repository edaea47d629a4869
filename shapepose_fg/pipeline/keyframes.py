"""Keyframes, in which people are tracked and solved, and the rows of frames between them.

Between two keyframes a joint follows the mean of the motion model without measurements: given
positions and velocities at both ends, under white noise on acceleration, this is a cubic. Errors of
detectors are correlated over longer times than between keyframes, so that the covariance is that of
the ends, plus that of the unobserved motion.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from shapepose_fg.core.arrays import Array, Index, Mask, Whole, pair_keys
from shapepose_fg.core.frame_times import segments
from shapepose_fg.core.observation_table import Gate
from shapepose_fg.core.reconstruction import BODY, Known, Reconstruction, Status
from shapepose_fg.estimation.motion_densities import MotionModel

STRAY_M = 0.03
"""Deviation of a joint from the cubic between two keyframes, m, above which a frame between them
becomes a keyframe."""


def spaced(time_s: Array, apart_s: float) -> Mask:
    """(T,) mask of frames with ascending times `time_s` (T,): the first, the last, and the fewest
    others that leave no gap longer than `apart_s`.
    """
    chosen, at, last = np.zeros(len(time_s), dtype=bool), 0, len(time_s) - 1
    reached = np.searchsorted(time_s, time_s + apart_s + 1e-6, side="right") - 1
    while at < last:
        chosen[at] = True
        at = max(int(reached[at]), at + 1)
    chosen[last:] = True
    return chosen


def keyframes(time_s: Array, frames: range, cuts: Sequence[int], apart_s: float) -> Mask:
    """(T,) mask of keyframes of a recording with times `time_s` (T,): the fewest of the wanted
    `frames` that leave no gap longer than `apart_s` between cuts; all of them if `apart_s` is 0.
    """
    chosen = np.ones(len(time_s), dtype=bool)
    for segment in segments(frames, cuts) if apart_s > 0 else ():
        own = slice(segment.start, segment.stop)
        chosen[own] = spaced(time_s[own], apart_s)
    return chosen


def with_rows_between(
    rows: Reconstruction, frame: Index, time_s: Array, key: Mask, motion: MotionModel
) -> Reconstruction:
    """Add rows in the frames between keyframes, for people present in both adjacent keyframes.

    `frame` (F,) are consecutive frames, at `time_s` (F,) seconds, with the mask `key` (F,) of
    keyframes. New rows have no detections; their joints come from `motion`, and their bodies are
    interpolated. Rows are sorted by frame and person.
    """
    keys = np.flatnonzero(key)
    order = np.lexsort((rows.frame, rows.person))
    number = np.searchsorted(frame[keys], rows.frame[order])
    after = np.flatnonzero((np.diff(number) == 1) & (np.diff(rows.person[order]) == 0))
    count = np.diff(keys)[number[after]] - 1
    pair = np.repeat(after, count)
    at = keys[number[pair]] + 1 + np.arange(len(pair)) - np.repeat(np.cumsum(count) - count, count)
    return _with_interpolated(rows, order[pair], order[pair + 1], frame[at], time_s[at], motion)


def strays_m(joints: Array, velocity: Array, times_s: Array) -> Array:
    """(T - 1,) largest standard deviation of a person's joints around the cubic, half way between
    two keyframes, m.

    `joints` and `velocity` (T, J, 3), at `times_s` (T,). The standard deviation assumes white noise
    on the acceleration, with the maximum-likelihood density for the change between the two states.
    """
    lasts_s = np.diff(times_s)[:, None, None]
    moved, turned = np.diff(joints, axis=0) - lasts_s * velocity[:-1], np.diff(velocity, axis=0)
    density = (
        12 * moved**2 / lasts_s**3 - 12 * moved * turned / lasts_s**2 + 4 * turned**2 / lasts_s
    )
    variance = (
        density.sum(axis=2) / 2 * lasts_s[..., 0] ** 3 / 192
    )  # a third of 6 numbers, on 3 axes
    return np.sqrt(np.nan_to_num(variance).max(axis=1, initial=0.0))


def tracked_rows(rows: Reconstruction) -> Mask:
    """(N,) mask of rows in which people were tracked: those with a detection in any view, and those
    before the first or after the last such row of their person.
    """
    table = rows.observations
    seen = (
        np.ones(len(rows), dtype=bool)
        if table is None
        else (table.gate != Gate.NOT_SEEN).any(axis=(1, 2))
    )
    order = np.lexsort((rows.frame, rows.person))
    inside = np.zeros(len(rows), dtype=bool)
    for rows_of_person in np.split(order, np.flatnonzero(np.diff(rows.person[order])) + 1):
        inside[rows_of_person] = (np.cumsum(seen[rows_of_person]) > 0) & (
            np.cumsum(seen[rows_of_person][::-1])[::-1] > 0
        )
    return seen | ~inside


def with_rows_like(
    solved: Reconstruction, rows: Reconstruction, motion: MotionModel
) -> Reconstruction:
    """Add to the `solved` rows those of `rows` that lie between them, for the same people; joints
    and bodies of the added rows are interpolated.
    """
    order = np.lexsort((solved.frame, solved.person))
    tables = (solved.rows(order), rows)
    known, wanted = pair_keys(*((each.person, each.frame) for each in tables))
    new = np.flatnonzero(~np.isin(wanted, known))
    after = np.searchsorted(known, wanted[new])
    first, second = (order[np.clip(each, 0, len(order) - 1)] for each in (after - 1, after))
    same_person = (solved.person[first] == rows.person[new]) & (
        solved.person[second] == rows.person[new]
    )
    first, second, new = first[same_person], second[same_person], new[same_person]
    return _with_interpolated(solved, first, second, rows.frame[new], rows.time_s[new], motion)


def _with_interpolated(
    rows: Reconstruction,
    before: Index,
    after: Index,
    frame: Whole,
    time_s: Array,
    motion: MotionModel,
) -> Reconstruction:
    """Add N rows, interpolated between the rows `before` and `after` (N,); all rows are then sorted
    by frame and person.
    """
    if len(frame) == 0:
        return rows
    between = _interpolated(rows.rows(before), rows.rows(after), frame, time_s, motion)
    every = with_bodies_between(Reconstruction.concatenate([rows, between]))
    return every.rows(np.lexsort((every.person, every.frame)))


def _interpolated(
    before: Reconstruction, after: Reconstruction, frame: Whole, time_s: Array, motion: MotionModel
) -> Reconstruction:
    """N rows at `time_s` (N,), interpolated between the rows `before` and `after` in adjacent
    keyframes.
    """
    lasts_s = (after.time_s - before.time_s)[:, None, None]
    share = (time_s - before.time_s)[:, None, None] / lasts_s
    chord = (after.joints - before.joints) / lasts_s
    speeds = [
        np.where(np.isfinite(each.velocity), each.velocity, chord) for each in (before, after)
    ]
    joints, velocity = cubic(share, lasts_s, (before.joints, after.joints), (speeds[0], speeds[1]))

    # White noise on acceleration with both ends given.
    density = motion.psd_still + motion.psd_speed * np.nan_to_num(np.square(chord).sum(axis=-1))
    inside, length = (share * (1 - share))[..., 0], lasts_s[..., 0]
    of_place, of_speed = (
        density * (length * inside) ** 3 / 3,
        density * length * inside * (1 - 3 * inside),
    )

    def spread(name: str, unseen: Array) -> Array:
        ends = getattr(before, name), getattr(after, name)
        return (
            (1 - share[..., None]) * ends[0]
            + share[..., None] * ends[1]
            + unseen[..., None, None] * np.eye(3)
        )

    # The status is that of the first end unless it is good, else of the second; bodies are
    # interpolated later (`with_bodies_between`).
    fine = np.isin(before.status, (Status.OK, Status.BODY_UNDETERMINED))
    status = np.where(fine, after.status, before.status)
    placed = np.isfinite(joints).all(axis=-1)
    columns = {
        "frame": frame,
        "time_s": time_s,
        "joints": joints,
        "covariance": spread("covariance", of_place),
        "velocity": velocity,
        "velocity_covariance": spread("velocity_covariance", of_speed),
        "known": np.where(placed, Known.MOTION, Known.UNKNOWN).astype(np.uint8),
        "confidence": np.zeros_like(before.confidence),
        "status": np.where(status == Status.OK, Status.BODY_UNDETERMINED, status),
        "observations": None if before.observations is None else before.observations.unseen(frame),
    }
    return replace(
        before, **columns, **{name: np.full_like(getattr(before, name), np.nan) for name in BODY}
    )


def cubic(
    share: Array, lasts_s: Array, places: tuple[Array, Array], speeds: tuple[Array, Array]
) -> tuple[Array, Array]:
    """Position and velocity (...) at `share` (...) of `lasts_s` (...) seconds between two `places`
    (...), on the cubic with end velocities `speeds` (...).
    """
    way, s = places[1] - places[0], share
    first, second = (lasts_s * each - way for each in speeds)
    place = places[0] + s * way + s * (1 - s) * ((1 - s) * first - s * second)
    return place, (way + (1 - s) * (1 - 3 * s) * first - s * (2 - 3 * s) * second) / lasts_s


def with_bodies_between(rows: Reconstruction) -> Reconstruction:
    """The rows with interpolated bodies where they had none, between rows of the same person with a
    body: translations, and rotations as quaternions, are cubics with the slopes of their
    neighbours.
    """
    columns = {name: getattr(rows, name).copy() for name in BODY}
    status, order = rows.status.copy(), np.lexsort((rows.time_s, rows.person))
    for rows_of_person in np.split(order, np.flatnonzero(np.diff(rows.person[order])) + 1):
        ok = np.isfinite(rows.betas[rows_of_person]).all(axis=1)
        known_s = rows.time_s[rows_of_person[ok]]
        after = np.searchsorted(known_s, rows.time_s[rows_of_person])
        inside = ~ok & (after > 0) & (after < len(known_s))
        if not inside.any():
            continue
        first, second, new = after[inside] - 1, after[inside], rows_of_person[inside]
        lasts_s = known_s[second] - known_s[first]
        share = (rows.time_s[new] - known_s[first]) / lasts_s
        betas, orient, pose, transl = (columns[name][rows_of_person[ok]] for name in BODY)
        turns = _quaternions(np.concatenate([orient[:, None], pose], axis=1)).reshape(
            len(betas), -1
        )
        moving = np.concatenate([turns, transl], axis=1)
        slopes = np.gradient(moving, known_s, axis=0)
        places, speeds = (moving[first], moving[second]), (slopes[first], slopes[second])
        found = cubic(share[:, None], lasts_s[:, None], places, speeds)[0]
        turned = _rotation_vectors(found[:, :-3].reshape(len(new), -1, 4))
        bodies = betas[first], turned[:, 0], turned[:, 1:], found[:, -3:]
        for name, values in zip(BODY, bodies, strict=True):
            columns[name][new] = values
        undetermined = status[new] == Status.BODY_UNDETERMINED
        status[new[undetermined]] = Status.OK
    return replace(rows, status=status, **columns)


def _quaternions(vectors: Array) -> Array:
    """(B, K, 4) unit quaternions of rotation vectors (B, K, 3), radians; signs are continuous over
    rows.
    """
    half = np.linalg.norm(vectors, axis=-1, keepdims=True) / 2
    found = np.concatenate([np.cos(half), np.sinc(half / np.pi) / 2 * vectors], axis=-1)
    sign = np.sign((found[1:] * found[:-1]).sum(axis=-1, keepdims=True))
    found[1:] *= np.cumprod(np.where(sign < 0, -1.0, 1.0), axis=0)
    return found


def _rotation_vectors(quaternions: Array) -> Array:
    """(..., 3) rotation vectors, norm at most pi, of quaternions (..., 4) of any length."""
    w, xyz = quaternions[..., :1], quaternions[..., 1:]
    xyz = np.where(w < 0, -xyz, xyz)
    sine = np.linalg.norm(xyz, axis=-1, keepdims=True)
    angle = 2 * np.arctan2(sine, np.abs(w))
    return xyz * np.where(sine > 0, angle / np.where(sine > 0, sine, 1.0), 0.0)
