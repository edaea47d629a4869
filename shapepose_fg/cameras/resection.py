"""Fit of one camera to the people that the others see, and estimates of changes that improve it."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from shapepose_fg.cameras.parameters import by_parameters, changed_one, seen_by
from shapepose_fg.cameras.sightings import (
    GATE,
    MIN_JOINTS,
    Pinhole,
    Sightings,
    distances,
    same_frame,
)
from shapepose_fg.core.arrays import Array, Index
from shapepose_fg.core.camera import HALF_PIXEL, Views
from shapepose_fg.core.decompositions import nearest_rotation
from shapepose_fg.core.rows import Rows

ROUNDS = 4
"""Maximum number of rounds, each with people associated by the cameras of the round before."""
_STEPS = 4
"""Number of steps between matchings."""
CORNER = -np.array([HALF_PIXEL, HALF_PIXEL])
"""Coordinates of a picture's corner, px; the origin is the centre of the first pixel."""


@dataclass(frozen=True)
class Others(Rows):
    """People seen by all cameras except some."""

    frame: Index
    """(P,) frame of each person."""
    points: Array
    """(P, J, 3) joints, the calibration's unit; NaN where not placed."""


Fitted = Callable[[Array, Array, Pinhole], Pinhole | None]
"""Function that fits a camera to joints (N, 3), in the calibration's unit, and their detections
(N, 2), pixels, starting from the given camera; None if no fit is possible."""


@dataclass(frozen=True)
class Match:
    """E matches between a camera's sightings of people and the people that other cameras see."""

    person: Index
    """(E,) rows of the people."""
    sighting: Index
    """(E,) rows of the camera's sightings."""
    error: Array
    """(E,) median distance, as a share of the person's size in the picture."""
    possible: int
    """Number of possible matches: in every frame the smaller of the counts of people
    and sightings."""

    @property
    def score(self) -> float:
        """Quality of the matches: 1 if all possible ones exist without error, 0 without any."""
        return float((1 - self.error / GATE).sum() / max(self.possible, 1))


_LASTS = 45
"""Number of frames after which a detector's errors are independent: their correlation is 0.75 to
0.85 after one frame and 0.35 after a second (measured on Shelf and on simulated recordings)."""
_JOINTS = 5
"""Number of independent joints per person; joint errors of one person in one view are
correlated."""
ERROR = 0.03
"""Usual error of a detector, as a share of a person's size."""


def independent(others: Others) -> float:
    """Number of independent joints among people seen in some frames, given the correlations."""
    return _JOINTS * independent_poses(others.frame)


def independent_poses(frame: Index) -> float:
    """Number of independent poses of people in these frames (P,), one for each person."""
    if len(frame) == 0:
        return 0.0
    frames = np.unique(frame)
    return len(frame) / len(frames) * max(1.0, min(float(np.ptp(frames)) / _LASTS, len(frames)))


def likelihood(score: float, count: float, freedom: int) -> float:
    """Log-likelihood, up to a constant, of errors with this mean (`Match.score`), less BIC's
    penalty.
    """
    return count * score * GATE / ERROR - 0.5 * freedom * float(np.log(max(count, 2.0)))


def match(others: Others, seen: Sightings, camera: Pinhole) -> Match:
    """Mutual nearest neighbours of people and sightings, within the gate."""
    person, sighting, error = distances(others.frame, others.points, seen, camera)
    best_of_person, best_of_sighting = np.full(len(others), np.inf), np.full(len(seen), np.inf)
    np.minimum.at(best_of_person, person, error)
    np.minimum.at(best_of_sighting, sighting, error)
    keep = (
        (error <= best_of_person[person]) & (error <= best_of_sighting[sighting]) & (error < GATE)
    )
    return Match(
        person[keep], sighting[keep], error[keep], possible_matches(others.frame, seen.frame)
    )


def possible_matches(first: Index, second: Index) -> int:
    """Number of possible pairs: in every frame the smaller count."""
    frames, counts = np.unique(first, return_counts=True)
    other, other_counts = np.unique(second, return_counts=True)
    _, i, j = np.intersect1d(frames, other, assume_unique=True, return_indices=True)
    return int(np.minimum(counts[i], other_counts[j]).sum())


def tries(
    others: Others, seen: Sightings, rng: np.random.Generator
) -> Iterator[tuple[Array, Array]]:
    """Yield joints in the world (N, 3) and in the picture (N, 2) for random candidate pairs of
    people and sightings.
    """
    person, sighting = same_frame(others.frame, seen.frame)
    both = ~np.isnan(others.points[person][..., 0]) & ~np.isnan(seen.xy[sighting][..., 0])
    enough = np.flatnonzero(both.sum(axis=1) >= MIN_JOINTS + 3)
    # Number of pairs of a person and a sighting that are tried; with two people, half of them are
    # correct.
    for row in rng.permutation(enough)[:40].tolist():
        yield others.points[person[row]][both[row]], seen.xy[sighting[row]][both[row]]


def turned_to(points: Array, xy: Array, camera: Pinhole) -> Pinhole:
    """The camera rotated about its centre for the best fit of directions to `points` (N, 3), in the
    calibration's unit, and pixels `xy` (N, 2).
    """
    centre = -camera.cTw[:, :3].T @ camera.cTw[:, 3]
    directions = points - centre
    directions = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    rays = np.column_stack([xy, np.ones(len(xy))]) @ np.linalg.inv(camera.K).T
    rays = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    R = nearest_rotation(rays.T @ directions)
    return Pinhole(camera.K, np.column_stack([R, -R @ centre]))


def posed_to(points: Array, xy: Array, camera: Pinhole) -> Pinhole | None:
    """The camera with the pose that projects `points` (N, 3) to `xy` (N, 2), by PnP; None on
    failure.
    """
    scale = np.linalg.norm(points - points.mean(axis=0), axis=1).mean()
    if not scale > 0:
        return None
    middle = points.mean(axis=0)
    ok, turn, move = cv2.solvePnP(
        (points - middle) / scale, xy, camera.K, np.zeros(4), flags=cv2.SOLVEPNP_SQPNP
    )
    if not ok or not (np.isfinite(turn).all() and np.isfinite(move).all()):
        return None
    R = np.asarray(cv2.Rodrigues(turn)[0], dtype=np.float64)
    return Pinhole(camera.K, np.column_stack([R, scale * move[:, 0] - R @ middle]))


def centred_to(points: Array, xy: Array, camera: Pinhole) -> Pinhole | None:
    """The camera with its principal point shifted by the median error of `points` (N, 3) against
    `xy` (N, 2).
    """
    at, depth = camera.project(points)
    if not (depth > 0).all():
        return None
    K = camera.K.copy()
    K[:2, 2] += np.median(xy - at, axis=0)
    return Pinhole(K, camera.cTw)


def scaled_to(points: Array, xy: Array, camera: Pinhole, centre: Array) -> Pinhole | None:
    """The camera `scaled` about `centre` (2,) for the best fit of projected `points` (N, 3) to `xy`
    (N, 2).
    """
    at, depth = camera.project(points)
    if not (depth > 0).all():
        return None
    direction = at - centre
    factor = float((direction * (xy - centre)).sum() / (direction**2).sum())
    return scaled(camera, factor, centre) if 0.1 < factor < 10 else None


def scaled(camera: Pinhole, factor: float, centre: Array) -> Pinhole:
    """Scale pixels by `factor` about `centre` (2,): another focal length, or for `CORNER` another
    picture size.
    """
    K = camera.K.copy()
    K[:2, :2] *= factor
    K[:2, 2] = centre + factor * (K[:2, 2] - centre)
    return Pinhole(K, camera.cTw)


def best_of(
    others: Others,
    seen: Sightings,
    camera: Pinhole,
    pairs: Sequence[tuple[Array, Array]],
    fitted: Fitted,
) -> Pinhole | None:
    """Return the camera with the best score for all people, among exact fits to single people."""
    step = max(1, len(others) // 40)
    sample = others.rows(slice(None, None, step))
    tried = [each for points, xy in pairs if (each := fitted(points, xy, camera)) is not None]
    score, best = max(
        ((match(sample, seen, each).score, each) for each in tried),
        key=lambda pair: pair[0],
        default=(0, None),
    )
    return best if score > 0 else None


def refined(others: Others, seen: Sightings, camera: Pinhole, columns: list[int]) -> Pinhole:
    """The camera with some of its parameters (`PARAMETERS`) fitted to the people that
    it matches.
    """
    for _ in range(ROUNDS):
        found = match(others, seen, camera)
        if len(found.person) == 0:
            return camera
        points, xy = others.points[found.person], seen.xy[found.sighting]
        both = ~np.isnan(points[..., 0]) & ~np.isnan(xy[..., 0])
        size = np.broadcast_to(seen.size_px[found.sighting][:, None], both.shape)[both]
        camera = _solved(points[both], xy[both], ERROR * size, camera, columns)
    return camera


def _solved(
    points: Array, xy: Array, width_px: Array, camera: Pinhole, columns: list[int]
) -> Pinhole:
    """The camera fitted robustly (Cauchy) to points (N, 3) observed at xy (N, 2)."""
    from scipy.optimize import least_squares  # takes long to import

    ahead = camera.project(points)[1] > 0
    if ahead.sum() < 4:
        return camera
    points, xy, width_px = points[ahead, None], xy[ahead], width_px[ahead, None]

    given = Views(camera.K[None], camera.cTw[None])

    def moved(x: Array) -> Views:
        return changed_one(given, 0, columns, x)

    def residuals(x: Array) -> Array:
        at, place, _ = seen_by(points, moved(x))
        behind = (place[..., 2] <= 0).any()
        return np.full(xy.size, np.inf) if behind else np.ravel((at[:, 0, 0] - xy) / width_px)

    def slopes(x: Array) -> Array:
        J = by_parameters(*seen_by(points, moved(x)), moved(x))[:, 0, 0][..., columns]
        return (J / width_px[..., None]).reshape(-1, len(columns))

    found = least_squares(
        residuals,
        np.zeros(len(columns)),
        slopes,  # type: ignore[arg-type]
        loss="cauchy",
        x_scale="jac",
        max_nfev=_STEPS,
    )
    views = moved(found.x)
    return Pinhole(views.K[0], views.cTw[0])
