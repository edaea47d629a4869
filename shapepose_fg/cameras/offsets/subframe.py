"""Estimates time offsets of cameras with known poses, with sub-frame precision, from tracks of
people.

With two cameras, the distance between the rays of one person is minimised (`Pairwise`). With more,
each camera's view is compared with positions and velocities of joints from the other cameras
(`InSpace`).
"""

from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from shapepose_fg.body.model.rotation import hat
from shapepose_fg.cameras.offsets.scan import LEAST_MISS, normals
from shapepose_fg.cameras.relative_pose import Together
from shapepose_fg.cameras.sightings import GATE, MIN_JOINTS, Pairs, Sightings, centres_of, median_of
from shapepose_fg.cameras.tracks import FAST_S, FASTEST, CameraTracks, block_frames, fast_part
from shapepose_fg.cameras.triangulation import triangulate
from shapepose_fg.core.arrays import Array, Index
from shapepose_fg.core.camera import Views

_MOST_PLACED = 20_000
"""Maximum number of rows of tracks that are triangulated, over all cameras."""
_NUDGE = 0.25
"""Shift of a clock for numerical derivatives, frames: more than the errors to be found."""
_LEAST_OTHERS = 0.2
"""Lower limit of the total weight of all other blocks of time, by which the error of one block is
divided."""
_MOST_SAMPLES = 3000
"""Maximum number of frames of tracks that are compared for a pair of cameras."""


@dataclass(frozen=True)
class Pairwise:
    """Tracks of all cameras, and the current estimate of their clocks."""

    tracks: list[CameraTracks]
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
        compared = np.unique(one.frame)[:: max(1, round(0.1 * self.fps))]
        both, centres = Together(one, other, compared), centres_of(self.views)
        kept, _ = both.chosen(both.misses(hat(centres[b] - centres[a])[None])[0])
        return both.tracks[kept]

    def _matched(self) -> tuple[Index, Index]:
        """Rows of the first camera's tracks (N,), and the tracks of the second (N,) that are the
        same person.
        """
        one, pairs = self.tracks[0], self.same(0, 1)
        begin = one.first[pairs[:, 0]]
        stop = np.append(one.first[1:], len(one.frame))[pairs[:, 0]]
        rows = [np.arange(*each) for each in zip(begin, stop, strict=True)]
        every = np.concatenate([np.zeros(0, np.intp), *rows])
        tracks = np.repeat(pairs[:, 1], stop - begin)
        thin = max(1, -(-len(every) // _MOST_SAMPLES))
        return every[::thin], tracks[::thin]

    def solved(self) -> tuple[Array, Array]:
        """(2,) shifts of two cameras in frames and their covariance (2, 2); infinite where unknown.

        They minimise the distance of rays of one camera to those of the other, `shift` frames
        later.
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
            pair = one.track[rows] * len(other.first) + track
            miss, change = (
                fast_part(each, known, pair, FAST_S * self.fps / pace)
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


@dataclass(frozen=True)
class InSpace:
    """People in 3D and their tracks: offsets align each camera's view with the triangulation by the
    others.
    """

    tracks: list[CameraTracks]
    """Tracks of each camera."""
    views: Views
    """The cameras."""
    shift: Array
    """(V,) frames: frame f of the first camera is frame f + shift of another."""
    time: Index
    """(P,) time of each person, frames of the first camera."""
    member: Index
    """(P, V) the track of each person in each camera; -1 for none."""
    step: int
    """Step between times, frames."""
    fps: float
    """Frame rate, Hz."""

    @classmethod
    def of(cls, pairwise: Pairwise) -> "InSpace":
        """Place people at consecutive times. Tracks that contradict most others of a person are
        excluded, because two dancers may be nearer to each other than a camera's error.
        """
        tracks, views, shift, fps = pairwise.tracks, pairwise.views, pairwise.shift, pairwise.fps
        step = max(1, round(fps / 15))
        frames = [each.frame - at for each, at in zip(tracks, shift, strict=True)]
        low = min(int(each.min(initial=0)) for each in frames)
        high = max(int(each.max(initial=0)) for each in frames)
        every = np.arange(low, high + 1, step)
        busy = sum(len(each.frame) for each in tracks) / max(high - low, 1)
        count = min(len(every), int(_MOST_PLACED / max(busy, 1.0)))
        times = every[(len(every) - count) // 2 :][:count]
        parts, owners = list[Sightings](), list[Index]()
        for v, each in enumerate(tracks):
            now = times[:, None] + shift[v]
            row, which = np.nonzero((now >= each.frame[each.first]) & (now < each.lasts))
            xy = _pixels(each.at(which, times[row] + shift[v])[0], views.K[v] @ views.cTw[v, :, :3])
            known = np.isfinite(xy[..., 0]).astype(float)
            parts.append(Sightings(row, np.full(len(row), v), xy, known))
            owners.append(which)
        seen, owner = Sightings.concatenate(parts), np.concatenate(owners)
        enough = seen.confidence.sum(axis=1) >= MIN_JOINTS
        seen, owner = seen.rows(enough), owner[enough]
        groups = Pairs.of(seen, views).groups(len(seen), tuple(range(len(tracks))))
        member = np.where(groups.member >= 0, np.append(owner, -1)[groups.member], -1)
        agree = np.zeros(member.shape)
        for a, b in combinations(range(len(tracks)), 2):
            same = np.zeros((len(tracks[a].first) + 1, len(tracks[b].first) + 1))
            same[tuple(pairwise.same(a, b).T)] = 1.0
            both = same[member[:, a], member[:, b]]
            agree[:, a] += both
            agree[:, b] += both
        member[2 * agree < (member >= 0).sum(axis=1, keepdims=True) - 1] = -1
        many = (member >= 0).sum(axis=1) >= 3
        return cls(tracks, views, shift, times[groups.frame[many]], member[many], step, fps)

    def settled(self) -> tuple[Array, Array]:
        """(V,) shifts in frames and their covariance (V, V) relative to the first camera; infinite
        where unknown.
        """
        V, shift = len(self.tracks), self.shift.copy()
        late, errors = self.all_late(shift)
        shift -= late - late.mean()
        late, errors = self.all_late(shift)
        # A clock offset also changes the triangulation, and joints with larger residuals have
        # smaller weights.
        slope = (
            np.stack([self.all_late(shift + _NUDGE * one)[0] - late for one in np.eye(V)], axis=1)
            / _NUDGE
        )
        inverse = np.linalg.pinv((slope - slope[0])[1:, 1:], rcond=1e-3)
        for _ in range(2):
            shift[1:] -= np.clip(inverse @ (late - late[0])[1:], -1.0, 1.0)
            late, errors = self.all_late(shift)
        known = np.isfinite(errors[0]) & np.isfinite(errors[0, 0])
        relative = inverse @ np.where(known, errors - errors[:, :1], 0.0)[:, 1:].T
        covariance = np.zeros((V, V))
        covariance[1:, 1:] = relative @ relative.T + np.diag(np.where(known[1:], 0.0, np.inf))
        return shift - shift[0], covariance

    def all_late(self, shift: Array) -> tuple[Array, Array]:
        """`late` of all cameras: (V,) frames, and the parts of their errors (B, V)."""
        rays, speed, xy, size = self.seen(shift)
        each = [self.late(view, rays[:, :, view], speed, xy, size) for view in range(len(shift))]
        return np.array([late for late, _ in each]), np.stack([error for _, error in each], axis=1)

    def seen(self, shift: Array) -> tuple[Array, Array, Array, Array]:
        """Directions and their speeds (P, J, V, 3), pixels (P, J, V, 2), and sizes (P, V) in
        rad.
        """
        members = enumerate(zip(self.tracks, np.maximum(self.member, 0).T, strict=True))
        found = [each.at(track, self.time + shift[view]) for view, (each, track) in members]
        rays, speed = (np.stack([each[n] for each in found], axis=2) for n in (0, 1))
        has_track = self.member >= 0
        rays = np.where(has_track[:, None, :, None], rays, np.nan)
        size = np.where(has_track, np.stack([each[2] for each in found], axis=1), np.nan)
        return rays, speed, _pixels(rays, self.views.K @ self.views.cTw[:, :, :3]), size

    def _moving(self, points: Array, speed: Array) -> Array:
        """(P, J, 3) velocities of joints at `points`, metres per frame, from changes of directions
        (P, J, V, 3).
        """
        from_camera = points[:, :, None] - centres_of(self.views)
        far = np.linalg.norm(from_camera, axis=-1)[..., None]
        across = (
            np.eye(3) - (from_camera / far)[..., :, None] * (from_camera / far)[..., None, :]
        ) / far[..., None] ** 2
        known = np.isfinite(speed) & np.isfinite(far)
        A = np.where(known[..., :1, None], across, 0.0).sum(axis=2)
        b = np.where(known, speed / far, 0.0).sum(axis=2)
        enough = known[..., 0].sum(axis=2) >= 2
        A[~enough] = np.eye(3)
        return np.where(
            enough[..., None], np.linalg.solve(A + 1e-6 * np.eye(3), b[..., None])[..., 0], np.nan
        )

    def late(
        self, view: int, rays: Array, speed: Array, xy: Array, size: Array
    ) -> tuple[float, Array]:
        """Delay of one camera's clock relative to the others' triangulation, frames; and the
        contributions of B blocks (B,).

        The squares of the contributions sum to the variance. Infinite if the delay is unobserved.
        """
        block = block_frames(self.fps, float(np.ptp(self.time)))
        blocks = int(np.ptp(self.time) // block) + 1
        xy = xy.copy()
        xy[:, :, view] = np.nan
        seen = np.isfinite(xy[..., 0])
        placed = triangulate(xy, seen.astype(float), size * self.views.focal_px, self.views, 3)
        from_camera = placed.points - centres_of(self.views)[view]
        miss = np.where(seen, placed.miss_px / (size * self.views.focal_px)[:, None], 0.0)
        good = ((seen.sum(axis=-1) >= 2) & (miss.max(axis=-1) < GATE / 2))[..., None]
        directions = np.where(
            good, from_camera / np.linalg.norm(from_camera, axis=-1, keepdims=True), np.nan
        )
        moving = self._moving(placed.points, np.where(seen[..., None], speed, np.nan))
        predicted = _across(placed.points, moving, centres_of(self.views)[view])
        order = np.lexsort((self.time, self.member[:, view]))
        rows = order[self.member[order, view] >= 0]
        track, time, own_rays = self.member[rows, view], self.time[rows], rays[rows]
        own_rays = own_rays / np.linalg.norm(own_rays, axis=-1, keepdims=True)
        each = np.stack([own_rays - directions[rows], predicted[rows], speed[rows, :, view]])
        each /= size[rows, view][:, None, None]
        length = np.linalg.norm(each, axis=-1)
        known = (length[0] < GATE / 2) & (length[1:] < FASTEST / self.fps).all(axis=0)
        width = FAST_S * self.fps / self.step
        miss, calm, fast = (fast_part(part, known[..., None], track, width) for part in each)
        if not known.any():
            return 0.0, np.full(blocks, np.inf)
        length = np.linalg.norm(miss, axis=-1)
        width = 3.0 * np.maximum(median_of(np.where(known, length, np.nan).T), LEAST_MISS)
        weight = np.where(known, 1 / (1 + (length / width) ** 2) ** 2 / width**2, 0.0)
        # Velocities from the others are independent of this camera's errors; its own give the
        # change per frame.
        gains = (weight * (calm * fast).sum(axis=-1)).sum(axis=1)
        if (gain := float(gains.sum())) <= 0:
            return 0.0, np.full(blocks, np.inf)
        score = (weight * (calm * miss).sum(axis=-1)).sum(axis=1)
        when = ((time - self.time.min()) // block).astype(np.intp)
        (when, _), each = np.unique(np.stack([when, track]), axis=1, return_inverse=True)
        score, gains = np.bincount(each.reshape(-1), score), np.bincount(each.reshape(-1), gains)
        late, trust = score.sum() / gain, np.ones(len(score))
        for _ in range(10):  # reweighted mean
            deviation = np.abs(score - late * gains) / np.sqrt(np.maximum(gains, 1e-12))
            usual = max(1.5 * float(np.median(deviation)), 1e-12)
            trust = 1 / (1 + (deviation / (2.0 * usual)) ** 2)
            late = (trust * score).sum() / (trust * gains).sum()
        gains *= trust
        part = np.bincount(when, gains, blocks) / gains.sum()
        errors = np.bincount(when, trust * score - late * gains, blocks) / gains.sum()
        # A block with a large weight pulls the mean towards itself; this corrects its deviation.
        return float(late), errors / np.maximum(1 - part, _LEAST_OTHERS)


def _across(points: Array, moving: Array, centre: Array) -> Array:
    """(..., 3) change of the directions from `centre` to points that move with `moving`."""
    from_camera = points - centre
    far = np.linalg.norm(from_camera, axis=-1, keepdims=True)
    return (
        moving - (moving * from_camera).sum(axis=-1, keepdims=True) * from_camera / far**2
    ) / far


def _pixels(rays: Array, camera: Array) -> Array:
    """(..., 2) pixels of directions in the world (..., 3), in cameras K R (..., 3, 3)."""
    at = (camera @ rays[..., None])[..., 0]
    return np.asarray(at[..., :2] / at[..., 2:])
