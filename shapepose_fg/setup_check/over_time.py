"""Cameras that fit in one part of a recording and not in another: bumped, drifting, or lost from some frame on.

A camera's turn is fitted in pieces of the recording. What these turns look like (one step, a line, nothing that
fits) is tried on all frames, and weighed against one turn for the whole recording.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from shapepose_fg.body.model.rotation import exp_so3, log_so3
from shapepose_fg.core.arrays import Array, Index, Mask
from shapepose_fg.setup_check import fit
from shapepose_fg.setup_check.evidence import Look
from shapepose_fg.setup_check.findings import Finding, Kind
from shapepose_fg.setup_check.fit import POSE, TURN, Others, independent, likelihood, match
from shapepose_fg.setup_check.matching import GATE, Pinhole, Sightings

_PIECES = 12
_LEAST_PEOPLE = 6
"""Fewer people of the others say nothing of a piece."""
_RESTLESS = 0.03
"""A camera is looked at closely if it sees people so far apart in two pieces, a part of their size: 5 cm."""
_LOST, _THERE, _GOOD = 0.2, 0.2, 0.45
"""Or if its score differs by the first; a piece says something from the second on (in crowds sound cameras come
to little more), and below the third other turns than its neighbours' are tried."""
_LEAST_DEG = 1.2
"""A smaller step or way is not told from a detector that errs otherwise on a person who turns round."""
_SURE = 6.0
"""By so much the logarithm of the likelihood must rise over that of the best turn that lasts."""


def warped(seen: Sightings, camera: Pinhole, turns: Array) -> Sightings:
    """What `camera` would have seen without the `turns` (S, 3), rotation vectors about its own axes."""
    back = camera.K @ exp_so3(-turns) @ np.linalg.inv(camera.K)
    h = np.einsum("sij,snj->sni", back[:, :, :2], seen.xy) + back[:, None, :, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        xy = np.where(h[..., 2:] > 0, h[..., :2] / h[..., 2:], np.nan)
    return replace(seen, xy=xy, confidence=np.where(np.isnan(xy[..., 0]), 0.0, seen.confidence))


Way = Callable[[Index], Array]
"""From frames (S,) to rotation vectors (S, 3): how a camera is turned in each, about its own axes."""


def stories(look: Look, view: int, rng: np.random.Generator) -> Iterator[tuple[Finding, Look, int]]:
    """What one camera did over time, if that explains what it saw better than a pose that lasts.

    Each with the recording as if it had not, and how many parameters that took.
    """
    others, seen, camera = look.others(view), look.seen_by(view), look.camera(view)
    if len(others) < 4 * _LEAST_PEOPLE or len(seen) < 4 * _LEAST_PEOPLE:
        return
    pieces = _Pieces.of(others, seen, camera)
    if not pieces.restless:
        return
    turns, scores = pieces.turns(rng)
    usable = (scores > _THERE) & pieces.told
    worth = independent(others)
    before = likelihood(match(others, seen, camera).score, worth, 0)
    for columns in (TURN, POSE):
        lasting = match(others, seen, fit.refined(others, seen, camera, columns)).score
        before = max(before, likelihood(lasting, worth, len(columns)))
    found = [told(pieces, turns, usable) for told in (_bumped, _drifted)] if usable.sum() >= 3 else []
    for finding, way, freedom in found:
        after = match(others, warped(seen, camera, way(seen.frame)), camera).score
        gain = likelihood(after, worth, freedom) - before
        if gain > _SURE and finding.amount > _LEAST_DEG:
            yield replace(finding, cameras=(view,)), _as_if_still(look, view, way), freedom


def _as_if_still(look: Look, view: int, way: Way) -> Look:
    """The recording as if the camera had not been turned."""
    return look.seeing(view, lambda seen: warped(seen, look.camera(view), way(seen.frame - look.lag[view])))


def turned(camera: Pinhole, turn: Array) -> Pinhole:
    """The camera turned by a rotation vector (3,) of its own axes."""
    return Pinhole(camera.K, exp_so3(turn) @ camera.cTw)


def turn_between(camera: Pinhole, other: Pinhole) -> Array:
    """(3,) the rotation vector of what turns a camera to another."""
    return log_so3(other.cTw[:, :3] @ camera.cTw[:, :3].T)


@dataclass(frozen=True)
class _Pieces:
    """One camera in pieces of the recording."""

    others: Others
    seen: Sightings
    camera: Pinhole
    edges: Array
    """(n + 1,) frames at which pieces begin, and one after the last."""
    score: Array
    """(n,) of each piece, as the camera is given."""
    shift: Array
    """(n, 2) how far right and down people are seen (median), a part of their size; NaN where too few are."""
    told: Mask
    """(n,) whether there are people enough."""

    @classmethod
    def of(cls, others: Others, seen: Sightings, camera: Pinhole) -> "_Pieces":
        both = np.intersect1d(others.frame, seen.frame)
        count = min(_PIECES, max(1, len(both) // _LEAST_PEOPLE))
        edges = (
            np.unique(np.quantile(both, np.linspace(0, 1, count + 1)).astype(np.intp)) if len(both) > 0 else [0]
        )
        edges = np.array([*edges[:-1], edges[-1] + 1])
        score, shift, told = [], [], []
        for first, last in pairwise(edges):
            few, mine = _during(others, seen, first, last)
            found = match(few, mine, camera)
            points, xy = few.points[found.person], mine.xy[found.sighting]
            off = (xy - camera.project(points)[0]) / mine.size_px[found.sighting][:, None, None]
            score.append(found.score)
            enough = found.possible >= _LEAST_PEOPLE
            told.append(enough)
            many = len(found.person) >= _LEAST_PEOPLE
            shift.append(np.nanmedian(np.nanmedian(off, axis=1), axis=0) if many else (np.nan, np.nan))
        return cls(others, seen, camera, edges, np.array(score), np.array(shift), np.array(told, dtype=bool))

    @property
    def restless(self) -> bool:
        """Whether pieces differ."""
        score, shift = self.score[self.told], self.shift[self.told]
        if len(score) < 3 or score.max() < _THERE:
            return False
        shift = shift[~np.isnan(shift[:, 0])]
        way = np.ptp(shift, axis=0).max(initial=0.0) if len(shift) > 0 else 0.0
        return bool(np.ptp(score) > _LOST or way > _RESTLESS)

    @property
    def middle(self) -> Array:
        """(n,) the frames in the middle of the pieces."""
        return (self.edges[:-1] + self.edges[1:] - 1) / 2

    def turns(self, rng: np.random.Generator) -> tuple[Array, Array]:
        """(n, 3) the turn that fits each piece best, and (n,) how well; each from the next one that fits."""
        n = len(self.score)
        turns, scores = np.zeros((n, 3)), np.zeros(n)
        best = int(np.argmax(np.where(self.told, self.score, -1)))
        for k in [*range(best, n), *range(best - 1, -1, -1)]:
            near = k - 1 if k > best else k + 1
            start = np.zeros(3) if k == best else turns[near]
            few, mine = _during(self.others, self.seen, self.edges[k], self.edges[k + 1])
            if not self.told[k]:
                turns[k] = start
                continue
            tried = [self.camera, turned(self.camera, start)]
            found = [self._fitted(few, mine, each) for each in tried[: 1 if k == best else 2]]
            if max(score for score, _ in found) < _GOOD:
                pairs = list(fit.tries(few, mine, rng))
                sole = fit.best_of(few, mine, self.camera, pairs, fit.turned_to)
                found += [] if sole is None else [self._fitted(few, mine, sole)]
            scores[k], chosen = max(found, key=lambda pair: pair[0])
            turns[k] = turn_between(self.camera, chosen)
        return turns, scores

    @staticmethod
    def _fitted(others: Others, seen: Sightings, camera: Pinhole) -> tuple[float, Pinhole]:
        new = fit.refined(others, seen, camera, TURN)
        return match(others, seen, new).score, new


def _during(others: Others, seen: Sightings, first: int, last: int) -> tuple[Others, Sightings]:
    """What is of some frames only."""
    there, here = ((each.frame >= first) & (each.frame < last) for each in (others, seen))
    return others.rows(there), seen.rows(here)


def _bumped(pieces: "_Pieces", turns: Array, usable: Mask) -> tuple[Finding, Way, int]:
    """One step from one turn to another, and what it has of parameters."""
    others, seen, camera = pieces.others, pieces.seen, pieces.camera
    where = np.flatnonzero(usable)
    cost = []
    for j in range(1, len(where)):
        parts = turns[where[:j]], turns[where[j:]]
        cost.append(sum(np.abs(each - np.median(each, axis=0)).sum() for each in parts))
    j = int(np.argmin(cost)) + 1
    before, after = np.median(turns[where[:j]], axis=0), np.median(turns[where[j:]], axis=0)
    rest = np.deg2rad(_LEAST_DEG)
    before, after = (np.where(np.linalg.norm(each) < rest, 0.0, 1.0) * each for each in (before, after))
    for _ in range(2):
        at = _step(others, seen, camera, before, after)
        sides = []
        for turn, first, last in ((before, -1, at), (after, at, np.iinfo(np.intp).max)):
            few, mine = _during(others, seen, first, last)
            if turn.any() and len(few) > 0 and len(mine) > 0:
                new = fit.refined(few, mine, turned(camera, turn), TURN)
                turn = turn_between(camera, new)
            sides.append(turn)
        before, after = sides
    amount = fit.difference(turned(camera, after).cTw, turned(camera, before).cTw)[0]

    def way(frame: Index) -> Array:
        return np.where((frame < at)[:, None], before, after)

    first_wrong = np.linalg.norm(before) > np.linalg.norm(after)
    frames = (None, at) if first_wrong else (at, None)
    freedom = 1 + 3 * int(before.any()) + 3 * int(after.any())
    return Finding(Kind.BUMPED, (), amount, frames=frames), way, freedom


def _step(others: Others, seen: Sightings, camera: Pinhole, before: Array, after: Array) -> int:
    """The first frame that fits one turn better than the other, when those before it fit the other better."""
    frames = np.unique(others.frame)
    worth = np.zeros((2, len(frames)))
    for row, turn in enumerate((before, after)):
        found = match(others, seen, turned(camera, turn))
        place = np.searchsorted(frames, others.frame[found.person])
        worth[row] = np.bincount(place, 1 - found.error / GATE, minlength=len(frames))
    total = np.concatenate([[0], np.cumsum(worth[0])]) + np.concatenate([np.cumsum(worth[1][::-1])[::-1], [0]])
    return int(frames[min(int(np.argmax(total)), len(frames) - 1)])


def _drifted(pieces: "_Pieces", turns: Array, usable: Mask) -> tuple[Finding, Way, int]:
    """A turn that grows with time, and what it has of parameters."""
    t, w = pieces.middle[usable], turns[usable]
    first, last = float(pieces.edges[0]), float(pieces.edges[-1] - 1)
    A = np.column_stack([np.ones(len(t)), t - first])
    weight = np.ones(len(t))
    for _ in range(5):
        line = np.linalg.lstsq(A * weight[:, None], w * weight[:, None], rcond=None)[0]
        off = np.linalg.norm(w - A @ line, axis=1)
        weight = 1 / np.sqrt(1 + (off / np.deg2rad(0.5)) ** 2)

    def way(frame: Index) -> Array:
        return line[0] + (frame - first)[:, None] * line[1]

    amount = float(np.rad2deg(np.linalg.norm(line[1]) * (last - first)))
    return Finding(Kind.DRIFTING, (), amount), way, 6


_PARTED, _LEAST_PART, _POOR = 0.3, 0.15, 0.5
"""Two cameras, whose rays have only to meet, stop to agree where their score falls by so much, with this part of
the people on either side, and to so little."""


def parted(look: Look) -> tuple[int | None, int | None] | None:
    """The frames in which two cameras do not agree, where they do in the others; of more, `stories` are told."""
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
