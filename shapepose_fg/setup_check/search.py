"""Which change of a set-up explains best why it does not fit: one mistake after the other."""

from itertools import combinations

import numpy as np

from shapepose_fg.setup_check.changes import Change, Kind, lag_of, of_all, of_one, of_pose, of_two, worth
from shapepose_fg.setup_check.evidence import Look
from shapepose_fg.setup_check.lag import Lag, is_offset

GOOD = 0.45
"""A camera that matches the others' people so well is where it is said to be, but for small errors."""
_GAIN = 0.25
"""What a change must bring of a camera's score to be named."""
_EXPLAINED = 0.65
"""Everything fits so well where nothing but detectors err, or little more: no other explanation is sought."""
_LEAST_FRAMES = 40
"""In fewer frames people hardly move far enough to tell a small offset in time from chance: in 20 frames of the
built-in scene a camera that is in time looked 4 frames early."""
_FEW = 40
"""Frames that are enough for what all cameras share."""


def gross_mistake(look: Look, rng: np.random.Generator) -> Change | None:
    """The change that explains best why cameras do not see the same people; None where they do, or none does."""
    fits = look.scores
    weak = np.flatnonzero(fits < GOOD).tolist()
    if len(weak) == 0:
        return None
    found: list[tuple[float, Change]] = []
    for view in weak:
        options = [c for c in of_one(look, view, rng) if c.score - fits[view] > _GAIN]
        options.sort(key=worth, reverse=True)
        found += [(_judged(look, change), change) for change in options[:2]]
    for first, second in combinations(weak, 2):
        change = of_two(look, first, second)
        if change is not None and change.score - max(fits[first], fits[second]) > _GAIN:
            found.append((_judged(look, change), change))
        elif look.view_count == 3:
            change = Change(Kind.EXCHANGED, (first, second), look.setup.exchanged(first, second), 1.0, 0)
            found.append((_judged(look, change), change))
    if look.view_count == 2:
        found += [(change.score - look.total, change) for view in (0, 1) for change in of_pose(look, view)]
    fit = max((gain for gain, _ in found), default=0.0) + look.total
    if len(weak) > look.view_count / 2 and fit < _EXPLAINED:
        few = Look(look.evidence.thinned(_FEW), look.setup)
        found += [(change.score - few.total, change) for change in of_all(few)]
    found = [(gain, change) for gain, change in found if gain > _GAIN / look.view_count]
    return max(found, key=lambda pair: pair[0])[1] if found else None


def _judged(look: Look, change: Change) -> float:
    """How much better everything fits after a change, less the price of its parameters."""
    return Look(look.evidence, change.setup).total - look.total - 0.02 * change.freedom / look.view_count


def lags(look: Look) -> list[Lag]:
    """Each camera's offset in time against the others; none is told in a short recording that fits as it is."""
    if len(np.unique(look.evidence.sightings.frame)) < _LEAST_FRAMES:
        return [Lag(0, 0.0, 0.0)] * look.view_count
    return [lag_of(look, view) for view in range(look.view_count)]


def latest(look: Look, found: list[Lag]) -> Change | None:
    """The camera whose offset in time explains most; None where there is no offset."""
    named = [view for view, lag in enumerate(found) if abs(lag.frames) >= 2 and is_offset(lag)]
    if len(named) == 0:
        return None
    view = max(named, key=lambda view: found[view].gain)
    frames = found[view].frames
    return Change(Kind.LATE, (view,), look.setup.later(view, frames), found[view].gain, 1, frames)
