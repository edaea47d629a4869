"""Gross mistakes of a set-up, each tried as a change that would put it right; and which explains best."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.setup_check.adjustment import FOCAL, POSE, TURN
from shapepose_fg.setup_check.evidence import Look, Setup
from shapepose_fg.setup_check.findings import Finding, Kind
from shapepose_fg.setup_check.fit import (
    CORNER,
    Others,
    Pinhole,
    difference,
    match,
    posed_to,
    refined,
    resized_to,
    scaled,
    tries,
    turned_to,
    zoomed_to,
)
from shapepose_fg.setup_check.lag import lag_of
from shapepose_fg.setup_check.sightings import Sightings

Array = NDArray[np.float64]
Fit = Callable[[Array, Array, Pinhole], Pinhole | None]

_MISREAD: dict[Kind, Callable[[Array, Array], tuple[Array, Array]]] = {
    Kind.INVERTED: lambda R, t: (R.T, -R.T @ t),
    Kind.TRANSPOSED: lambda R, t: (R.T, t),
    Kind.AXES: lambda R, t: (np.diag([1.0, -1.0, -1.0]) @ R, t * (1.0, -1.0, -1.0)),
}
"""What a pose is after the usual misunderstandings of its file: of one camera, or of all."""
_FITTED: tuple[tuple[Kind, Fit, list[int]], ...] = (
    (Kind.TURNED, turned_to, TURN),
    (Kind.MOVED, posed_to, POSE),
    (Kind.FOCAL, zoomed_to, FOCAL),
    (Kind.RESIZED, resized_to, []),
)
"""What is fitted of one camera: to one person exactly, then its parameters (`adjustment.PARAMETERS`) to all."""
_FACTORS = (0.25, 1 / 3, 0.5, 2 / 3, 0.75, 4 / 3, 1.5, 2.0, 3.0, 4.0)
"""Sizes of pictures that are made of others, for all cameras alike."""

GOOD = 0.45
"""A camera that matches the others' people so well is where it is said to be, but for small errors."""
_GAIN = 0.25
"""What a change must bring of a camera's score to be named."""
_EXPLAINED = 0.65
"""Everything fits so well where nothing but detectors err, or little more: no other explanation is sought."""
_FEW = 40
"""Frames that are enough for what all cameras share."""
_PRICE = 0.02
"""What a fitted parameter must bring of the score: half a centimetre of a person's joints is 0.02."""
_PLAIN_TURN_DEG = 3.0
"""A camera that is turned by more is called turned, wherever it is."""


@dataclass(frozen=True)
class Change:
    """A change of the set-up, and what it brings."""

    finding: Finding
    """What is wrong if the change is right."""
    setup: Setup
    """The set-up after it."""
    score: float
    """How well the camera fits the others after it (`Match.score`); all cameras, for what all share."""
    freedom: int = 0
    """Parameters that were fitted."""


def gross_mistake(look: Look, rng: np.random.Generator) -> Change | None:
    """The change that explains best why cameras do not see the same people; None where they do, or none does."""
    fits = look.scores
    weak = np.flatnonzero(fits < GOOD).tolist()
    if len(weak) == 0:
        return None
    found: list[tuple[float, Change]] = []
    for view in weak:
        options = [change for change in _of_one(look, view, rng) if change.score - fits[view] > _GAIN]
        options.sort(key=lambda change: change.score - _PRICE * change.freedom, reverse=True)
        found += [(_judged(look, change), change) for change in options[:2]]
    for first, second in combinations(weak, 2):
        change = _of_two(look, first, second)
        if look.view_count == 3 or (change.score - max(fits[first], fits[second]) > _GAIN):
            found.append((_judged(look, change), change))
    if look.view_count == 2:
        poses = [_misread(look, kind, (view,)) for view in (0, 1) for kind in _MISREAD]
        found += [(change.score - look.total, change) for change in poses]
    fit = max((gain for gain, _ in found), default=0.0) + look.total
    if len(weak) > look.view_count / 2 and fit < _EXPLAINED:
        few = Look(look.evidence.thinned(_FEW), look.setup)
        found += [(change.score - few.total, change) for change in _of_all(few)]
    found = [(gain, change) for gain, change in found if gain > _GAIN / look.view_count]
    return max(found, key=lambda pair: pair[0])[1] if found else None


def _judged(look: Look, change: Change) -> float:
    """How much better everything fits after a change, less the price of its parameters."""
    return Look(look.evidence, change.setup).total - look.total - _PRICE * change.freedom / look.view_count


def _of_one(look: Look, view: int, rng: np.random.Generator) -> Iterator[Change]:
    """Changes of one camera that fit it to the people that the others see, the best of each kind."""
    others, seen, camera = look.others(view), look.seen_by(view), look.setup.camera(view)
    if len(others) == 0 or len(seen) == 0:
        return
    for kind in _MISREAD:
        setup = look.setup.with_cameras({view: misread(kind, camera)})
        yield Change(Finding(kind, (view,)), setup, match(others, seen, setup.camera(view)).score)
    lag = lag_of(look, view).frames
    score = match(others, look.seen_by(view, every_frame=True), camera, lag).score
    yield Change(Finding(Kind.LATE, (view,), lag), look.setup.later(view, lag), score, 1)
    pairs = list(tries(others, seen, rng))
    for kind, fitted, columns in _FITTED:
        best = _best(others, seen, camera, pairs, fitted)
        if best is None:
            continue
        best = refined(others, seen, best, columns) if columns else best
        turn, moved = difference(camera.cTw, best.cTw)
        size = float(best.K[0, 0] / camera.K[0, 0])
        amount = {Kind.FOCAL: 1 / size, Kind.RESIZED: size}.get(
            kind, turn
        )  # what the calibration has over what fits
        finding = Finding(Kind.TURNED if turn > _PLAIN_TURN_DEG else kind, (view,), amount, moved=moved)
        setup = look.setup.with_cameras({view: best})
        yield Change(finding, setup, match(others, seen, best).score, max(len(columns), 1))


def _best(
    others: Others, seen: Sightings, camera: Pinhole, pairs: list[tuple[Array, Array]], fitted: Fit
) -> Pinhole | None:
    """Of the cameras that fit one person exactly, the one that fits all people best."""
    step = max(1, len(others) // 40)
    few = Others(others.frame[::step], others.points[::step])
    tried = [each for points, xy in pairs if (each := fitted(points, xy, camera)) is not None]
    score, best = max(
        ((match(few, seen, each).score, each) for each in tried), key=lambda pair: pair[0], default=(0, None)
    )
    return best if score > 0 else None


def _of_two(look: Look, first: int, second: int) -> Change:
    """Two cameras exchanged, as the people that all others see say it; scored 0 where they see none."""
    others = look.others(first, second)
    setup = look.setup.with_cameras({first: look.setup.camera(second), second: look.setup.camera(first)})
    score = min(match(others, look.seen_by(view), setup.camera(view)).score for view in (first, second))
    return Change(Finding(Kind.EXCHANGED, (first, second)), setup, score)


def _of_all(look: Look) -> Iterator[Change]:
    """Mistakes that all cameras share."""
    everybody = tuple(range(look.view_count))
    for kind in _MISREAD:
        yield _misread(look, kind, everybody)
    for factor in _FACTORS:
        cameras = {view: scaled(look.setup.camera(view), factor, CORNER) for view in everybody}
        yield _whole(look, Finding(Kind.RESIZED, everybody, factor), cameras)


def _misread(look: Look, kind: Kind, views: tuple[int, ...]) -> Change:
    """The poses of some cameras misunderstood, by how well all fit."""
    return _whole(look, Finding(kind, views), {view: misread(kind, look.setup.camera(view)) for view in views})


def _whole(look: Look, finding: Finding, cameras: dict[int, Pinhole]) -> Change:
    """A change that is judged by how well everything fits."""
    setup = look.setup.with_cameras(cameras)
    return Change(finding, setup, Look(look.evidence, setup).total)


def misread(kind: Kind, camera: Pinhole) -> Pinhole:
    """The camera with its pose after one of the usual misunderstandings."""
    R, t = _MISREAD[kind](camera.cTw[:, :3], camera.cTw[:, 3])
    return Pinhole(camera.K, np.column_stack([R, t]))
