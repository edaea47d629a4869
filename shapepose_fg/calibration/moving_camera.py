"""Finds where, and when, the odometry of a moving camera starts, from people whom fixed cameras
place.

The size of a person in the picture gives approximate positions in the frame of the odometry. Each
pair of tracks, there and in the world, is registered at all time offsets; the registration on which
most people agree is refined by their projections. An ambiguous result is rejected.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial.transform import Rotation

from shapepose_fg.calibration.from_people import Undetermined
from shapepose_fg.calibration.people import Footage
from shapepose_fg.calibration.refinement import dilution
from shapepose_fg.core.arrays import Array, Index, Mask
from shapepose_fg.core.camera import Camera, Rig
from shapepose_fg.core.decompositions import nearest_rotation, rigid
from shapepose_fg.core.detections import DetectionSequence
from shapepose_fg.core.trajectory import Trajectory
from shapepose_fg.setup_check.matching import Sightings, median_of

_STEP_S, _LONGEST_S = 0.2, 180.0
"""Time between the moments at which people are placed, and duration used of a longer recording,
s."""
_LEAST_S, _LEAST_WAY_M = 4.0, 0.4
"""Minimum common duration of two tracks, s, and standard deviation of the person's position in it,
m."""
_SAME_M = 0.7
"""Maximum motion of a person between moments, m."""
_AGREE_M, _NEAR_M = 0.5, (0.6, 0.3, 0.2)
"""Distance, m, between positions from a person's size and those of the other cameras that agree;
and maximum median distance of a person's joints from their detections, m, by round."""
_PEAKS, _TRIED = 3, 60
"""Number of offsets for each pair of tracks, and of all registrations, that are tried."""
_OTHER_S, _OTHER_DEG = 1.0, 10.0
"""Distances above which two starts are different, s and degrees."""
_LEAST_SHARE, _LEAST_LEAD, _LEAST_PEOPLE = 0.5, 1.25, 25
"""Minimum share of the people in view that agree with the start, minimum ratio of their number to
that of any other start, and minimum number."""
_KNOTS, _DRIFT_M = 6, 0.01
"""Number of times between which an odometry drifts linearly, and minimum drift between them, m."""
_LEVEL_RAD, _TILT_RAD = np.radians(6.0), np.radians(0.5)
"""Maximum deviation from the vertical of a log's axis that is along gravity, and the standard
deviation of that of the world's vertical axis."""
_STEPS = 12
"""Maximum number of evaluations in each round of adjustment."""
_MOST_TURN_DEG, _MOST_MOVE_M = 2.0, 0.15
"""Maximum standard deviations of a start; the refinement of trajectories uses detections within 50
cm."""
_RIGID, _LONG_M, _FEWEST = 0.1, 0.25, 3
"""Maximum relative variation of the distance of two joints of a bone, its minimum, m, and minimum
number of bones that give the distance of a person."""
_LEAST_DEPTH_M, _SIGMA_M, _MOUNT_RAD = 0.3, 0.03, np.radians(0.5)
"""Minimum depth, and standard deviation of a detected joint from its position by other cameras, m;
and that of the principal point of a lens without calibration, as an angle."""
_QUARTERS = rigid(
    Rotation.from_euler("z", [[90 * n] for n in range(4)], degrees=True).as_matrix(),
    np.zeros((4, 3)),
)
"""Rotations of a picture relative to the axes of its log, which are those of the sensor."""


@dataclass(frozen=True)
class Placed:
    """People at regular moments, in three dimensions, with their tracks."""

    time_s: Array
    """(P,) time of each, seconds."""
    moment: Index
    """(P,) number of the moment, `_STEP_S` apart."""
    points: Array
    """(P, J, 3) core joints, metres; NaN where unknown."""
    velocity: Array
    """(P, J, 3) metres per second; 0 where unknown."""
    track: Index
    """(P,) track of each."""

    @classmethod
    def of(cls, time_s: Array, moment: Index, points: Array) -> "Placed":
        """People at times (P,), linked between consecutive moments."""
        one, other = list[int](), list[int]()
        for now in np.unique(moment).tolist():
            here, there = np.flatnonzero(moment == now), np.flatnonzero(moment == now + 1)
            if len(there) == 0:
                continue
            away = median_of(
                np.linalg.norm(points[here][:, None] - points[there], axis=-1), _FEWEST
            )
            near = away.argmin(axis=1)
            mutual = away.argmin(axis=0)[near] == np.arange(len(here))
            mutual &= away.min(axis=1) < _SAME_M
            one += here[mutual].tolist()
            other += there[near[mutual]].tolist()
        links = coo_array((np.ones(len(one)), (one, other)), shape=(len(moment),) * 2)
        before, after = np.arange(len(moment)), np.arange(len(moment))
        before[other], after[one] = one, other
        lasts = np.maximum(time_s[after] - time_s[before], _STEP_S / 2)[:, None, None]
        velocity = np.nan_to_num((points[after] - points[before]) / lasts)
        return cls(time_s, moment, points, velocity, connected_components(links, False)[1])

    @classmethod
    def by_cameras(
        cls, detections: DetectionSequence, given: Rig, rig: Rig, time_s: Array
    ) -> "Placed":
        """The people of a recording as cameras `rig`, before calibration `given`, place them;
        frames at `time_s` (T, V), NaN for missing ones.
        """
        first = float(np.sort(np.nanmin(time_s, axis=0))[1])
        last = min(float(np.sort(np.nanmax(time_s, axis=0))[-2]), first + _LONGEST_S)
        moments = np.arange(first, last, _STEP_S)
        number = np.full(time_s.shape, -1)
        for own, found in zip(time_s.T, number.T, strict=True):
            frame = _nearest(own, moments)
            found[frame[frame >= 0]] = np.flatnonzero(frame >= 0)
        seen = Sightings.of(detections, np.flatnonzero((number >= 0).any(axis=1)).tolist())
        seen = replace(seen, frame=number[seen.frame, seen.view])
        footage = Footage.taken(seen.rows(seen.frame >= 0), given, detections.skeleton)
        people = footage.people(rig)
        return cls.of(moments[people.frame], people.frame, people.points)

    def grid(self, track: int, length: int) -> Array:
        """(length, J, 3) positions of a track by moment; NaN where unknown."""
        rows = np.flatnonzero(self.track == track)
        found = np.full((length, *self.points.shape[1:]), np.nan)
        found[self.moment[rows]] = self.points[rows]
        return found


@dataclass(frozen=True)
class Start:
    """The start of the odometry of a moving camera."""

    wTo: Array
    """(4, 4) world from odometry."""
    bTc: Array
    """(4, 4) the camera on the carrier: a quarter turn of the picture."""
    offset_s: float
    """Time of the fixed cameras' clock at time 0 of the camera's own, s."""
    focal: float = 1.0
    """Ratio of the focal length to the given one."""
    agreeing: float = 0.0
    """Number of people that agree, nearer ones counting more."""
    share: float = 0.0
    """Share of the people in view that agree."""
    sigma_turn_deg: float = np.inf
    """Standard deviation of the rotation, degrees."""
    sigma_move_m: float = np.inf
    """Standard deviation of the camera's position, metres."""

    def of(self, camera: Camera, odometry: Trajectory) -> tuple[Camera, Trajectory]:
        """The camera on its trajectory, in the world and on the clock of the fixed cameras."""
        K = camera.K.copy()
        K[[0, 1], [0, 1]] *= self.focal
        moved = replace(
            odometry, time_s=odometry.time_s + self.offset_s, wTb=self.wTo @ odometry.wTb
        )
        return replace(camera, K=K, bTc=self.bTc), moved

    def words(self, name: str) -> str:
        """How well the start of a camera is known."""
        return (
            f"camera {name}: its trajectory starts {self.offset_s:+.3f} s after the first camera; "
            f"{self.share:.0%} of the people in its view agree; its start is known to "
            f"{self.sigma_turn_deg:.1f} degrees and {1e3 * self.sigma_move_m:.0f} mm (one sigma)"
        )


@dataclass(frozen=True)
class Filmed:
    """The people whom a moving camera has seen."""

    camera: Camera
    """The camera."""
    trajectory: Trajectory
    """Its odometry, on its own clock."""
    own_s: Array
    """(F,) times of frames with people, ascending, on its own clock."""
    rays: Array
    """(F, K, J, 3) joints of up to K people of a frame at depth 1 in the camera; NaN for none."""

    @classmethod
    def of(
        cls, detections: DetectionSequence, camera: Camera, trajectory: Trajectory, own_s: Array
    ) -> "Filmed":
        """The people of a recording with one camera, its frames at times `own_s` (T,), NaN for
        missing ones.
        """
        used = np.flatnonzero(np.isfinite(own_s))
        used = used[trajectory.covers(own_s[used])]
        seen = Sightings.of(detections, used.tolist())
        frames, row = np.unique(seen.frame, return_inverse=True)
        place = np.arange(len(row)) - np.searchsorted(row, row)
        rays = np.full((len(frames), place.max(initial=0) + 1, *seen.xy.shape[1:-1], 3), np.nan)
        K = np.linalg.inv(camera.K)
        rays[row, place] = seen.xy @ K[:2, :2].T @ np.eye(2, 3) + [*K[:2, 2], 1.0]
        return cls(camera, trajectory, own_s[frames], rays)

    def started(self, placed: Placed, most_s: float, focal: bool) -> Start:
        """The start on which most people agree, up to `most_s` from the fixed cameras' clock;
        `focal`: whether the focal length is unknown, too.

        Raises Undetermined, with a sentence, if it is ambiguous or too inaccurate.
        """
        cure = (
            "film the people whom the other cameras see for half a minute while they walk about, "
            "and check its log and its field of view"
        )

        def refuse(why: str) -> Undetermined:
            return Undetermined((f"camera {self.camera.name}: {why}; {cure}",))

        if min(len(self.own_s), len(placed.time_s)) < _LEAST_PEOPLE:
            raise refuse("too few people are seen by it, or by two other cameras")
        tried = sorted(self._registered(placed, most_s), key=lambda each: -each.agreeing)[:_TRIED]
        tried = [self._judged(each, placed, _NEAR_M[0]) for each in tried]
        tried.sort(key=lambda each: -each.agreeing)
        best = list[Start]()
        for each in tried:
            rival = each.agreeing > tried[0].agreeing / 2 and len(best) < _PEAKS
            if rival and all(self._differ(each, other) for other in best):
                best.append(self._refined(each, placed, most_s, focal))
        best.sort(key=lambda each: -each.agreeing)
        if not best or best[0].agreeing < _LEAST_PEOPLE or best[0].share < _LEAST_SHARE:
            raise refuse("no start of its trajectory agrees with the people of the other cameras")
        first = best[0]
        others = [each.agreeing for each in best[1:] if self._differ(each, first)]
        if first.agreeing < _LEAST_LEAD * max(others, default=0.0):
            raise refuse("two starts of its trajectory agree with the people about equally well")
        if first.sigma_turn_deg > _MOST_TURN_DEG or first.sigma_move_m > _MOST_MOVE_M:
            raise refuse(
                f"the people determine the start of its trajectory to {first.sigma_turn_deg:.1f} "
                f"degrees and {100 * first.sigma_move_m:.0f} cm only"
            )
        return first

    def _differ(self, one: Start, other: Start) -> bool:
        """Whether two starts are different poses or times of the camera."""
        middle = len(self.own_s) // 2
        a, b = ((each.wTo @ self._poses(each.bTc)[middle])[:3, :3] for each in (one, other))
        turn = np.degrees(Rotation.from_matrix(a.T @ b).magnitude())
        return bool(abs(one.offset_s - other.offset_s) > _OTHER_S or turn > _OTHER_DEG)

    def _poses(self, bTc: Array) -> Array:
        """(F, 4, 4) odometry from camera, for a mount."""
        return self._oTb @ bTc

    @cached_property
    def _oTb(self) -> Array:
        return self.trajectory.at(self.own_s)

    def _registered(self, placed: Placed, most_s: float) -> list[Start]:
        """Approximate starts from pairs of tracks; `agreeing` is a score."""
        depth = _depth(self.rays, placed.points)
        moment = np.rint((self.own_s - self.own_s[0]) / _STEP_S).astype(np.intp)
        frames = _nearest(self.own_s, self.own_s[0] + _STEP_S * np.arange(moment.max() + 1))
        frames = frames[frames >= 0]
        frame, person = np.nonzero(np.isfinite(depth[frames]))
        frame = frames[frame]
        points = depth[frame, person, None, None] * self.rays[frame, person]
        length = 1 << int(max(moment.max(), placed.moment.max()) * 2 + 1).bit_length()
        fixed = [
            _Spectrum.of(grid)
            for track in range(placed.track.max(initial=-1) + 1)
            if _lasts(grid := placed.grid(track, length))
        ]
        begin, found = float((placed.time_s - _STEP_S * placed.moment)[0]), list[Start]()
        for bTc in _QUARTERS:
            oTc = self._poses(bTc)[frame]
            own = points @ oTc[:, :3, :3].mT + oTc[:, None, :3, 3]
            moving = Placed.of(self.own_s[frame], moment[frame], own)
            grids = (moving.grid(n, length) for n in range(moving.track.max(initial=-1) + 1))
            spectra = [_Spectrum.of(grid) for grid in grids if _lasts(grid)]
            for one, other in product(fixed, spectra):
                lags, wTo, score = one.over(other)
                offset = _STEP_S * lags + begin - self.own_s[0]
                score = np.where(np.abs(offset) <= most_s + _STEP_S, score, 0.0)
                for _ in range(_PEAKS):
                    if score[at := int(score.argmax())] > 0:
                        found.append(
                            Start(
                                wTo[at],
                                bTc,
                                float(np.clip(offset[at], -most_s, most_s)),
                                agreeing=score[at],
                            )
                        )
                    score = np.where(np.abs(offset - offset[at]) > _OTHER_S, score, 0.0)
        return found

    def _matched(
        self, start: Start, placed: Placed, near_m: float
    ) -> tuple[Index, Index, Index, Array, Mask]:
        """Placed people (N,), the frames (N,) and persons in it (N,) nearest to them, their
        distances (N,), metres, and whether they are in view.
        """
        frame = _nearest(self.own_s, placed.time_s - start.offset_s)
        rows = np.flatnonzero(frame >= 0)
        frame = frame[rows]
        at = self._seen(start, placed, rows, frame)
        depth = median_of(at[..., 2], 5)
        with np.errstate(divide="ignore", invalid="ignore"):
            xy = at[..., :2] / at[..., 2:] * start.focal
            away = np.linalg.norm(self.rays[frame][..., :2] - xy[:, None], axis=-1)
            away = median_of(away, 5) * depth[:, None] / start.focal
            middle = np.stack([median_of(each, 5) for each in np.moveaxis(xy, 2, 0)], axis=-1)
            middle = middle @ self.camera.K[:2, :2].T + self.camera.K[:2, 2]
        person = away.argmin(axis=1)
        away = away[np.arange(len(rows)), person]
        inside = (middle > 0).all(axis=1) & (middle < self.camera.image_size).all(axis=1)
        inside &= depth > _LEAST_DEPTH_M
        return rows, frame, person, np.where(depth > _LEAST_DEPTH_M, away, np.inf), inside

    def _seen(self, start: Start, placed: Placed, rows: Index, frame: Index) -> Array:
        """(N, J, 3) joints of placed people in the camera, at the times of the frames (N,)."""
        later = self.own_s[frame] + start.offset_s - placed.time_s[rows]
        points = placed.points[rows] + later[:, None, None] * placed.velocity[rows]
        wTc = start.wTo @ self._poses(start.bTc)[frame]
        return (points - wTc[:, None, :3, 3]) @ wTc[:, :3, :3]

    def _judged(self, start: Start, placed: Placed, near_m: float) -> Start:
        *_, away, inside = self._matched(start, placed, near_m)
        agreeing = np.clip(1 - away / near_m, 0.0, 1.0)
        share = float((agreeing[inside] > 0).mean()) if inside.any() else 0.0
        return replace(start, agreeing=float(agreeing.sum()), share=share)

    def _refined(self, start: Start, placed: Placed, most_s: float, focal: bool) -> Start:
        """The start adjusted to the projections of the people that agree."""
        free, bTc = np.array([True] * 6 + [most_s > 0] + [focal] * 4), start.bTc
        for number, near_m in enumerate(_NEAR_M):
            rows, frame, person, away, _ = self._matched(start, placed, near_m)
            used = away < near_m
            if used.sum() < _LEAST_PEOPLE:
                return self._judged(start, placed, near_m)
            given = replace(start, bTc=bTc)
            fit = _Fit(self, placed, given, free, rows[used], frame[used], person[used])
            start, sigma = fit.solved(_KNOTS if number == len(_NEAR_M) - 1 else 1)
        start = replace(
            start,
            sigma_turn_deg=float(np.degrees(np.linalg.norm(sigma[:3]))),
            sigma_move_m=float(np.linalg.norm(sigma[3:6])),
        )
        return self._judged(start, placed, _NEAR_M[-1])


@dataclass(frozen=True)
class _Fit:
    """Adjustment of a start: rotation and translation about the middle of the path, offset, log of
    the focal length, and rotation of the camera on its carrier, which is that of an unknown
    principal point, too.
    """

    filmed: Filmed
    placed: Placed
    start: Start
    free: Mask
    """(11,) mask of the parameters that are adjusted."""
    rows: Index
    frame: Index
    person: Index

    def moved(self, x: Array) -> Start:
        """The start changed by the free parameters, the first ones of `x`."""
        every, given = np.zeros(len(self.free)), self.start
        every[self.free] = x[: self.free.sum()]
        middle = (given.wTo @ self.filmed._poses(given.bTc)[self.frame])[:, :3, 3].mean(axis=0)
        turn, mount = Rotation.from_rotvec(every[[[0, 1, 2], [8, 9, 10]]]).as_matrix()
        return replace(
            given,
            wTo=rigid(turn, middle + every[3:6] - turn @ middle) @ given.wTo,
            bTc=given.bTc @ rigid(mount, np.zeros(3)),
            offset_s=given.offset_s + every[6],
            focal=given.focal * float(np.exp(every[7])),
        )

    def solved(self, knots: int) -> tuple[Start, Array]:
        """The adjusted start, and standard deviations of the free parameters, if the odometry's
        drift is linear between `knots` (1: no drift).
        """
        filmed, free = self.filmed, int(self.free.sum())
        rays = filmed.rays[self.frame, self.person]
        known = np.isfinite(rays[..., 0] + self.placed.points[self.rows][..., 0])
        count = dilution(self.placed.time_s[self.rows])
        mount = np.flatnonzero(np.flatnonzero(self.free) >= 8)
        # The log has an axis along gravity if one is vertical within a few degrees.
        axis = np.argmax(np.abs(self.start.wTo[2, :3]))
        level = abs(self.start.wTo[2, axis]) > np.cos(_LEVEL_RAD)
        at = np.linspace(filmed.own_s[0], filmed.own_s[-1], knots)
        own_s = filmed.own_s
        grows = np.cumsum(filmed.trajectory.drifted(filmed._oTb, own_s)[:, 3, 3])
        drifts = np.sqrt(np.diff(np.interp(at, own_s[1:], grows)) + _DRIFT_M**2)
        part = np.array([np.interp(own_s[self.frame], at, row) for row in np.eye(knots)[1:]])

        def residuals(x: Array) -> Array:
            now, drift = self.moved(x), x[free:].reshape(-1, 3)
            at = filmed._seen(now, self.placed, self.rows, self.frame)
            if knots > 1:
                wRc = (now.wTo @ filmed._poses(now.bTc)[self.frame])[:, :3, :3]
                at = at - np.einsum("nji,nj->ni", wRc, part.T @ drift)[:, None]
            depth = np.maximum(at[known][:, 2:], _LEAST_DEPTH_M)
            away = (rays[known][:, :2] / now.focal * depth - at[known][:, :2]) / _SIGMA_M
            steps = np.diff(drift, axis=0, prepend=0.0) / drifts[:, None]
            tilt = now.wTo[:2, axis] / _TILT_RAD * level
            priors = np.concatenate([x[mount] / _MOUNT_RAD, tilt, steps.ravel()])
            return np.concatenate([away.ravel(), np.sqrt(count) * priors])

        begin = np.zeros(free + 3 * (knots - 1))
        fit = least_squares(residuals, begin, x_scale=0.01, loss="cauchy", max_nfev=_STEPS)
        misfit = max(1.0, float(np.median(np.abs(fit.fun)) / 0.6745))
        variance = np.diag(np.linalg.pinv(fit.jac.T @ fit.jac, hermitian=True))
        return self.moved(fit.x), misfit * np.sqrt(count * np.maximum(variance, 0.0))


@dataclass(frozen=True)
class _Spectrum:
    """Fourier transforms of a track's moments, for its registration at all lags."""

    known: NDArray[np.complex128]
    """(L, J) mask of joints."""
    points: NDArray[np.complex128]
    """(L, J, 3) joints, relative to `centre`."""
    square: NDArray[np.complex128]
    """(L, J) squared distance of joints from `centre`."""
    centre: Array
    """(3,) mean position."""

    @classmethod
    def of(cls, grid: Array) -> "_Spectrum":
        known = np.isfinite(grid[..., 0])
        centre = grid[known].mean(axis=0)
        points = np.where(known[..., None], grid - centre, 0.0)
        mask, moved, square = (
            np.fft.rfft(each, axis=0)
            for each in (known.astype(float), points, (points**2).sum(axis=-1))
        )
        return cls(mask, moved, square, centre)

    def over(self, other: "_Spectrum") -> tuple[Index, Array, Array]:
        """Registrations of `other` at all lags (L,), in moments: (L, 4, 4) this frame from the
        other, and scores (L,): the number of joints, nearer ones counting more.
        """

        def correlated(of: str, a: NDArray[np.complex128], b: NDArray[np.complex128]) -> Array:
            return np.fft.irfft(np.einsum(of, a, b.conj()), axis=0)

        count = correlated("fj,fj->f", self.known, other.known)
        n = np.maximum(count, 1.0)
        p = correlated("fji,fj->fi", self.points, other.known) / n[:, None]
        q = correlated("fj,fji->fi", self.known, other.points) / n[:, None]
        both = correlated("fji,fjk->fik", self.points, other.points) / n[:, None, None]
        both -= p[:, :, None] * q[:, None]
        spread = [
            correlated("fj,fj->f", *each) / n - (mean**2).sum(axis=-1)
            for each, mean in (
                ((self.square, other.known), p),
                ((self.known, other.square), q),
            )
        ]
        R = nearest_rotation(both)
        agreed = np.einsum("lij,lij->l", R, both)
        left = np.maximum(spread[0] + spread[1] - 2 * agreed, 0.0)
        least = _LEAST_S / _STEP_S * self.known.shape[1] / 2
        score = count * np.clip(1 - left / _AGREE_M**2, 0.0, None)
        score[(count < least) | (spread[0] < _LEAST_WAY_M**2)] = 0.0
        t = p + self.centre - np.einsum("lij,lj->li", R, q + other.centre)
        length = len(count)
        return (np.arange(length) + length // 2) % length - length // 2, rigid(R, t), score


def _lasts(grid: Array) -> bool:
    """Whether a track is long enough to be registered."""
    return bool(np.isfinite(grid[..., 0]).any(axis=1).sum() >= _LEAST_S / _STEP_S)


def _nearest(own: Array, times: Array) -> Index:
    """(M,) frame, of those at `own` (T,), ascending or NaN, nearest to each time; -1 if half a
    moment lies between.
    """
    there = np.flatnonzero(np.isfinite(own))
    after = np.searchsorted(own[there], times).clip(1, len(there) - 1)
    nearer = times - own[there[after - 1]] < own[there[after]] - times
    frame = there[after - nearer]
    return np.where(np.abs(own[frame] - times) <= _STEP_S / 2, frame, -1)


def _depth(rays: Array, points: Array) -> Array:
    """(F, K) approximate depths, m, of people with `rays` (F, K, J, 3), if their bones are as long
    as those of placed people (P, J, 3).
    """
    a, b = np.triu_indices(points.shape[1], 1)
    low, middle, high = np.nanpercentile(
        np.linalg.norm(points[:, a] - points[:, b], axis=-1), [16, 50, 84], axis=0
    )
    bones = (high - low < 2 * _RIGID * middle) & (middle > _LONG_M)
    a, b, length = a[bones], b[bones], middle[bones]
    depth = length / np.maximum(
        np.linalg.norm(rays[:, :, a, :2] - rays[:, :, b, :2], axis=-1), 1e-6
    )
    # Bones that are inclined to the picture seem farther away.
    depth = np.sort(depth, axis=-1)
    enough = np.isfinite(depth).sum(axis=-1) >= _FEWEST
    return np.where(enough, depth[..., _FEWEST - 1], np.nan)
