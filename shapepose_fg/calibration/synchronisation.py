"""When cameras of known poses expose, from the people whom they see: offsets of any size, to a part of a frame.

Two rays to one joint meet if they were taken at one time. By how much those of two cameras miss each other is looked
at over all offsets, first with whoever fits best, which needs no association; then tracks that are one person are
found, and offsets between all pairs of cameras solved together (Gauss-Newton, Cauchy).
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from scipy.ndimage import gaussian_filter1d

from shapepose_fg.calibration.tracks import Tracks, lines
from shapepose_fg.core.arrays import Array, Index
from shapepose_fg.core.camera import Rig, Views
from shapepose_fg.core.compiled import kernel
from shapepose_fg.core.detections import DetectionSequence
from shapepose_fg.core.errors import InputError
from shapepose_fg.setup_check.evidence import triangulate
from shapepose_fg.setup_check.matching import GATE, MIN_JOINTS, Pairs, Sightings, centres_of, rays_of

_ANCHORS = 150
"""Frames of one camera that are compared with those of another, at every offset."""
_STEP_S = 0.1
"""Between offsets that are looked at first: people's joints move by 10 cm."""
_LEAST_S = 3.0
"""Seconds that two cameras must have in common, or a third of the recording if that is less."""
_AROUND_S = 0.6
"""Offsets that are nearer than this to each other are one answer."""
_GATE = 0.06
"""Tracks whose rays miss each other by more than this part of the person's size are not one person."""
_MOST_SAMPLES = 3000
"""Of each pair of cameras, frames of tracks."""
_FAST_S = 1.0
"""What lasts longer than this is taken out of the rays' misses: a detector's errors do, and those of cameras."""
_MOST_PLACED = 20_000
"""Rows of tracks of all cameras that are placed in space."""
_FASTEST = 2.5
"""Statures a second: joints that move faster have changed their person."""
_CALM_S = 0.08
"""One sigma of the kernel by which joints in space are smoothed for their speeds."""
_BLOCK_S = 1.0
"""Errors of one second are one error."""
_SURE = 1.5
"""How far the best offset must stand out of all others, in their standard deviations."""


@dataclass(frozen=True)
class Synchronised:
    """When cameras exposed their frames: frame f of camera v at f / fps + offset_s[v]."""

    offset_s: Array
    """(V,) seconds; 0 of the first camera."""
    sigma_s: Array
    """(V,) one sigma; 0 of the first camera."""
    sure: Array
    """(V,) how far the offset stands out of all others, in their standard deviations; under 3 it may be another."""

    def undetermined(self, rig: Rig) -> list[str]:
        """Cameras whose offset the people's motion does not determine, in words."""
        return [
            f"camera {name}: the people's motion does not determine its offset: others fit about as well (the best"
            f" stands out by {sure:.1f}); film people who walk about and wave, in view of all cameras"
            for name, sure in zip(rig.names, self.sure, strict=True)
            if sure < _SURE
        ]


def synchronise(
    detections: DetectionSequence,
    rig: Rig,
    fps: float,
    frames: range,
    most_s: float = 60.0,
    around_s: Array | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Synchronised:
    """The offsets, up to `most_s` between any two cameras, from what cameras at known poses saw in `frames`.

    With `around_s` (V,) only offsets within `most_s` of these are looked at. InputError where a camera sees nobody.
    """
    views = Views.of(rig)
    sightings = Sightings.of(detections, frames)
    for view, name in enumerate(rig.names):
        if (sightings.view == view).sum() < _ANCHORS // 3:
            raise InputError(f"camera {name}: hardly anybody is seen, so that nothing says when it exposed its frames")
    start = np.zeros(len(rig), dtype=np.intp) if around_s is None else -np.rint(around_s * fps).astype(np.intp)
    # Frames are counted on the clock of the first camera: at `shift` zero all clocks are the same.
    sightings = replace(sightings, frame=sightings.frame - start[sightings.view])
    pairs = list(combinations(range(len(rig)), 2))
    step = max(1, round(_STEP_S * fps))
    common = min(_LEAST_S * fps, len(frames) / 3)
    most = min(round(most_s * fps), int(len(frames) - common)) // step * step
    lags = np.arange(-most, most + 1, step)
    curves = {}
    for number, (a, b) in enumerate(pairs):
        curves[a, b] = _Scan.of(sightings, views, a, b).over(lags, common)
        progress(number + 1, len(pairs))
    coarse, sure = _chosen(curves, lags, len(rig), round(_AROUND_S * fps))
    tracks = [Tracks.of(sightings, views, view, fps) for view in range(len(rig))]
    fine = _Network(tracks, views, coarse.astype(float), fps)
    fine = fine.nearest(2.0 * step, 1.0).nearest(2.0, 0.25)
    shift, covariance = fine.solved()
    if len(rig) > 2:
        shift, covariance = _Space.of(tracks, views, shift, fps).settled()
    offset = -(shift + start)
    offset = offset - offset[0]
    return Synchronised(offset / fps, np.sqrt(np.diag(covariance)) / fps, sure)


@dataclass(frozen=True)
class _Scan:
    """One camera's people at some frames, and all of another's."""

    normal: Array
    """(A, J, 3) of the plane through both cameras and a joint."""
    frame: Index
    """(A,)."""
    rays: Array
    """(S, J, 3) of the other camera, in order of frames."""
    size: Array
    """(S,) rad."""
    first: Index
    """(T + 1,) where each of the other's frames begins, from `begin` on."""
    begin: int
    """Its first frame."""

    @classmethod
    def of(cls, sightings: Sightings, views: Views, a: int, b: int) -> "_Scan":
        """Of the cameras `a` and `b`."""
        one, other = (sightings.only(sightings.view == view) for view in (a, b))
        taken = np.unique(one.frame)
        wanted = taken[np.unique(np.linspace(0, len(taken) - 1, _ANCHORS).astype(np.intp))]
        one = one.only(np.isin(one.frame, wanted))
        other = other.only(np.argsort(other.frame, kind="stable"))
        begin = int(other.frame[0])
        first = np.searchsorted(other.frame, np.arange(begin, other.frame[-1] + 2))
        size = other.size_px / views.focal_px[b]
        normal = normals(rays_of(one, views), views, a, b)
        return cls(normal, one.frame, rays_of(other, views), size, first, begin)

    def over(self, lags: Index, common: float) -> Array:
        """(L,) mean miss of all that could be somebody, as a part of their size; NaN where too little is common."""
        cost, count = np.zeros(len(lags)), np.zeros(len(lags))
        arrays = (np.ascontiguousarray(each) for each in (self.normal, self.rays))
        _scan(*arrays, self.frame, self.size, self.first, self.begin, lags, GATE, MIN_JOINTS, cost, count)
        last = self.begin + len(self.first) - 2
        both = np.minimum(self.frame.max() + lags, last) - np.maximum(self.frame.min() + lags, self.begin)
        enough = (both >= common) & (count >= 0.2 * len(self.frame) * np.minimum(common / np.ptp(self.frame), 1))
        return np.where(enough & (count > 0), cost / np.maximum(count, 1), np.nan)


@kernel
def _scan(
    normal: Array,
    rays: Array,
    frame: Index,
    size: Array,
    first: Index,
    begin: int,
    lags: Index,
    gate: float,
    least: int,
    cost: Array,
    count: Array,
) -> None:
    """Sums into `cost` (L,), by how much the person of another camera that fits best misses, of `count` (L,)."""
    for n in range(len(lags)):
        for a in range(len(frame)):
            at = frame[a] + lags[n] - begin
            if at < 0 or at + 1 >= len(first) or first[at] == first[at + 1]:
                continue
            best = gate
            for s in range(first[at], first[at + 1]):
                total, seen = 0.0, 0
                for j in range(normal.shape[1]):
                    miss = normal[a, j, 0] * rays[s, j, 0] + normal[a, j, 1] * rays[s, j, 1]
                    miss = abs(miss + normal[a, j, 2] * rays[s, j, 2]) / size[s]
                    if miss == miss:  # not NaN
                        total += min(miss, gate)
                        seen += 1
                if seen >= least and total / seen < best:
                    best = total / seen
            cost[n] += best
            count[n] += 1


def _fast(values: tuple[Array, ...], known: Array, one: Index, other: Index, width: float) -> tuple[Array, ...]:
    """Values (N, J) less their means over the time around, track by track: errors that last are in these."""
    result = tuple(each.copy() for each in values)
    edges = np.flatnonzero((np.diff(one) != 0) | (np.diff(other) != 0)) + 1
    for start, stop in zip([0, *edges], [*edges, len(one)], strict=True):
        there = known[start:stop].astype(np.float64)
        weight = np.maximum(gaussian_filter1d(there, width, axis=0, mode="constant"), 1e-9)
        for each in result:
            mean = gaussian_filter1d(each[start:stop], width, axis=0, mode="constant") / weight
            each[start:stop] = np.where(known[start:stop], each[start:stop] - mean, 0.0)
    return result


def normals(rays: Array, views: Views, a: int, b: int) -> Array:
    """(..., 3) unit normals of the planes through rays of camera `a` and the centre of camera `b`."""
    centres = centres_of(views)
    normal = np.cross(centres[b] - centres[a], rays)
    return np.asarray(normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12))


def _chosen(curves: dict[tuple[int, int], Array], lags: Index, views: int, around: int) -> tuple[Array, Array]:
    """(V,) shifts on the first camera's clock, and how far each stands out of all others (V,).

    Cameras are added one by one, the surest first, each where it fits all those before it: frame f of the first
    camera is frame f + shift of another.
    """
    step = int(lags[1] - lags[0]) if len(lags) > 1 else 1
    half = len(lags) // 2

    def fit(one: int, other: int, apart: Index) -> Array:
        """How well two cameras fit, `apart` by so many steps: standard deviations under the median of all."""
        curve = curves[one, other] if one < other else curves[other, one][::-1]
        known = np.isfinite(curve)
        if known.sum() < 3:
            return np.zeros(len(apart))
        middle = np.median(curve[known])
        spread = 1.5 * np.median(np.abs(curve[known] - middle)) + 1e-6
        place = np.clip(apart + half, 0, len(lags) - 1)
        inside = (np.abs(apart) <= half) & known[place]
        return np.where(inside, (middle - curve[place]) / spread, 0.0)

    def best(view: int, placed: dict[int, int]) -> tuple[float, int]:
        low, high = min(placed.values()) - half, max(placed.values()) + half
        tried = np.arange(low, high + 1)
        worth = np.sum([fit(one, view, tried - at) for one, at in placed.items()], axis=0) / np.sqrt(len(placed))
        top = int(np.argmax(worth))
        far = np.abs(tried - tried[top]) * step > around
        return float(worth[top] - worth[far].max(initial=0.0)), int(tried[top])

    margins = {pair: best(pair[1], {pair[0]: 0})[0] for pair in curves}
    root = max(margins, key=lambda pair: margins[pair])[0]
    placed = {root: 0}
    while len(placed) < views:
        offers = {view: best(view, placed) for view in range(views) if view not in placed}
        view = max(offers, key=lambda each: offers[each][0])
        placed[view] = offers[view][1]
    for _ in range(2):
        for view in range(views):
            placed[view] = best(view, {one: at for one, at in placed.items() if one != view})[1]
    sure = np.array([best(view, {o: at for o, at in placed.items() if o != view})[0] for view in range(views)])
    shift = np.array([placed[view] for view in range(views)]) * step
    return shift - shift[0], sure


@dataclass(frozen=True)
class _Network:
    """Tracks of all cameras, and what is thought of their clocks."""

    tracks: list[Tracks]
    """Of each camera."""
    views: Views
    """The cameras."""
    shift: Array
    """(V,) frames: frame f of the first camera is frame f + shift of another."""
    fps: float
    """Frames a second."""

    def matched(self, a: int, b: int, gate: float = _GATE) -> tuple[Index, Index]:
        """Rows of camera a's tracks (N,), and the tracks of camera b (N,) that are the same person."""
        one, other, apart = self.tracks[a], self.tracks[b], self.shift[b] - self.shift[a]
        stride = max(1, round(0.1 * self.fps))
        rows = np.arange(0, len(one.frame), stride)
        found: dict[tuple[int, int], list[float]] = {}
        lasts = other.frame[np.append(other.first[1:], len(other.frame)) - 1] if len(other.first) else other.first
        begins = other.frame[other.first]
        at = one.frame[rows] + apart
        row, track = np.nonzero((at[:, None] >= begins) & (at[:, None] <= lasts - 1))
        miss, _ = self.miss(a, b, rows[row], track, apart)
        seen = np.isfinite(miss)
        mean = np.where(seen, np.minimum(np.abs(miss), GATE), 0).sum(axis=1) / np.maximum(seen.sum(axis=1), 1)
        for who, whom, error in zip(one.track[rows[row]], track, np.where(seen.sum(axis=1) >= MIN_JOINTS, mean, GATE)):
            found.setdefault((int(who), int(whom)), []).append(float(error))
        error = {pair: float(np.mean(each)) for pair, each in found.items() if len(each) >= 3}
        kept = {pair for pair, each in error.items() if each < gate}
        spans = [list(zip(t.frame[t.first], np.append(t.frame[t.first[1:] - 1], t.frame[-1:]))) for t in (one, other)]

        def rival(pair: tuple[int, int], side: int) -> bool:
            """Whether another track of the same time fits the same one better."""
            for each in kept:
                same, differs = each[1 - side] == pair[1 - side], each[side] != pair[side]
                if same and differs and error[each] < error[pair]:
                    (low, high), (first, last) = spans[side][each[side]], spans[side][pair[side]]
                    if min(high, last) > max(low, first):
                        return True
            return False

        pairs = [pair for pair in sorted(kept) if not rival(pair, 0) and not rival(pair, 1)]
        stop = np.append(one.first[1:], len(one.frame))
        rows = [np.arange(one.first[who], stop[who]) for who, _ in pairs]
        whom = [np.full(len(each), pair[1]) for each, pair in zip(rows, pairs, strict=True)]
        every, tracks = (np.concatenate([np.zeros(0, np.intp), *each]) for each in (rows, whom))
        thin = max(1, -(-len(every) // _MOST_SAMPLES))
        return every[::thin], tracks[::thin]

    def miss(self, a: int, b: int, rows: Index, track: Index, apart: float) -> tuple[Array, Array]:
        """(N, J) by how much rays of camera b, `apart` frames later, miss those of `rows`; and its change a frame."""
        one, other = self.tracks[a], self.tracks[b]
        rays, speed, size = other.at(track, one.frame[rows] + apart)
        normal = normals(one.rays[rows], self.views, a, b)
        miss = np.einsum("njk,njk->nj", normal, rays) / size[:, None]
        return miss, np.einsum("njk,njk->nj", normal, speed) / size[:, None]

    def nearest(self, reach: float, step: float) -> "_Network":
        """The same with shifts that fit best among those within `reach` frames, camera after camera."""
        V, shift = len(self.tracks), self.shift.copy()
        pairs = {pair: self.matched(*pair) for pair in combinations(range(V), 2)}
        tried = np.arange(-reach, reach + step / 2, step)
        cost = {}
        wide = np.arange(-2 * reach, 2 * reach + step / 2, step)
        for (a, b), (rows, track) in pairs.items():
            apart = shift[b] - shift[a]
            thin = max(1, len(rows) // 600)
            misses = [self.miss(a, b, rows[::thin], track[::thin], apart + each)[0] for each in wide]
            stack = np.stack(misses) if len(rows) > 0 else np.full((len(wide), 1, 1), np.nan)
            both = np.isfinite(stack).all(axis=0)
            width = 1.5 * np.median(np.abs(stack).min(axis=0)[both]) + 0.005 if both.any() else 1.0
            cost[a, b] = np.log1p((stack[:, both] / width) ** 2).sum(axis=1)
        place = np.full(V, len(tried) // 2)
        for _ in range(3):
            for view in range(1, V):
                total = np.zeros(len(tried))
                for (a, b), each in cost.items():
                    if view in (a, b):
                        own, its = np.arange(len(tried)), place[a if view == b else b]
                        apart = own - its if view == b else its - own
                        total += each[apart + len(wide) // 2]
                place[view] = int(np.argmin(total))
        return replace(self, shift=shift + tried[place])

    def solved(self) -> tuple[Array, Array]:
        """(V,) shifts in frames and their covariance (V, V), all pairs together."""
        V, shift = len(self.tracks), self.shift.copy()
        pairs = {pair: self.matched(*pair) for pair in combinations(range(V), 2)}
        block = max(1.0, min(_BLOCK_S * self.fps, max((np.ptp(t.frame) for t in self.tracks), default=1) / 12))
        for _ in range(8):
            H, g = np.zeros((V, V)), np.zeros(V)
            scores: dict[int, Array] = {}
            for (a, b), (rows, track) in pairs.items():
                miss, change = self.miss(a, b, rows, track, shift[b] - shift[a])
                known = np.isfinite(miss) & np.isfinite(change)
                if known.sum() < 20:
                    continue
                width = 3.8 * np.median(np.abs(miss[known]))
                pace = max(float(np.median(np.diff(self.tracks[a].frame[rows]))), 1.0)
                both = np.where(known, np.clip(miss, -width, width), 0.0), np.where(known, change, 0.0)
                smooth = _FAST_S * self.fps / pace
                miss, change = _fast(both, known, self.tracks[a].track[rows], track, smooth)
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


@dataclass(frozen=True)
class _Space:
    """People in space at T times, and their tracks: offsets are those at which each camera sees what others place."""

    tracks: list[Tracks]
    """Of each camera."""
    views: Views
    """The cameras."""
    shift: Array
    """(V,) frames: frame f of the first camera is frame f + shift of another."""
    time: Index
    """(P,) of each person, frames of the first camera."""
    member: Index
    """(P, V) the track of each person in each camera; -1 for none."""
    step: int
    """Frames from one time to the next."""
    fps: float
    """Frames a second."""

    @classmethod
    def of(cls, tracks: list[Tracks], views: Views, shift: Array, fps: float) -> "_Space":
        """People at times one after the other, as many as pay."""
        step = max(1, round(fps / 15))
        low = min(int((each.frame - at).min(initial=0)) for each, at in zip(tracks, shift, strict=True))
        high = max(int((each.frame - at).max(initial=0)) for each, at in zip(tracks, shift, strict=True))
        every = np.arange(low, high + 1, step)
        busy = sum(len(each.frame) for each in tracks) / max(high - low, 1)
        count = min(len(every), int(_MOST_PLACED / max(busy, 1.0)))
        times = every[(len(every) - count) // 2 :][:count]
        none = np.zeros(0, np.intp)
        time, view, track, xy = [none], [none], [none], [np.zeros((0, tracks[0].rays.shape[1], 2))]
        for v, each in enumerate(tracks):
            stop = np.append(each.first[1:], len(each.frame)) - 1
            inside = (times[:, None] + shift[v] >= each.frame[each.first]) & (times[:, None] + shift[v] < each.frame[stop])
            row, which = np.nonzero(inside)
            time.append(times[row])
            view.append(np.full(len(row), v))
            track.append(which)
            xy.append(_pixels(each.at(which, times[row] + shift[v])[0], views, v))
        xy, whose = np.concatenate(xy), np.concatenate(track)
        seen = Sightings(np.concatenate(time), np.concatenate(view), xy, np.isfinite(xy[..., 0]).astype(float))
        enough = np.isfinite(xy[..., 0]).sum(axis=1) >= MIN_JOINTS
        seen, whose = seen.only(enough), whose[enough]
        groups = Pairs.of(seen, views).groups(len(seen), tuple(range(len(tracks))))
        member = np.where(groups.member >= 0, np.append(whose, -1)[groups.member], -1)
        many = (member >= 0).sum(axis=1) >= 3
        return cls(tracks, views, shift, groups.frame[many], member[many], step, fps)

    def settled(self) -> tuple[Array, Array]:
        """(V,) shifts in frames and their covariance (V, V) as against the first camera."""
        V, shift = len(self.tracks), self.shift.copy()
        variance = np.full(V, np.inf)
        for _ in range(6):
            rays, speed, xy, size = self.seen(shift)
            late = np.zeros(V)
            for view in range(V):
                late[view], variance[view] = self.late(view, rays[:, :, view], speed, xy, size)
            late -= late.mean()
            shift -= late
            if np.abs(late).max() < 0.003:
                break
        covariance = np.diag(variance) + variance[0]
        covariance[0], covariance[:, 0] = 0.0, 0.0
        return shift - shift[0], covariance

    def seen(self, shift: Array) -> tuple[Array, Array, Array, Array]:
        """Directions and their speeds (P, J, V, 3), pixels (P, J, V, 2) and sizes (P, V) in rad of everybody in every camera."""
        parts = []
        for view, each in enumerate(self.tracks):
            rays, speed, size = each.at(np.maximum(self.member[:, view], 0), self.time + shift[view])
            there = self.member[:, view] >= 0
            rays = np.where(there[:, None, None], rays, np.nan)
            parts.append((rays, speed, _pixels(rays, self.views, view), np.where(there, size, np.nan)))
        rays, speed, xy, size = zip(*parts, strict=True)
        return np.stack(rays, axis=2), np.stack(speed, axis=2), np.stack(xy, axis=2), np.stack(size, axis=1)

    def _moving(self, points: Array, speed: Array) -> Array:
        """(P, J, 3) metres a frame of joints at `points`, from how directions to them change (P, J, V, 3)."""
        away = points[:, :, None] - centres_of(self.views)
        far = np.linalg.norm(away, axis=-1)[..., None]
        across = (np.eye(3) - (away / far)[..., :, None] * (away / far)[..., None, :]) / far[..., None] ** 2
        known = np.isfinite(speed) & np.isfinite(far)
        A = np.where(known[..., :1, None], across, 0.0).sum(axis=2)
        b = np.where(known, speed / far, 0.0).sum(axis=2)
        enough = known[..., 0].sum(axis=2) >= 2
        A[~enough] = np.eye(3)
        return np.where(enough[..., None], np.linalg.solve(A + 1e-6 * np.eye(3), b[..., None])[..., 0], np.nan)

    def late(self, view: int, rays: Array, speed: Array, xy: Array, size: Array) -> tuple[float, float]:
        """By how many frames one camera's clock is off against what the others place, and the variance."""
        xy = xy.copy()
        xy[:, :, view] = np.nan
        seen = np.isfinite(xy[..., 0])
        placed = triangulate(xy, seen.astype(float), size * self.views.focal_px, self.views, 3)
        away = placed.points - centres_of(self.views)[view]
        wrong = np.where(seen, placed.miss_px, 0.0).max(axis=-1) > GATE / 2 * np.nanmax(size * self.views.focal_px, axis=1)[:, None]
        good = ((seen.sum(axis=-1) >= 2) & ~wrong)[..., None]
        there = np.where(good, away / np.linalg.norm(away, axis=-1, keepdims=True), np.nan)
        theirs = _across(placed.points, self._moving(placed.points, np.where(seen[..., None], speed, np.nan)), centres_of(self.views)[view])
        order = np.lexsort((self.time, self.member[:, view]))
        order = order[self.member[order, view] >= 0]
        starts = np.flatnonzero(np.diff(self.member[order, view])) + 1
        off, change, own, now = [], [], [], []
        for rows in np.split(order, starts):
            at = (self.time[rows] - self.time[rows[0]]) // self.step if len(rows) > 0 else rows
            if len(rows) < 6:
                continue
            grid = np.full((4, at[-1] + 1, *there.shape[1:]), np.nan)
            grid[0, at], grid[1, at] = there[rows], rays[rows] / np.linalg.norm(rays[rows], axis=-1, keepdims=True)
            grid[1] -= grid[0]
            grid[2, at], grid[3, at] = theirs[rows], speed[rows, :, view]
            whose = float(np.median(size[rows, view]))
            length = np.linalg.norm(grid, axis=-1) / whose
            fastest = _FASTEST / self.fps
            fine = (length[1] < GATE / 2) & (length[2] < fastest) & (length[3] < fastest)
            grid[:, ~fine] = np.nan
            miss, calm, fast = (_brisk(each, _FAST_S * self.fps / self.step)[at] / whose for each in grid[1:])
            off.append(np.nan_to_num(miss))
            change.append(np.nan_to_num(calm))
            own.append(np.nan_to_num(fast))
            now.append(self.time[rows])
        if not off:
            return 0.0, np.inf
        miss, calm, fast, time = (np.concatenate(each) for each in (off, change, own, now))
        length = np.linalg.norm(miss, axis=-1)
        width = 2.5 * 1.2 * np.median(length[length > 0]) if (length > 0).any() else 1.0
        weight = 1 / (1 + (length / width) ** 2) ** 2
        # The speeds of what others place have not seen this camera's errors; its own say what a frame changes.
        gains = (weight * (calm * fast).sum(axis=-1)).sum(axis=1)
        if (gain := float(gains.sum())) <= 0:
            return 0.0, np.inf
        score = (weight * (calm * miss).sum(axis=-1)).sum(axis=1)
        late = score.sum() / gain
        score = score - late * gains
        block = max(1.0, min(_BLOCK_S * self.fps, np.ptp(time) / 12))
        sums = np.bincount(((time - time.min()) // block).astype(np.intp), score)
        return float(late), float((sums**2).sum() / gain**2 * len(sums) / max(len(sums) - 1, 1))


def _across(points: Array, moving: Array, centre: Array) -> Array:
    """(..., 3) how directions from `centre` to points change that move so."""
    away = points - centre
    far = np.linalg.norm(away, axis=-1, keepdims=True)
    return (moving - (moving * away).sum(axis=-1, keepdims=True) * away / far**2) / far


def _brisk(values: Array, width: float) -> Array:
    """Values (T, J, 3) less their means over the time around."""
    there = np.isfinite(values[..., :1])
    weight = gaussian_filter1d(there.astype(np.float64), width, axis=0, mode="constant")
    mean = gaussian_filter1d(np.where(there, values, 0.0), width, axis=0, mode="constant")
    return values - mean / np.maximum(weight, 1e-9)


def _pixels(rays: Array, views: Views, view: int) -> Array:
    """(N, J, 2) pixels of directions in the world (N, J, 3)."""
    at = rays @ (views.K[view] @ views.cTw[view, :, :3]).T
    return np.asarray(at[..., :2] / at[..., 2:])
