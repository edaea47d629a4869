"""Cameras that fit in one part of a recording only: bumped, drifting, or wrong from some frame on.

A camera's rotation is fitted in pieces of the recording. Models of these rotations (one step, a
linear drift) are fitted to all frames, and compared by likelihood with one rotation for the whole
recording.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import pairwise

import numpy as np

from shapepose_fg.body.model.rotation import exp_so3, log_so3
from shapepose_fg.core.arrays import Array, Index
from shapepose_fg.setup_check import fit
from shapepose_fg.setup_check.evidence import Look
from shapepose_fg.setup_check.findings import Finding, Kind
from shapepose_fg.setup_check.fit import POSE, TURN, Others, independent, likelihood, match
from shapepose_fg.setup_check.matching import GATE, Pinhole, Sightings

_PIECES = 12
_LEAST_PEOPLE = 6
"""Minimum number of the others' people for a piece to be used, and on either side of a step."""
_RESTLESS = 0.1
"""Difference of a camera's score between pieces above which it is examined: 3 cm on people."""
_THERE, _GOOD = 0.2, 0.45
"""Minimum score for a piece to be used (in crowds correct cameras have little more), and score
below which rotations other than the neighbouring pieces' are tried."""
_LEAST_DEG = 1.2
"""Minimum step or drift, degrees; smaller ones may be detector errors that depend on people's
orientation."""
_SURE = 6.0
"""Minimum gain in log-likelihood over the best constant rotation."""


def warped(seen: Sightings, camera: Pinhole, turns: Array) -> Sightings:
    """Sightings as `camera` would have them without the rotations `turns` (S, 3), vectors about its
    own axes.
    """
    back = camera.K @ exp_so3(-turns) @ np.linalg.inv(camera.K)
    h = np.einsum("sij,snj->sni", back[:, :, :2], seen.xy) + back[:, None, :, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        xy = np.where(h[..., 2:] > 0, h[..., :2] / h[..., 2:], np.nan)
    return replace(seen, xy=xy, confidence=np.where(np.isnan(xy[..., 0]), 0.0, seen.confidence))


Way = Callable[[Index], Array]
"""Function from frames (S,) to rotation vectors (S, 3) of a camera about its own axes."""


def stories(look: Look, view: int, rng: np.random.Generator) -> Iterator[tuple[Finding, Look, int]]:
    """Findings on motions of one camera over time that explain its sightings better than a constant
    pose.

    Each comes with the corrected look, and the number of parameters.
    """
    pieces, spans, score = in_pieces(look, view)
    if restlessness(score) < _RESTLESS:
        return
    others, seen, camera = look.others(view), look.seen_by(view), look.camera(view)
    turns, scores = _turns(pieces, camera, int(score.argmax()), rng)
    usable = scores > _THERE
    if usable.sum() < 3:
        return
    worth = independent(others)
    before = likelihood(match(others, seen, camera).score, worth, 0)
    for columns in (TURN, POSE):
        lasting = match(others, seen, fit.refined(others, seen, camera, columns)).score
        before = max(before, likelihood(lasting, worth, len(columns)))
    middle = (spans.sum(axis=1)[usable] - 1) / 2
    both = np.intersect1d(others.frame, seen.frame)
    found = (
        _bumped(others, seen, camera, turns[usable]),
        _drifted(middle, turns[usable], both[0], both[-1]),
    )
    for finding, way, freedom in found:
        after = match(others, warped(seen, camera, way(seen.frame)), camera).score
        gain = likelihood(after, worth, freedom) - before
        if gain > _SURE and finding.amount > _LEAST_DEG:
            yield replace(finding, cameras=(view,)), _as_if_still(look, view, way), freedom


def restlessness(score: Array) -> float:
    """Difference of a camera's `score` (n,) between pieces of the recording; 0 if they are too few,
    or if the camera fits in none.
    """
    return float(np.ptp(score)) if len(score) >= 3 and score.max() >= _THERE else 0.0


def in_pieces(
    look: Look, view: int, frames: int = _LEAST_PEOPLE
) -> tuple[list[tuple[Others, Sightings]], Array, Array]:
    """The n pieces, of at least so many `frames`, in which a camera sees enough of the others'
    people: people and sightings, first frame and that after the last (n, 2), and the camera's score
    (n,).
    """
    others, seen = look.others(view), look.seen_by(view)
    both = np.intersect1d(others.frame, seen.frame)
    if min(len(others), len(seen)) < 4 * _LEAST_PEOPLE or len(both) == 0:
        return [], np.zeros((0, 2)), np.zeros(0)
    count = min(_PIECES, max(1, len(both) // frames))
    ends = np.unique(np.quantile(both, np.linspace(0, 1, count + 1)).astype(np.intp))
    ends[-1] += 1
    spans = np.array(list(pairwise(ends.tolist())))
    pieces = [_during(others, seen, *span) for span in spans]
    matched = [match(*piece, look.camera(view)) for piece in pieces]
    enough = [n for n, each in enumerate(matched) if each.possible >= _LEAST_PEOPLE]
    score = np.array([matched[n].score for n in enough])
    return [pieces[n] for n in enough], spans[enough], score


def _as_if_still(look: Look, view: int, way: Way) -> Look:
    """The look corrected for the rotations of a camera."""
    return look.seeing(
        view, lambda seen: warped(seen, look.camera(view), way(seen.frame - look.lag[view]))
    )


def _during(others: Others, seen: Sightings, first: float, last: float) -> tuple[Others, Sightings]:
    """People and sightings in the frames from `first` to before `last`."""
    there, here = ((each.frame >= first) & (each.frame < last) for each in (others, seen))
    return others.rows(there), seen.rows(here)


def _turns(
    pieces: list[tuple[Others, Sightings]], camera: Pinhole, best: int, rng: np.random.Generator
) -> tuple[Array, Array]:
    """(n, 3) rotation that fits each piece best, and (n,) its score; from the `best` piece towards
    both ends, each initialised by the piece before.
    """
    n = len(pieces)
    turns, scores = np.zeros((n, 3)), np.zeros(n)
    for k in [*range(best, n), *range(best - 1, -1, -1)]:
        starts = [camera] if k == best else [camera, _turned(camera, turns[k - np.sign(k - best)])]
        found = [fit.refined(*pieces[k], start, TURN) for start in starts]
        if max(match(*pieces[k], each).score for each in found) < _GOOD:
            sole = fit.best_of(*pieces[k], camera, list(fit.tries(*pieces[k], rng)), fit.turned_to)
            found += [] if sole is None else [fit.refined(*pieces[k], sole, TURN)]
        chosen = max(found, key=lambda each: match(*pieces[k], each).score)
        turns[k], scores[k] = _turn_between(camera, chosen), match(*pieces[k], chosen).score
    return turns, scores


def _turned(camera: Pinhole, turn: Array) -> Pinhole:
    """The camera rotated by a rotation vector (3,) about its own axes."""
    return Pinhole(camera.K, exp_so3(turn) @ camera.cTw)


def _turn_between(camera: Pinhole, other: Pinhole) -> Array:
    """(3,) rotation vector from one camera to another."""
    return log_so3(other.cTw[:, :3] @ camera.cTw[:, :3].T)


def _bumped(
    others: Others, seen: Sightings, camera: Pinhole, turns: Array
) -> tuple[Finding, Way, int]:
    """One step between two rotations, from the `turns` (n, 3) of pieces, and its number of
    parameters.
    """
    splits = [(turns[:j], turns[j:]) for j in range(1, len(turns))]
    split = min(
        splits,
        key=lambda parts: sum(np.abs(each - np.median(each, axis=0)).sum() for each in parts),
    )
    before, after = (np.median(each, axis=0) for each in split)
    rest = np.deg2rad(_LEAST_DEG)
    before, after = (
        np.where(np.linalg.norm(each) < rest, 0.0, 1.0) * each for each in (before, after)
    )
    for _ in range(2):
        at = _step(others, seen, camera, before, after)
        before = _settled(*_during(others, seen, -1, at), camera, before)
        after = _settled(*_during(others, seen, at, np.inf), camera, after)
    amount = fit.difference(_turned(camera, after).cTw, _turned(camera, before).cTw)[0]
    parts = (_during(others, seen, *span) for span in ((-1, at), (at, np.inf)))
    if min(match(*part, camera).possible for part in parts) < _LEAST_PEOPLE:
        amount = 0.0  # what a few frames show may be lasting errors of the detector
    frames = (None, at) if np.linalg.norm(before) > np.linalg.norm(after) else (at, None)
    finding = Finding(Kind.BUMPED, (), amount, frames=frames)
    return (
        finding,
        lambda frame: np.where((frame < at)[:, None], before, after),
        1 + 3 * int(before.any()) + 3 * int(after.any()),
    )


def _settled(others: Others, seen: Sightings, camera: Pinhole, turn: Array) -> Array:
    """(3,) a non-zero rotation, fitted to some frames."""
    if not turn.any() or min(len(others), len(seen)) == 0:
        return turn
    return _turn_between(camera, fit.refined(others, seen, _turned(camera, turn), TURN))


def _step(others: Others, seen: Sightings, camera: Pinhole, before: Array, after: Array) -> int:
    """The frame at which switching from one rotation to the other fits best."""
    frames = np.unique(others.frame)
    worth = np.zeros((2, len(frames)))
    for row, turn in enumerate((before, after)):
        found = match(others, seen, _turned(camera, turn))
        place = np.searchsorted(frames, others.frame[found.person])
        worth[row] = np.bincount(place, 1 - found.error / GATE, minlength=len(frames))
    total = np.concatenate([[0], np.cumsum(worth[0])]) + np.concatenate(
        [np.cumsum(worth[1][::-1])[::-1], [0]]
    )
    return int(frames[min(int(np.argmax(total)), len(frames) - 1)])


def _drifted(t: Array, turns: Array, first: int, last: int) -> tuple[Finding, Way, int]:
    """A rotation linear in time, from the `turns` (n, 3) of pieces at frames `t` (n,), and its
    number of parameters.
    """
    A = np.column_stack([np.ones(len(t)), t - first])
    weight = np.ones(len(t))
    for _ in range(5):
        line = np.linalg.lstsq(A * weight[:, None], turns * weight[:, None], rcond=None)[0]
        off = np.linalg.norm(turns - A @ line, axis=1)
        weight = 1 / np.sqrt(1 + (off / np.deg2rad(0.5)) ** 2)
    amount = float(np.rad2deg(np.linalg.norm(line[1]) * (last - first)))
    return (
        Finding(Kind.DRIFTING, (), amount),
        lambda frame: line[0] + (frame - first)[:, None] * line[1],
        6,
    )


_PARTED, _LEAST_PART, _POOR = 0.3, 0.15, 0.5
"""Criteria for two cameras, with rays that only need to intersect, to stop agreeing: the drop of
the score, the share of people on either side, and the maximum score after it."""


def parted(look: Look) -> tuple[int | None, int | None] | None:
    """The frames in which two cameras disagree though they agree in the others; for more cameras
    see `stories`.
    """
    views, last = np.unique(look.sightings.view).tolist(), int(look.sightings.frame.max()) + 1
    if len(views) != 2:
        return None
    groups, error, _ = look.pair(*views)
    counts = [np.bincount(look.seen_by(view).frame, minlength=last) for view in views]
    fits = np.cumsum(np.bincount(groups.frame, 1 - error / GATE, minlength=last))
    possible = np.cumsum(np.minimum(*counts))
    if possible[-1] == 0:
        return None
    rest = possible[-1] - possible
    before, after = fits / np.maximum(possible, 1), (fits[-1] - fits) / np.maximum(rest, 1)
    enough = np.minimum(possible, rest) > _LEAST_PART * possible[-1]
    at = int(np.argmax(np.where(enough, np.abs(before - after) * np.sqrt(possible * rest), 0.0)))
    low, high = sorted((before[at], after[at]))
    if not enough[at] or high - low < _PARTED or low > _POOR:
        return None
    return (None, at + 1) if before[at] < after[at] else (at + 1, None)
