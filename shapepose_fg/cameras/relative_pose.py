"""Relative poses of two cameras, from tracks of people without known correspondence.

Any track of one camera may be the person of any simultaneous track of the other: each such pair
gives an essential matrix, and the one that most tracks agree with, over all frames, is chosen
(RANSAC over tracks; Nistér 2004 for five joints in one track).
"""

from dataclasses import dataclass
from itertools import product

import cv2
import numpy as np
from scipy.optimize import least_squares

from shapepose_fg.body.model.rotation import exp_so3, hat
from shapepose_fg.cameras.sightings import GATE, MIN_JOINTS, depths_of_meeting
from shapepose_fg.cameras.tracks import CameraTracks
from shapepose_fg.cameras.triangulation import KERNEL
from shapepose_fg.core.arrays import Array, Index, Mask
from shapepose_fg.core.decompositions import basis_across

SAMPLING_S = 0.2
"""Interval between compared frames, s: people's joints move by more than a detector's error."""
_MOST_FRAMES = 80
"""Maximum number of frames for scoring hypotheses."""
_MOST_TRIED = 30
"""Maximum number of pairs of tracks for hypotheses, those with the longest common time."""
_JOINTS_A_TRY = 240
_LEAST_TRY = 60
"""Maximum and minimum number of joints of a pair of tracks for a hypothesis."""
_GATE = 3 * KERNEL
"""Maximum mean residual of tracks of one person, as a share of the person's size."""
_SAMPLES = 60
"""Number of samples of five joints per pair of tracks; two thirds of a person's joints are inliers
in simulated recordings."""
_FINALISTS = 6
"""Number of hypotheses that are refined."""
_STEPS = 12
"""Maximum number of evaluations for a hypothesis."""


@dataclass(frozen=True)
class Relative:
    """The relative pose of two cameras: x_b = R x_a + t."""

    R: Array
    """(3, 3) rotation."""
    t: Array
    """(3,) direction of the translation, of length one."""
    score: float
    """Share of the common sightings that are matched, weighted by their residuals. It is 1 if all
    match with zero residual, and 0 if none match."""
    seconds: float
    """Person-seconds that are matched."""
    points: Array
    """(N, J, 3) matched people in camera a's frame, in lengths of t; NaN unless seen by both."""


class Together:
    """Sightings of two cameras in the same frames: N pairs of rows, K pairs of tracks."""

    def __init__(self, one: CameraTracks, other: CameraTracks, compared: Index) -> None:
        rows = [_rows(each, compared) for each in (one, other)]
        both = (rows[0][:, None] >= 0) & (rows[1][None] >= 0)
        a, b, frame = np.nonzero(both)
        self.rows = np.stack([rows[0][a, frame], rows[1][b, frame]], axis=1)
        self.tracks, self.pair = np.unique(np.stack([a, b], axis=1), axis=0, return_inverse=True)
        self.pair = self.pair.reshape(-1)
        self.count = np.bincount(self.pair, minlength=len(self.tracks))
        self.possible = int(
            np.minimum((rows[0] >= 0).sum(axis=0), (rows[1] >= 0).sum(axis=0)).sum()
        )
        self.rays = (one.rays, other.rays)
        self.size = (one.size, other.size)
        self.overlapping = _at_once(rows[0]), _at_once(rows[1])

    def misses(self, E: Array) -> Array:
        """(H, K) residuals of pairs of tracks under essential matrices (H, 3, 3), as shares of
        people's size.
        """
        one, other = self.rows.T
        a, b = self.rays[0][one], self.rays[1][other]
        known = np.isfinite(a[..., 0]) & np.isfinite(b[..., 0])
        (row, _), seen = np.nonzero(known), known.sum(axis=1)
        a, size_a, b, size_b = a[known], self.size[0][one[row]], b[known], self.size[1][other[row]]
        share = np.where(seen >= MIN_JOINTS, 1 / np.maximum(seen, 1), 0.0)
        count = np.bincount(self.pair, share > 0, len(self.tracks))
        enough = (count >= 0.5 * self.count) & (count > 0)
        found = np.full((len(E), len(self.tracks)), GATE)
        for n, each in enumerate(E):
            plane, back = a @ each.T, b @ each
            scale = np.minimum(
                np.linalg.norm(plane, axis=1) * size_b, np.linalg.norm(back, axis=1) * size_a
            )
            miss = np.minimum(np.abs((plane * b).sum(axis=1)) / (scale + 1e-12), GATE)
            total = np.bincount(self.pair[row], share[row] * miss, len(self.tracks))
            found[n, enough] = total[enough] / count[enough]
        return found

    def chosen(self, miss: Array) -> tuple[Mask, float]:
        """Which pairs of tracks (K,) are one person each, greedily by residual, and their total
        score.
        """
        score = np.maximum(1 - miss / _GATE, 0.0) * self.count
        order = np.argsort(-score, kind="stable")
        kept, (a, b) = np.zeros(len(miss), dtype=bool), self.tracks.T
        for n in order[score[order] > 0].tolist():
            # A track cannot be two people at once.
            rival = ((a == a[n]) & self.overlapping[1][b[n], b]) | (
                (b == b[n]) & self.overlapping[0][a[n], a]
            )
            kept[n] = not (kept & rival).any()
        return kept, float(score[kept].sum() / max(self.possible, 1))

    def joints(self, kept: Mask) -> tuple[Array, Array, Array]:
        """Rays (N, J, 3) of both cameras for the pairs of tracks that are `kept`, and
        sizes (N,).
        """
        rows = self.rows[kept[self.pair]]
        a, b = (rays[rows[:, n]] for n, rays in enumerate(self.rays))
        return a, b, np.sqrt(self.size[0][rows[:, 0]] * self.size[1][rows[:, 1]])


def relative(one: CameraTracks, other: CameraTracks, fps: float) -> Relative | None:
    """Relative pose of the camera of `other` to that of `one`, with rays in their own frames; None
    if too few people are seen by both at once, or no pose fits.
    """
    frames = np.intersect1d(one.frame, other.frame)
    if len(frames) == 0:
        return None
    compared = np.unique(
        (frames // max(1, round(SAMPLING_S * fps))) * max(1, round(SAMPLING_S * fps))
    )
    compared = compared[np.unique(np.linspace(0, len(compared) - 1, _MOST_FRAMES).astype(np.intp))]
    seen = Together(one, other, compared)
    guesses = _guesses(one, other, seen)
    if len(guesses) == 0:
        return None
    scores = np.array([seen.chosen(miss)[1] for miss in seen.misses(guesses)])
    found: Relative | None = None
    for E in guesses[np.argsort(-scores, kind="stable")[:_FINALISTS]]:
        each = _settled(E, seen, fps, compared)
        if each is not None and (found is None or each.score > found.score):
            found = each
    return found


def _guesses(one: CameraTracks, other: CameraTracks, seen: Together) -> Array:
    """(H, 3, 3) essential matrices, each from a pair of tracks."""
    found = list[Array]()
    for pair in np.argsort(-seen.count, kind="stable")[:_MOST_TRIED].tolist():
        a, b = seen.tracks[pair].tolist()
        begin = max(one.frame[one.first[a]], other.frame[other.first[b]])
        end = min(one.lasts[a], other.lasts[b])
        frames = np.unique(
            np.linspace(begin, end, _JOINTS_A_TRY // one.rays.shape[1]).astype(np.intp)
        )
        rows = [
            each.first[k] + frames - each.frame[each.first[k]] for each, k in ((one, a), (other, b))
        ]
        x, y = one.rays[rows[0]], other.rays[rows[1]]
        both = (
            np.isfinite(x[..., 0]) & np.isfinite(y[..., 0]) & (x[..., 2] > 0.1) & (y[..., 2] > 0.1)
        )
        if both.sum() < _LEAST_TRY:
            continue
        size = float(np.sqrt(np.median(one.size[rows[0]]) * np.median(other.size[rows[1]])))
        flat_x, flat_y = (
            np.ascontiguousarray(each[both][:, :2] / each[both][:, 2:]) for each in (x, y)
        )
        agree = KERNEL * size
        E, _ = cv2.findEssentialMat(
            flat_x,
            flat_y,
            np.eye(3),
            method=cv2.RANSAC,
            prob=0.999,
            threshold=agree,
            maxIters=_SAMPLES,
        )
        if E is not None and E.shape[0] >= 3:
            found += [np.asarray(each, dtype=np.float64) for each in E.reshape(-1, 3, 3)]
    return np.stack(found) if found else np.zeros((0, 3, 3))


def _settled(E: Array, seen: Together, fps: float, compared: Index) -> Relative | None:
    """Pose of a hypothesis, refined alternately with the set of agreeing tracks."""
    kept, score = seen.chosen(seen.misses(E[None])[0])
    best: Relative | None = None
    for _ in range(4):
        if kept.sum() == 0:
            return best
        a, b, size = seen.joints(kept)
        pose = _in_front(E, a, b) if best is None else (best.R, best.t)
        R, t = refined_pose(*pose, a, b, size)
        E = hat(t) @ R
        new, score = seen.chosen(seen.misses(E[None])[0])
        if best is not None and score <= best.score:
            return best
        points, ahead = _meeting(R, t, a, b)
        share = (
            float(ahead[np.isfinite(points[..., 0])].mean()) if np.isfinite(points).any() else 0.0
        )
        step = float(np.median(np.diff(compared))) / fps if len(compared) > 1 else SAMPLING_S
        best = Relative(R, t, score * max(0.0, 2 * share - 1), len(a) * step, points)
        kept = new
    return best


def _in_front(E: Array, a: Array, b: Array) -> tuple[Array, Array]:
    """Choose the pose, of the four of an essential matrix, with most joints in front of both
    cameras.
    """
    one, two, t = (np.asarray(each, dtype=np.float64) for each in cv2.decomposeEssentialMat(E))
    ways = [(R, sign * t[:, 0]) for R, sign in product((one, two), (1.0, -1.0))]
    return max(ways, key=lambda way: int(_meeting(*way, a, b)[1].sum()))


def _meeting(R: Array, t: Array, a: Array, b: Array) -> tuple[Array, Mask]:
    """Intersections of rays (N, J, 3) of two cameras, in the frame of the first, and whether in
    front of both.
    """
    back, centre = b @ R, -R.T @ t
    s, u, _ = depths_of_meeting(a, back, centre)
    return (s[..., None] * a + centre + u[..., None] * back) / 2, (s > 0) & (u > 0)


def refined_pose(R: Array, t: Array, a: Array, b: Array, size: Array) -> tuple[Array, Array]:
    """The pose with minimum Sampson residuals (Cauchy) of rays a, b (N, J, 3) of people with `size`
    (N,) rad.
    """
    known = np.isfinite(a[..., 0]) & np.isfinite(b[..., 0])
    # In three rows: sums over a last axis of three numbers are slow.
    size, a, b = (
        np.broadcast_to(size[:, None], known.shape)[known],
        a[known].T.copy(),
        b[known].T.copy(),
    )
    across = basis_across(t)

    def moved(x: Array) -> tuple[Array, Array]:
        way = t + x[3:] @ across
        return exp_so3(x[None, :3])[0] @ R, way / np.linalg.norm(way)

    def residuals(x: Array) -> Array:
        """Sampson's distances, of an angle on both sides, as shares of people's size."""
        turn, way = moved(x)
        E = hat(way) @ turn
        Ea, Eb = E @ a, E.T @ b
        scale = size * np.sqrt((Ea**2).sum(axis=0) + (Eb**2).sum(axis=0))
        return (b * Ea).sum(axis=0) / scale

    usual = max(KERNEL / 2, float(np.median(np.abs(residuals(np.zeros(5))))))
    found = least_squares(residuals, np.zeros(5), loss="cauchy", f_scale=usual, max_nfev=_STEPS)
    return moved(found.x)


def _rows(tracks: CameraTracks, compared: Index) -> Index:
    """(K, F) the row of each track at each compared frame, -1 where it has none."""
    begins = tracks.frame[tracks.first]
    inside = (compared >= begins[:, None]) & (compared <= tracks.lasts[:, None])
    return np.where(inside, tracks.first[:, None] + compared - begins[:, None], -1)


def _at_once(rows: Index) -> Mask:
    """(K, K) whether tracks overlap in time, and so are different people."""
    present = (rows >= 0).astype(np.float64)
    return np.asarray(present @ present.T > 0)
