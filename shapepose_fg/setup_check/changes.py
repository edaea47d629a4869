"""What may be wrong with a set-up, each as a change that would put it right; and which explains best."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from enum import StrEnum
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.camera import Views
from shapepose_fg.setup_check.adjustment import FOCAL, POSE, TURN
from shapepose_fg.setup_check.evidence import Look, Setup
from shapepose_fg.setup_check.fit import (
    Others,
    Pinhole,
    difference,
    match,
    posed_to,
    refined,
    resized_to,
    scaled_picture,
    tries,
    turned_to,
    zoomed_to,
)
from shapepose_fg.setup_check.lag import Lag, find_lag, is_offset
from shapepose_fg.setup_check.sightings import Sightings

Array = NDArray[np.float64]


class Kind(StrEnum):
    """What a mistake looks like."""

    TURNED = "turned"
    MOVED = "moved"
    LATE = "late"
    EXCHANGED = "exchanged"
    INVERTED = "inverted extrinsics"
    TRANSPOSED = "transposed rotation"
    AXES = "other camera axes"
    FOCAL = "focal length"
    RESIZED = "picture size"
    PRINCIPAL_POINT = "principal point"
    DUPLICATE = "duplicate"
    UNIT = "unit"
    UP = "up axis"
    NOBODY = "nobody"
    UNFIT = "does not fit"
    PICTURE_SIZE = "size of the pictures"


@dataclass(frozen=True)
class Change:
    """A change of the set-up, and what it brings."""

    kind: Kind
    cameras: tuple[int, ...]
    """Cameras that it changes; all of them for a mistake that all share."""
    setup: Setup
    """The set-up after it."""
    score: float
    """How well the camera fits the others after it (`Match.score`)."""
    freedom: int
    """Parameters that were fitted."""
    amount: float = 0.0
    """Degrees, frames, or the factor."""
    moved: float = 0.0
    """How far the camera was moved, the calibration's unit."""


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
_PRICE = 0.02
"""What a fitted parameter must bring of the score: half a centimetre of a person's joints is 0.02."""


def worth(change: Change) -> float:
    """The score of a change, less the price of its parameters."""
    return change.score - _PRICE * change.freedom


def of_one(look: Look, view: int, rng: np.random.Generator) -> Iterator[Change]:
    """Changes of one camera that fit it to the people that the others see, the best of each kind."""
    others, seen, camera = look.others(view), look.seen_by(view), look.setup.camera(view)
    if len(others) == 0 or len(seen) == 0:
        return
    for kind, other in known_forms(camera):
        score = match(others, seen, other).score
        yield Change(kind, (view,), look.setup.with_camera(view, other), score, 0)
    lag = lag_of(look, view)
    late = match(others, look.seen_by(view, every_frame=True), camera, lag.frames).score
    yield Change(Kind.LATE, (view,), look.setup.later(view, lag.frames), late, 1, lag.frames)
    families = (
        (Kind.TURNED, turned_to, TURN),
        (Kind.MOVED, posed_to, POSE),
        (Kind.FOCAL, zoomed_to, FOCAL),
        (Kind.RESIZED, resized_to, []),
    )
    pairs = list(tries(others, seen, rng))
    for kind, fitted, columns in families:
        best = _best(others, seen, camera, pairs, fitted)
        if best is None:
            continue
        best = refined(others, seen, best, tuple(columns)) if columns else best
        score = match(others, seen, best).score
        turn, move = difference(camera.cTw, best.cTw)
        amount = turn if kind in (Kind.TURNED, Kind.MOVED) else float(best.K[0, 0] / camera.K[0, 0])
        yield Change(kind, (view,), look.setup.with_camera(view, best), score, max(len(columns), 1), amount, move)


def lag_of(look: Look, view: int, most: int | None = None) -> Lag:
    """A camera's offset in time against the others, up to `most` frames."""
    limit = look.evidence.most_lag if most is None else min(most, look.evidence.most_lag)
    return find_lag(look.others(view), look.seen_by(view, every_frame=True), look.setup.camera(view), limit)


def of_two(look: Look, first: int, second: int) -> Change | None:
    """Two cameras exchanged, as the people that all others see say it; None where they see none."""
    others = look.others(first, second)
    setup = look.setup.exchanged(first, second)
    if len(others) == 0:
        return None
    scores = [match(others, look.seen_by(view), setup.camera(view)).score for view in (first, second)]
    return Change(Kind.EXCHANGED, (first, second), setup, min(scores), 0)


def of_pose(look: Look, view: int) -> Iterator[Change]:
    """Misunderstandings of one camera's pose, by how well all fits: for a rig of two."""
    for kind, other in known_forms(look.setup.camera(view)):
        setup = look.setup.with_camera(view, other)
        yield Change(kind, (view,), setup, Look(look.evidence, setup).total, 0)


def of_all(look: Look) -> Iterator[Change]:
    """Mistakes that all cameras share."""
    setup, everybody = look.setup, tuple(range(look.view_count))
    cameras = [setup.camera(view) for view in everybody]
    forms: dict[Kind, list[Pinhole]] = {}
    for camera in cameras:
        for kind, other in known_forms(camera):
            forms.setdefault(kind, []).append(other)
    for kind, changed in forms.items():
        yield _all(look, kind, changed, 1.0)
    for factor in _FACTORS:
        resized = [Pinhole(scaled_picture(camera.K, factor), camera.cTw) for camera in cameras]
        yield _all(look, Kind.RESIZED, resized, factor)


_FACTORS = (0.25, 1 / 3, 0.5, 2 / 3, 0.75, 4 / 3, 1.5, 2.0, 3.0, 4.0)
"""Sizes of pictures that are made of others."""


def _all(look: Look, kind: Kind, cameras: list[Pinhole], amount: float) -> Change:
    views = Views(np.stack([camera.K for camera in cameras]), np.stack([camera.cTw for camera in cameras]))
    setup = Setup(views, look.setup.lag)
    score = Look(look.evidence, setup).total
    return Change(kind, tuple(range(len(cameras))), setup, score, 0, amount)


def known_forms(camera: Pinhole) -> Iterator[tuple[Kind, Pinhole]]:
    """What a pose is after the usual misunderstandings of its file."""
    R, t = camera.cTw[:, :3], camera.cTw[:, 3]
    yield Kind.INVERTED, Pinhole(camera.K, np.column_stack([R.T, -R.T @ t]))
    yield Kind.TRANSPOSED, Pinhole(camera.K, np.column_stack([R.T, t]))
    yield Kind.AXES, Pinhole(camera.K, np.diag([1.0, -1.0, -1.0]) @ camera.cTw)


def _best(
    others: Others,
    seen: Sightings,
    camera: Pinhole,
    pairs: list[tuple[Array, Array]],
    fitted: Callable[[Array, Array, Pinhole], Pinhole | None],
) -> Pinhole | None:
    """Of the cameras that fit one person exactly, the one that fits all people best."""
    few = Others(others.frame[:: max(1, len(others) // 40)], others.points[:: max(1, len(others) // 40)])
    best, most = None, 0.0
    for points, xy in pairs:
        tried = fitted(points, xy, camera)
        score = 0.0 if tried is None else match(few, seen, tried).score
        if score > most:
            best, most = tried, score
    return best


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
    return Look(look.evidence, change.setup).total - look.total - _PRICE * change.freedom / look.view_count


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
