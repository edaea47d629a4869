"""Time offsets between pairs of cameras with subframe accuracy: tracks of one person, and
intersection of rays.
"""

from dataclasses import dataclass, replace

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

    def _matched(self) -> tuple[Index, Index]:
        """Rows of the first camera's tracks (N,), and the tracks of the second (N,) that are the
        same person.
        """
        one, pairs = self.tracks[0], self.same(0, 1)
        stop = np.append(one.first[1:], len(one.frame))[pairs[:, 0]]
        rows = [np.arange(*each) for each in zip(one.first[pairs[:, 0]], stop, strict=True)]
        every = np.concatenate([np.zeros(0, np.intp), *rows])
        tracks = np.repeat(pairs[:, 1], [len(each) for each in rows])
        thin = max(1, -(-len(every) // _MOST_SAMPLES))
        return every[::thin], tracks[::thin]

    def solved(self) -> tuple[Array, Array]:
        """(2,) shifts of two cameras in frames and their covariance (2, 2); infinite where unknown.

        The rays of one camera are to intersect those of the other, `shift` frames later.
        """
        (one, other), shift, covariance = self.tracks, self.shift.copy(), np.diag([0.0, np.inf])
        rows, track = self._matched()
        normal = normals(one.rays[rows], self.views, 0, 1)
        block = block_frames(self.fps, max(float(np.ptp(each.frame)) for each in self.tracks))
        _, now = np.unique(one.frame[rows] // block, return_inverse=True)
        for _ in range(8):
            rays, speed, size = other.at(track, one.frame[rows] + shift[1])
            miss, change = (
                np.einsum("njk,njk->nj", normal, each) / size[:, None] for each in (rays, speed)
            )
            known = np.asarray(np.isfinite(miss) & np.isfinite(change))
            if known.sum() < 20:
                break
            width = 3.8 * np.median(np.abs(miss[known]))
            pace = max(float(np.median(np.diff(one.frame[rows]))), 1.0)
            who = one.track[rows] * len(other.first) + track
            miss, change = (
                fast_part(each, known, who, FAST_S * self.fps / pace)
                for each in (np.clip(miss, -width, width), change)
            )
            width = 3.8 * np.median(np.abs(miss[known]))
            weight = np.where(known, 1 / (1 + (miss / width) ** 2), 0.0) / width**2
            gain = float((weight * change**2).sum())
            if gain <= 0:
                break
            score = np.bincount(now, (weight * change * miss).sum(axis=1))
            shift[1] -= np.clip(score.sum() / gain, -1.0, 1.0)
            if len(score) > 2:
                covariance[1, 1] = (score**2).sum() / gain**2 * len(score) / (len(score) - 2)
        return shift, covariance
