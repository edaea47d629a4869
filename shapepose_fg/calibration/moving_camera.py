"""Finds where, and when, the odometry of a moving camera starts, from people whom fixed cameras
place.

The size of a person in the picture gives approximate positions in the frame of the odometry. Each
pair of tracks, there and in the world, is registered at all time offsets; the registration on which
most people agree is refined by their projections. An ambiguous result is rejected.
"""

from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from shapepose_fg.calibration.adjustment import Adjusted
from shapepose_fg.calibration.from_people import Undetermined
from shapepose_fg.calibration.people import MIN_DEPTH_M, Footage, People
from shapepose_fg.calibration.refinement import dilution
from shapepose_fg.core.arrays import Array, Index, Mask
from shapepose_fg.core.camera import Camera, Rig, Views
from shapepose_fg.core.decompositions import nearest_rotation, rigid
from shapepose_fg.core.detections import DetectionSequence
from shapepose_fg.core.trajectory import Trajectory
from shapepose_fg.setup_check.fit import POSE, Q, by_parameters, seen_by
from shapepose_fg.setup_check.matching import Sightings, follow, median_of

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
_KNOT_S, _DRIFT_M, _DRIFT_RAD = 5.0, 0.005, np.radians(0.1)
"""Time between the knots between which an odometry drifts linearly, s, and minimum drift between
them, m and rad."""
_VIEWS_CHANGE = 0.5
"""Ratio of the correlated errors of a detector that count as one in a camera that moves to those in
a fixed one; it sees people from changing directions (scripts/check_phones.py)."""
_DRIFTS = np.log(3.0)
"""Standard deviation of the log of the ratio of an odometry's drift to the stated one."""
_LEVEL_RAD, _TILT_RAD = np.radians(6.0), np.radians(0.5)
"""Maximum deviation from the vertical of a log's axis that is along gravity, and the standard
deviation of that of the world's vertical axis."""
_STEPS = 12
"""Maximum number of evaluations in each round of adjustment."""
_SAMPLES, _TINY, _LEAST_VARIANCE = 30, 1e-4, 1e-6
"""Number of frames for which the uncertainty of poses is averaged; step of numerical derivatives;
and minimum share of a parameter's variance that is an error of its own."""
_WIDTH = 2.385
"""Width of the Cauchy kernel, in standard deviations: 95 % efficient for normal errors."""
_RIGID, _LONG_M, _FEWEST = 0.1, 0.25, 3
"""Maximum relative variation of the distance of two joints of a bone, its minimum, m, and minimum
number of bones that give the distance of a person."""
_SIGMA_M, _MOUNT_RAD = 0.03, np.radians(0.5)
"""Standard deviation of a detected joint from its position by other cameras, m, and of the
principal point of a lens without calibration, as an angle."""
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
    spread: Array
    """(M, P, J, 3) changes of the positions by one standard deviation of each of M independent
    errors of the fixed cameras, metres."""

    @classmethod
    def of(
        cls, time_s: Array, moment: Index, points: Array, spread: Array | None = None
    ) -> "Placed":
        """People at times (P,), linked between consecutive moments."""

        def away(one: Index, other: Index) -> Array:
            far = np.linalg.norm(points[one][:, None] - points[other], axis=-1)
            return median_of(far, _FEWEST)

        track = follow(moment, away, _SAME_M, 1)
        order = np.lexsort((moment, track))
        one, other = (pair[np.diff(track[order]) == 0] for pair in (order[:-1], order[1:]))
        before, after = np.arange(len(moment)), np.arange(len(moment))
        before[other], after[one] = one, other
        lasts = np.maximum(time_s[after] - time_s[before], _STEP_S / 2)[:, None, None]
        velocity = np.nan_to_num((points[after] - points[before]) / lasts)
        spread = np.zeros((0, *points.shape)) if spread is None else spread
        return cls(time_s, moment, points, velocity, track, spread)

    @classmethod
    def by_cameras(
        cls, detections: DetectionSequence, given: Rig, found: Adjusted, time_s: Array
    ) -> "Placed":
        """The people of a recording as the cameras `found`, before calibration `given`, place them;
        frames at `time_s` (T, V), NaN for missing ones.
        """
        first = float(np.sort(np.nanmin(time_s, axis=0))[1])
        last = min(float(np.sort(np.nanmax(time_s, axis=0))[-2]), first + _LONGEST_S)
        moments = np.arange(first, last, _STEP_S)
        number = np.full(time_s.shape, -1)
        for own, of_moment in zip(time_s.T, number.T, strict=True):
            frame = _nearest(own, moments)
            of_moment[frame[frame >= 0]] = np.flatnonzero(frame >= 0)
        seen = Sightings.of(detections, np.flatnonzero((number >= 0).any(axis=1)).tolist())
        seen = replace(seen, frame=number[seen.frame, seen.view])
        footage = Footage.taken(seen.rows(seen.frame >= 0), given, detections.skeleton)
        people = footage.people(found.rig)
        spread = _moved_by(people, found)
        return cls.of(moments[people.frame], people.frame, people.points, spread)

    def grid(self, track: int, length: int) -> Array:
        """(length, J, 3) positions of a track by moment; NaN where unknown."""
        rows = np.flatnonzero(self.track == track)
        found = np.full((length, *self.points.shape[1:]), np.nan)
        found[self.moment[rows]] = self.points[rows]
        return found


def _moved_by(people: People, found: Adjusted) -> Array:
    """(M, P, J, 3) changes of people's joints, m, by one standard deviation of each of the M
    independent errors of the cameras that place them.
    """
    rig, size = found.rig, int(np.prod(found.covariance.shape[:2]))
    square = found.covariance.reshape(size, size)
    sigma = np.sqrt(np.maximum(np.diag(square), 0.0))
    scale = np.where(sigma > 0, sigma, 1.0)
    values, vectors = np.linalg.eigh(square / scale / scale[:, None])
    kept = values > _LEAST_VARIANCE
    errors = (sigma[:, None] * vectors[:, kept] * np.sqrt(values[kept])).T
    views, points = Views.of(rig), np.nan_to_num(people.points)
    xy, at, by_place = seen_by(points, views)
    by_camera = by_parameters(xy, at, by_place, views)
    by_camera[..., POSE] *= -1  # poses are those of the cameras in the world
    weight = np.where(people.seen, 1 / people.sigma_px, 0.0)[..., None, None]
    by_point, by_camera = weight * (by_place @ views.cTw[:, :, :3]), weight * by_camera
    inverse = np.linalg.pinv(np.einsum("pjvri,pjvrk->pjik", by_point, by_point), hermitian=True)
    errors = errors.reshape(len(errors), *found.covariance.shape[:2])[..., :Q]
    missed = np.einsum("pjvrq,mvq->mpjvr", by_camera, errors)
    return -np.einsum("pjik,pjvrk,mpjvr->mpji", inverse, by_point, missed, optimize=True)


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
    stretch: float = 1.0
    """Ratio of the world's unit to that of the odometry."""
    knots_s: Array = field(default_factory=lambda: np.zeros(1))
    """(K,) times on the camera's own clock between which its drift is linear."""
    drift: Array = field(default_factory=lambda: np.zeros((1, 6)))
    """(K, 6) corrections of the odometry's drift in the world: rotation vectors and metres."""
    agreeing: float = 0.0
    """Number of people that agree, nearer ones counting more."""
    share: float = 0.0
    """Share of the people in view that agree."""
    sigma_turn_deg: float = np.inf
    """Standard deviation of the camera's rotations, degrees, errors of the fixed cameras, of the
    lens and of the drift included."""
    sigma_move_m: float = np.inf
    """Standard deviation of the camera's positions, metres."""

    def carrier(self, oTb: Array, own_s: Array) -> Array:
        """(F, 4, 4) poses of the carrier in the world, from those in its odometry at times (F,)."""
        drift = np.stack([np.interp(own_s, self.knots_s, each) for each in self.drift.T], axis=-1)
        wRo, at = self.wTo[:3, :3], self.stretch * oTb[:, :3, 3]
        turn = Rotation.from_rotvec(drift[:, :3]).as_matrix()
        return rigid(turn @ wRo @ oTb[:, :3, :3], at @ wRo.T + self.wTo[:3, 3] + drift[:, 3:])

    def of(self, camera: Camera, odometry: Trajectory) -> tuple[Camera, Trajectory]:
        """The camera on its trajectory, in the world and on the clock of the fixed cameras, without
        the drift that is known.
        """
        K = camera.K.copy()
        K[[0, 1], [0, 1]] *= self.focal
        wTb = self.carrier(odometry.wTb, odometry.time_s)
        moved = replace(odometry, time_s=odometry.time_s + self.offset_s, wTb=wTb)
        return replace(camera, K=K, bTc=self.bTc), moved

    def words(self, name: str) -> str:
        """How well the start of a camera is known."""
        return (
            f"camera {name}: its trajectory starts {self.offset_s:+.3f} s after the first camera; "
            f"{self.share:.0%} of the people in its view agree; its poses are known to "
            f"{self.within()} (two sigma)"
        )

    def as_dict(self) -> dict[str, float]:
        """The figures as plain values."""
        return {
            "start_s": round(self.offset_s, 5),
            "agreeing": round(self.share, 3),
            "sigma_turn_deg": round(self.sigma_turn_deg, 3),
            "sigma_move_mm": round(1e3 * self.sigma_move_m, 1),
        }

    def refusal(self, name: str, most_deg: float, most_m: float) -> str | None:
        """A sentence on camera `name`, with the cure, if two standard deviations of its poses
        exceed `most_deg` degrees or `most_m` metres; else None.
        """
        if 2 * self.sigma_turn_deg <= most_deg and 2 * self.sigma_move_m <= most_m:
            return None
        return (
            f"camera {name}: its poses are known to {self.within()} only (two sigma), but "
            f"{most_deg:g} degrees and {1e3 * most_m:g} mm are asked; calibrate the lenses, film "
            "two people, or accept the cameras as they are"
        )

    def within(self) -> str:
        """Two standard deviations of the poses, in words."""
        return f"{2 * self.sigma_turn_deg:.1f} degrees and {2e3 * self.sigma_move_m:.0f} mm"


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

    def started(
        self,
        placed: Placed,
        most_s: float,
        focal: bool,
        sigma_scale: float = 0.0,
    ) -> Start:
        """The start on which most people agree, up to `most_s` from the fixed cameras' clock;
        `focal`: whether the focal length and the principal point are unknown, too; `sigma_scale`:
        standard deviation of the world's scale, as a share.

        Raises Undetermined, with a sentence, if it is ambiguous.
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
                best.append(self._refined(each, placed, most_s, focal, sigma_scale))
        best.sort(key=lambda each: -each.agreeing)
        if not best or best[0].agreeing < _LEAST_PEOPLE or best[0].share < _LEAST_SHARE:
            raise refuse("no start of its trajectory agrees with the people of the other cameras")
        first = best[0]
        others = [each.agreeing for each in best[1:] if self._differ(each, first)]
        if first.agreeing < _LEAST_LEAD * max(others, default=0.0):
            raise refuse("two starts of its trajectory agree with the people about equally well")
        return first

    def _differ(self, one: Start, other: Start) -> bool:
        """Whether two starts are different poses or times of the camera."""
        middle = len(self.own_s) // 2
        a, b = (self._placed(each, [middle])[0, :3, :3] for each in (one, other))
        turn = np.degrees(Rotation.from_matrix(a.T @ b).magnitude())
        return bool(abs(one.offset_s - other.offset_s) > _OTHER_S or turn > _OTHER_DEG)

    def _placed(self, start: Start, frame: Index | list[int]) -> Array:
        """(N, 4, 4) world from camera in some frames (N,)."""
        return start.carrier(self._oTb[frame], self.own_s[frame]) @ start.bTc

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
            oTc = (self._oTb @ bTc)[frame]
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
        inside &= depth > MIN_DEPTH_M
        return rows, frame, person, np.where(depth > MIN_DEPTH_M, away, np.inf), inside

    def _seen(self, start: Start, placed: Placed, rows: Index, frame: Index) -> Array:
        """(N, J, 3) joints of placed people in the camera, at the times of the frames (N,)."""
        later = self.own_s[frame] + start.offset_s - placed.time_s[rows]
        points = placed.points[rows] + later[:, None, None] * placed.velocity[rows]
        wTc = self._placed(start, frame)
        return (points - wTc[:, None, :3, 3]) @ wTc[:, :3, :3]

    def _judged(self, start: Start, placed: Placed, near_m: float) -> Start:
        *_, away, inside = self._matched(start, placed, near_m)
        agreeing = np.clip(1 - away / near_m, 0.0, 1.0)
        share = float((agreeing[inside] > 0).mean()) if inside.any() else 0.0
        return replace(start, agreeing=float(agreeing.sum()), share=share)

    def _refined(
        self, start: Start, placed: Placed, most_s: float, focal: bool, sigma_scale: float
    ) -> Start:
        """The start adjusted to the projections of the people that agree."""
        free = np.array([True] * 6 + [most_s > 0] + [focal] * 3 + [True])
        lasts, sigma_m, bTc = self.own_s[-1] - self.own_s[0], _SIGMA_M, start.bTc
        for number, near_m in enumerate(_NEAR_M):
            rows, frame, person, away, _ = self._matched(start, placed, near_m)
            used = away < near_m
            if used.sum() < _LEAST_PEOPLE:
                return self._judged(start, placed, near_m)
            knots = 1 + int(np.ceil(lasts / _KNOT_S)) if number == len(_NEAR_M) - 1 else 1
            knots_s = np.linspace(self.own_s[0], self.own_s[-1], knots)
            given = replace(start, bTc=bTc, knots_s=knots_s, drift=np.zeros((knots, 6)))
            people = (rows[used], frame[used], person[used])
            fit = _Fit(self, placed, given, free, sigma_m, sigma_scale, *people)
            start, sigma_m = fit.solved()
        return self._judged(start, placed, _NEAR_M[-1])


@dataclass(frozen=True)
class _Fit:
    """Adjustment of a start: rotation and translation about the middle of the path, offset, log of
    the focal length, rotation of the camera about its x and y axes, which is the effect of an
    unknown principal point, log of the odometry's unit, and its drift at the knots.
    """

    filmed: Filmed
    placed: Placed
    start: Start
    free: Mask
    """(11,) mask of the parameters before the drift that are adjusted."""
    sigma_m: float
    """Standard deviation of a joint, across the ray, m."""
    sigma_scale: float
    rows: Index
    frame: Index
    person: Index

    def moved(self, x: Array) -> Start:
        """The start changed by the free parameters, and by the drift at the knots but the first."""
        every, given, count = np.zeros(len(self.free)), self.start, int(self.free.sum())
        every[self.free] = x[:count]
        wRo, middle = given.wTo[:3, :3], self.filmed._oTb[self.frame, :3, 3].mean(axis=0)
        turn, mount = Rotation.from_rotvec([every[:3], [*every[8:10], 0.0]]).as_matrix()
        stretch = given.stretch * float(np.exp(every[10]))
        at = given.wTo[:3, 3] + given.stretch * wRo @ middle + every[3:6]
        return replace(
            given,
            wTo=rigid(turn @ wRo, at - stretch * turn @ wRo @ middle),
            bTc=given.bTc @ rigid(mount, np.zeros(3)),
            offset_s=given.offset_s + every[6],
            focal=given.focal * float(np.exp(every[7])),
            stretch=stretch,
            drift=self._drift(x[count:]),
        )

    def _drift(self, x: Array) -> Array:
        """(K, 6) drift at the knots, from steps in standard deviations."""
        drift = np.zeros((len(self.start.knots_s), 6))
        drift[1:, self._kinds] = np.cumsum(x.reshape(-1, len(self._kinds)) * self._steps, axis=0)
        return drift

    @cached_property
    def _axis(self) -> int:
        """Axis of the log that is next to the vertical."""
        return int(np.argmax(np.abs(self.start.wTo[2, :3])))

    @cached_property
    def _level(self) -> bool:
        """Whether the log has an axis along gravity: one is vertical within a few degrees."""
        return bool(abs(self.start.wTo[2, self._axis]) > np.cos(_LEVEL_RAD))

    @cached_property
    def _kinds(self) -> list[int]:
        """Rotations and translations that drift; gravity keeps two of the former."""
        return [2, 3, 4, 5] if self._level else list(range(6))

    @cached_property
    def _steps(self) -> Array:
        """(K - 1, D) standard deviations of the drift between knots."""
        filmed, own_s, knots_s = self.filmed, self.filmed.own_s, self.start.knots_s
        grown = np.cumsum(filmed.trajectory.drifted(filmed._oTb, own_s)[:, [0, 3], [0, 3]], axis=0)
        moved = np.diff(filmed.trajectory.at(knots_s)[:, :3, 3], axis=0)
        turn, move = (np.diff(np.interp(knots_s, own_s[1:], each)) for each in grown.T)
        turn = turn + _DRIFT_RAD**2
        move = move + turn * (moved**2).sum(axis=1) + _DRIFT_M**2
        return np.sqrt(np.stack([turn] * 3 + [move] * 3, axis=-1))[:, self._kinds]

    def solved(self) -> tuple[Start, float]:
        """The adjusted start, and the standard deviation of a joint."""
        filmed, free = self.filmed, int(self.free.sum())
        rays = filmed.rays[self.frame, self.person]
        known = np.isfinite(rays[..., 0] + self.placed.points[self.rows][..., 0])
        count = _VIEWS_CHANGE * dilution(self.placed.time_s[self.rows])
        mount = np.flatnonzero(np.isin(np.flatnonzero(self.free), (8, 9)))
        sigma_scale = np.hypot(self.sigma_scale, filmed.trajectory.drift)

        def data(now: Start, placed: Placed) -> Array:
            at = filmed._seen(now, placed, self.rows, self.frame)
            depth = np.maximum(at[known][:, 2:], MIN_DEPTH_M)
            return np.ravel(rays[known][:, :2] / now.focal * depth - at[known][:, :2])

        def residuals(x: Array) -> Array:
            now = self.moved(x)
            tilt = now.wTo[:2, self._axis] / _TILT_RAD * self._level
            unit = np.log(now.stretch) / sigma_scale
            priors = [x[mount] / _MOUNT_RAD, tilt, [unit], x[free:]]
            away = data(now, self.placed) / self.sigma_m
            return np.concatenate([away, np.sqrt(count) * np.concatenate(priors)])

        def loss(square: Array) -> Array:
            """Cauchy's kernel for the joints only, and its derivatives."""
            rho = np.stack([square, np.ones_like(square), np.zeros_like(square)])
            z = square[:joints] / _WIDTH**2
            rho[:, :joints] = [_WIDTH**2 * np.log1p(z), 1 / (1 + z), -1 / (_WIDTH * (1 + z)) ** 2]
            return rho

        begin, joints = np.zeros(free + self._steps.size), 2 * int(known.sum())
        fit = least_squares(residuals, begin, x_scale=0.01, loss=loss, max_nfev=_STEPS)  # type: ignore[arg-type]
        sigma = float(self.sigma_m * np.median(np.abs(fit.fun[:joints])) / 0.6745)
        robust = np.stack([loss(fit.fun**2)[n, :joints] for n in (1, 2)])
        weight = np.sqrt(np.maximum(robust[0] + 2 * robust[1] * fit.fun[:joints] ** 2, 0.0))
        information = fit.jac.T @ fit.jac / count
        kinds = np.r_[np.full(free, -1), np.tile(np.array(self._kinds) // 3, len(self._steps))]
        level, covariance = _drift_levels(information, fit.x, kinds)
        now = self.moved(x := covariance @ information @ fit.x)
        missed = data(now, self.placed)
        # A constant error of the fixed cameras changes all joints, and so the parameters.
        into = covariance @ fit.jac[:joints].T * weight / count / self.sigma_m
        others = [replace(self.placed, points=self.placed.points + e) for e in self.placed.spread]
        changed = [into @ (data(now, each) - missed) for each in others]
        errors = [covariance, *(np.outer(each, each) for each in changed)]
        turn, move = self._spread(x, np.sum(errors, axis=0), level)
        sigmas = {"sigma_turn_deg": np.degrees(turn), "sigma_move_m": move}
        return replace(now, **sigmas), sigma

    def _spread(self, x: Array, covariance: Array, level: Array) -> tuple[float, float]:
        """Standard deviations of the camera's poses, rad and m, root mean square over the path, for
        a covariance of the parameters `x`.
        """
        frames = np.unique(np.linspace(0, len(self.filmed.own_s) - 1, _SAMPLES).astype(np.intp))
        poses = self.filmed._placed(self.moved(x), frames)
        changes = np.empty((len(frames), 6, len(x)))
        for n, step in enumerate(_TINY * np.eye(len(x))):
            other = self.filmed._placed(self.moved(x + step), frames)
            turn = Rotation.from_matrix(poses[:, :3, :3].mT @ other[:, :3, :3]).as_rotvec()
            changes[..., n] = np.hstack([turn, other[:, :3, 3] - poses[:, :3, 3]]) / _TINY
        variance = np.einsum("fpn,nm,fpm->fp", changes, covariance, changes).mean(axis=0)
        if len(self._steps) > 0:  # a random walk deviates from the line between two knots
            steps = self._steps * level[np.array(self._kinds) // 3]
            variance[self._kinds] += (steps**2).mean(axis=0) / 6
        return float(np.sqrt(variance[:3].sum())), float(np.sqrt(variance[3:].sum()))


def _drift_levels(information: Array, x: Array, kinds: Index) -> tuple[Array, Array]:
    """Most probable ratios (2,) of the drift's rotations and translations to their standard
    deviations, and the covariance of all parameters `x` for these.

    `information` includes a unit prior on the parameters that are rotations (0 in `kinds`) or
    translations (1). The ratios' prior is log-normal; parameters are integrated out.
    """

    def judged(ratio: Array) -> tuple[float, Array]:
        sigma = np.where(kinds < 0, 1.0, ratio[kinds])
        inverse = np.linalg.pinv(information + np.diag(1 / sigma**2 - 1), hermitian=True)
        both = information @ x
        prior = 0.5 * float((np.log(ratio) ** 2).sum()) / _DRIFTS**2
        spread = float(0.5 * np.linalg.slogdet(inverse)[1] - np.log(sigma).sum())
        fit = 0.5 * float(both @ inverse @ both)
        return spread + fit - prior, np.asarray(inverse, dtype=np.float64)

    ratios = list(product(np.exp(_DRIFTS * np.linspace(-2, 1, 13)), repeat=2))
    best = max(map(np.array, ratios), key=lambda each: judged(each)[0])
    return best, judged(best)[1]


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
        """Rigid registrations of the track `other` to this one, at all lags.

        Returns the lags (L,) in steps of the grid, poses (L, 4, 4) of the other's frame in this
        one, and scores (L,): the number of joints, in which nearer joints count more.
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
