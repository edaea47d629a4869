"""What may be wrong with a set-up, each as a change that would put it right."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from enum import StrEnum

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
from shapepose_fg.setup_check.lag import Lag, find_lag
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


_PRICE = 0.02
"""What a fitted parameter must bring of the score: half a centimetre of a person's joints is 0.02."""


def worth(change: Change) -> float:
    """The score of a change, less the price of its parameters."""
    return change.score - _PRICE * change.freedom


def of_one(look: Look, view: int, rng: np.random.Generator) -> Iterator[Change]:
    """Changes of one camera that fit it to the people whom the others see, the best of each kind."""
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
    """Two cameras exchanged, as the people whom all others see say it; None where they see nobody."""
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
