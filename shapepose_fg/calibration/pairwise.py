"""Time offsets between pairs of cameras with subframe accuracy: tracks of one person, and
intersection of rays.
"""

from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from shapepose_fg.body.model.rotation import hat
from shapepose_fg.calibration.relative import Together
from shapepose_fg.calibration.tracks import FAST_S, Tracks, block_frames, fast_part
from shapepose_fg.core.arrays import Array, Index
from shapepose_fg.core.camera import Views
from shapepose_fg.setup_check.matching import centres_of
from shapepose_fg.setup_check.offset_scan import normals

_MOST_SAMPLES = 3000
"""Maximum number of frames of tracks that are compared for a pair of cameras."""


@dataclass(frozen=True)
class Pairwise:
    """Tracks of all cameras, and the current estimate of their clocks."""

    tracks: list[Tracks]
    """Tracks of each camera."""
    views: Views
    """The cameras."""
    shift: Array
    """(V,) frames: frame f of the first camera is frame f + shift of another."""
    fps: float
    """Frame rate, Hz."""

    def same(self, a: int, b: int) -> Index:
        """(K, 2) pairs of tracks of cameras a and b that are one person over their common time."""
        one, other = self.tracks[a], self.tracks[b]
        other = replace(other, frame=other.frame - round(self.shift[b] - self.shift[a]))
        looks = np.unique(one.frame)[:: max(1, round(0.1 * self.fps))]
        both, centres = Together(one, other, looks), centres_of(self.views)
        kept, _ = both.chosen(both.misses(hat(centres[b] - centres[a])[None])[0])
        return both.tracks[kept]

    def matched(self, a: int, b: int) -> tuple[Index, Index]:
        """Rows of camera a's tracks (N,), and the tracks of camera b (N,) that are the same
        person.
        """
        one = self.tracks[a]
        pairs: list[tuple[int, int]] = self.same(a, b).tolist()
        stop = np.append(one.first[1:], len(one.frame))
        rows = [np.arange(one.first[who], stop[who]) for who, _ in pairs]
        whom = [np.full(len(each), pair[1]) for each, pair in zip(rows, pairs, strict=True)]
        every, tracks = (np.concatenate([np.zeros(0, np.intp), *each]) for each in (rows, whom))
        thin = max(1, -(-len(every) // _MOST_SAMPLES))
        return every[::thin], tracks[::thin]

    def miss(self, a: int, b: int, rows: Index, track: Index, apart: float) -> tuple[Array, Array]:
        """(N, J) distance between camera b's rays, `apart` frames later, and those of `rows`; and
        its change per frame.
        """
        one, other = self.tracks[a], self.tracks[b]
        rays, speed, size = other.at(track, np.asarray(one.frame[rows] + apart, dtype=np.float64))
        normal = normals(one.rays[rows], self.views, a, b)
        miss = np.einsum("njk,njk->nj", normal, rays) / size[:, None]
        return miss, np.einsum("njk,njk->nj", normal, speed) / size[:, None]

    def solved(self) -> tuple[Array, Array]:
        """(V,) shifts in frames and their covariance (V, V), estimated jointly from all pairs."""
        V, shift = len(self.tracks), self.shift.copy()
        pairs = {pair: self.matched(*pair) for pair in combinations(range(V), 2)}
        block = block_frames(self.fps, max(float(np.ptp(each.frame)) for each in self.tracks))
        for _ in range(8):
            H, g = np.zeros((V, V)), np.zeros(V)
            scores: dict[int, Array] = {}
            for (a, b), (rows, track) in pairs.items():
                miss, change = self.miss(a, b, rows, track, shift[b] - shift[a])
                known = np.asarray(np.isfinite(miss) & np.isfinite(change))
                if known.sum() < 20:
                    continue
                width = 3.8 * np.median(np.abs(miss[known]))
                pace = max(float(np.median(np.diff(self.tracks[a].frame[rows]))), 1.0)
                who = self.tracks[a].track[rows] * len(self.tracks[b].first) + track
                miss, change = (
                    fast_part(each, known, who, FAST_S * self.fps / pace)
                    for each in (np.clip(miss, -width, width), change)
                )
                width = 3.8 * np.median(np.abs(miss[known]))
                weight = np.where(known, 1 / (1 + (miss / width) ** 2), 0.0) / width**2
                own, score = (weight * change**2).sum(), (weight * change * miss).sum(axis=1)
                way = np.zeros(V)
                way[a], way[b] = -1.0, 1.0
                H += own * np.outer(way, way)
                g += score.sum() * way
                now = ((self.tracks[a].frame[rows] - shift[a]) // block).astype(int)
                for each in np.unique(now).tolist():
                    scores[each] = scores.get(each, 0) + score[now == each].sum() * way
            free = np.diag(H)[1:] > 0
            if not free.all():
                break
            step = -np.linalg.solve(H[1:, 1:], g[1:])
            shift[1:] += np.clip(step, -1.0, 1.0)
        covariance = np.full((V, V), np.inf)
        covariance[0], covariance[:, 0] = 0.0, 0.0
        if len(scores) > V and free.all():
            S = np.stack(list(scores.values()))[:, 1:]
            inverse = np.linalg.inv(H[1:, 1:])
            covariance[1:, 1:] = inverse @ (S.T @ S) @ inverse * len(S) / (len(S) - V)
        return shift, covariance
