"""Bundle adjustment: poses and lenses of all cameras, and joints of people, in one factor graph
(GTSAM).

The detection of a joint is a `ProjectionFactorPPPC` between pose, joint and lens, with a robust
kernel; its fourth variable, the lens's pose on the camera's body, is fixed at zero.
(`GeneralSFMFactor2` gives joints behind a camera zero error, and prints that.) Prior knowledge on
each camera is a prior on its pose and its lens. `settle` alternates this with the association of
people.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import gtsam
import gtsam_unstable
import numpy as np
from gtsam.symbol_shorthand import B, C, L, X

from factors.noise import diagonal, gaussian, isotropic_models, robust_kernel
from shapepose_fg.cameras import parameters
from shapepose_fg.cameras.people import LEAST_PEOPLE, Footage, People
from shapepose_fg.core.arrays import Array
from shapepose_fg.core.camera import Camera, Rig
from shapepose_fg.core.decompositions import nearest_rotation, rotation_angle
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.frame_times import FrameTimes
from shapepose_fg.estimation.frame_graph import UNDETERMINED_M
from shapepose_fg.estimation.trajectory_graph import correlated, optimised

LENS = [9, 10, 11, 12]
"""Parameters of a camera beside `parameters.PARAMETERS`: k1 k2 p1 p2."""
Q = parameters.Q + len(LENS)
_HELD = 1e-6
"""Standard deviation of fixed parameters, rad or m."""
_HELD_PX = 0.1
"""Standard deviation added to those of intrinsics and distortion, pixels; tighter constraints on
single parameters would slow the convergence of shared ones."""
_PRIOR_WIDTH = 4.0
"""Width of the robust kernel of a camera's prior, in standard deviations of six parameters; a
bumped camera must not pull the rig."""
_STILL_DEG = 0.03
"""Rotation per round below which cameras have converged, degrees."""
FILM = (
    "film people for a minute who walk through all views, near and far, not on one line, and move "
    "their arms"
)
"""Cure for motion that does not determine the cameras."""


@dataclass(frozen=True)
class Freedom:
    """Prior standard deviations of the cameras' parameters from the values in their file; 0:
    fixed.
    """

    turn_deg: float = 1.0
    """Rotation, degrees."""
    move_m: float = 0.02
    """Translation, metres."""
    focal: float = 0.0
    """Focal length, relative to its value."""
    centre_px: float = 0.0
    """Principal point, each axis, pixels."""
    lens: float = 0.0
    """Each of k1 k2 p1 p2, dimensionless."""

    @property
    def sigmas(self) -> Array:
        """(Q,) prior standard deviation of each parameter of a camera."""
        turn, move = np.radians(self.turn_deg) / np.sqrt(3), self.move_m / np.sqrt(3)
        return np.array(
            [turn] * 3 + [move] * 3 + [self.centre_px] * 2 + [self.focal] + [self.lens] * 4
        )


@dataclass(frozen=True)
class Adjusted:
    """Adjusted cameras with covariances."""

    rig: Rig
    """The adjusted cameras."""
    covariance: Array
    """(V, Q, V, Q) covariance of the cameras' parameters relative to the rig as a whole, which has
    the gauge of the given rig."""
    people: People
    """The people, with joints at their adjusted positions."""

    def sigma(self, part: list[int]) -> Array:
        """(V,) standard deviation of some of the parameters together: root of their summed
        variances.
        """
        variance = np.einsum("vqvq->vq", self.covariance)[:, part]
        return np.sqrt(np.maximum(variance, 0.0).sum(axis=1))


def adjust(
    given: Rig,
    start: Rig,
    people: People,
    freedom: Freedom | Sequence[Freedom],
    dilution: float,
    scale: float = 1.0,
    reference: int | None = None,
    scaled: bool = False,
) -> Adjusted:
    """Adjust cameras to `people`, starting at `start`, with the prior `given` and its `freedom`, of
    all cameras or of each.

    The camera `reference` keeps its pose; without one the mean pose of the rig is kept, and with
    `scaled` the covariance excludes the rig's size. `dilution` is the number of correlated errors
    of a detection, over joints and frames, that count as one: the priors are strengthened by it and
    the covariance scaled, so that the kernel keeps its width in pixels. `scale` multiplies the
    detections' standard deviations.
    """
    freedoms = [freedom] * len(start) if isinstance(freedom, Freedom) else list(freedom)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    person, joint, view = np.nonzero(people.seen)
    points = people.points[person, joint]
    key = np.unique(person * people.points.shape[1] + joint, return_inverse=True)[1]
    xy = people.xy[person, joint, view]
    models = isotropic_models(
        2, scale * people.sigma_px[person, joint, view], robust_kernel("cauchy")
    )
    seen = gtsam_unstable.ProjectionFactorPPPCCal3DS2
    joints = [L(each) for each in key.tolist()]
    poses, lenses = ([letter(each) for each in view.tolist()] for letter in (X, C))
    for each in zip(xy, models, poses, joints, lenses, strict=True):
        graph.push_back(seen(*each[:3], B(0), *each[3:], False, False))
    first = np.unique(key, return_index=True)[1]
    for place in first.tolist():
        values.insert(joints[place], points[place])
    weight = np.sqrt(dilution)
    values.insert(B(0), gtsam.Pose3())
    priors, kernel = gtsam.NonlinearFactorGraph(), robust_kernel("cauchy", _PRIOR_WIDTH * weight)
    for each, (camera, before) in enumerate(zip(start.cameras, given.cameras, strict=True)):
        values.insert(X(each), gtsam.Pose3(camera.wTc))
        values.insert(C(each), _lens(camera, camera))
        sigmas = freedoms[each].sigmas / weight
        pose = diagonal(
            np.full(6, _HELD) if each == reference else np.maximum(sigmas[:6], _HELD), kernel
        )
        priors.addPriorPose3(X(each), gtsam.Pose3(before.wTc), pose)
        noise = gaussian(_lens_covariance(before, sigmas))
        priors.add(gtsam.PriorFactorCal3DS2(C(each), _lens(before, camera), noise))
    priors.addPriorPose3(B(0), gtsam.Pose3(), diagonal(np.full(6, _HELD)))
    last = [B(0), *(letter(each) for letter in (X, C) for each in range(len(start)))]
    both = gtsam.NonlinearFactorGraph(graph)
    both.push_back(priors)
    found = optimised(both, values, [*dict.fromkeys(joints), *last])
    cameras = [
        _camera(camera, found, view, freedoms[view]) for view, camera in enumerate(start.cameras)
    ]
    rig = replace(start, cameras=tuple(cameras))
    moved = np.full_like(people.points, np.nan)
    moved[person[first], joint[first]] = [found.atPoint3(joints[place]) for place in first.tolist()]
    placed = replace(people, points=moved)
    # A joint behind a camera has no constraints, so that its position needs a prior.
    depth = np.moveaxis(rig.project(moved)[1], 0, 2)[person, joint, view]
    for each in dict.fromkeys(joints[place] for place in np.flatnonzero(depth <= 0).tolist()):
        graph.addPriorPoint3(
            each, found.atPoint3(each), gtsam.noiseModel.Isotropic.Sigma(3, UNDETERMINED_M)
        )
    information = (
        _information(graph, found, list(dict.fromkeys(joints)), view.tolist(), rig) / dilution
    )
    prior = np.stack([each.sigmas for each in freedoms])
    covariance = _covariance(information, rig, prior, reference, scaled)
    return Adjusted(rig, covariance, placed)


def misfit(people: People, rig: Rig) -> float:
    """Ratio of the median residual to its expectation under the standard deviations: ideally 1."""
    views = people.seen.sum(axis=-1, keepdims=True)
    seen, _ = rig.project(people.points)
    off_sigma = np.linalg.norm(np.moveaxis(seen, 0, 2) - people.xy, axis=-1) / people.sigma_px
    # A joint seen by n views uses up 3 of its 2 n residuals.
    left = np.sqrt(np.maximum(1 - 1.5 / np.maximum(views, 2), 0.25))
    return float(np.median((off_sigma / left)[people.seen]) / np.sqrt(2 * np.log(2)))


def _lens(camera: Camera, relative_to: Camera) -> gtsam.Cal3DS2:
    """The lens, for pixels that were undistorted with the distortion `relative_to`."""
    K, d = camera.K, (camera.distortion - relative_to.distortion)[:4]
    return gtsam.Cal3DS2(K[0, 0], K[1, 1], K[0, 1], K[0, 2], K[1, 2], *d)


def _lens_columns(camera: Camera) -> Array:
    """(9, Q - 6) derivatives of fx fy s u v k1 k2 p1 p2 by the parameters."""
    columns = np.zeros((9, Q - 6))
    columns[3, 0] = columns[4, 1] = 1.0
    columns[0, 2], columns[1, 2] = camera.K[0, 0], camera.K[1, 1]
    columns[5:, 3:] = np.eye(4)
    return columns


def _lens_covariance(camera: Camera, sigmas: Array) -> Array:
    columns, held = _lens_columns(camera), np.repeat(_HELD_PX, 9)
    held[5:] /= camera.K[0, 0]
    return columns @ np.diag(sigmas[6:] ** 2) @ columns.T + np.diag(held**2)


def _camera(camera: Camera, values: gtsam.Values, view: int, freedom: Freedom) -> Camera:
    """The adjusted camera."""
    wTc, lens = values.atPose3(X(view)).matrix(), values.atCal3DS2(C(view))
    distortion = camera.distortion.copy()
    if freedom.lens > 0:
        distortion[:4] += lens.vector()[5:]
    wTc[:3, :3] = nearest_rotation(wTc[:3, :3])
    return replace(camera, K=lens.K(), wTc=wTc, distortion=distortion)


def _information(
    graph: gtsam.NonlinearFactorGraph,
    values: gtsam.Values,
    joints: Sequence[int],
    views: Sequence[int],
    rig: Rig,
) -> Array:
    """(V Q, V Q) information about the cameras' parameters, joints eliminated."""
    first, last = gtsam.Ordering(joints), gtsam.Ordering()
    # Map GTSAM's parameters to ours; a camera without sightings is in no factor.
    seen, count = sorted(set(views)), len(rig)
    to = np.zeros((len(seen) * 15, count * Q))
    for n, view in enumerate(seen):
        last.push_back(X(view))
        last.push_back(C(view))
        at, columns = n * 15, view * Q
        to[at : at + 6, columns : columns + 6] = np.eye(6)
        to[at + 6 : at + 15, columns + 6 : columns + Q] = _lens_columns(rig.cameras[view])
    last.push_back(B(0))
    _, rest = graph.linearize(values).eliminatePartialMultifrontal(first)
    information = rest.hessian(last)[0][: len(to), : len(to)]  # the lens is fixed to the body
    return to.T @ information @ to


def _covariance(
    information: Array, rig: Rig, prior: Array, reference: int | None, scaled: bool
) -> Array:
    """(V, Q, V, Q) covariance of the cameras' parameters, with `prior` standard deviations (V, Q),
    without rigid motion, or scaling, of the whole rig.
    """
    V = len(rig)
    if reference is not None:
        prior[reference, :6] = 0.0
    used = prior.ravel() > 0
    weight = 1 / prior.ravel()[used] ** 2
    inner = np.linalg.inv(information[np.ix_(used, used)] + np.diag(weight))
    if reference is None:
        whole = np.zeros((V, Q, 7 if scaled else 6))
        whole[:, :6, :6] = [
            gtsam.Pose3(camera.wTc).inverse().AdjointMap() for camera in rig.cameras
        ]
        if scaled:
            from_centre = rig.centres - rig.centres.mean(axis=0)
            whole[:, 3:6, 6] = [
                camera.wTc[:3, :3].T @ each
                for camera, each in zip(rig.cameras, from_centre, strict=True)
            ]
        G = whole.reshape(V * Q, -1)[used]
        inner = inner - G @ np.linalg.solve(G.T @ (weight[:, None] * G), G.T)
    covariance = np.zeros((V * Q, V * Q))
    covariance[np.ix_(used, used)] = inner
    return covariance.reshape(V, Q, V, Q)


class Undetermined(InputError):
    """The people do not determine the cameras; `problems` has a sentence each with
    cause and cure.
    """

    def __init__(self, problems: tuple[str, ...], found: Any = None):
        super().__init__("; ".join(problems))
        self.problems, self.found = problems, found


class Steps:
    """Counts steps, for a progress bar: each call adds to the number of finished steps, and reports
    it with the total.
    """

    def __init__(self, progress: Callable[[int, int], None], total: int):
        self._progress, self._total, self._done = progress, total, 0

    def __call__(self, more: int = 1) -> None:
        self._done += more
        self._progress(self._done, self._total)


def settle(
    footage: Footage,
    now: Rig,
    rounds: int,
    given: Rig,
    times: FrameTimes,
    freedom: Freedom | Sequence[Freedom],
    advance: Callable[[int], None],
    reference: int | None = None,
    scale: Callable[[Array], float] | None = None,
) -> Adjusted:
    """Associate people and adjust cameras alternately, starting at `now`, until their poses have
    converged.

    The prior has the `freedom` about the cameras `given`. With `scale`, a function from the
    people's joints (P, J, 3) to metres per unit, only the lenses have a prior, and the rig is
    scaled. `advance` gets the number of rounds that are done. Raises Undetermined if too few people
    are seen.
    """
    adjusted: Adjusted | None = None
    for step in range(rounds):
        people = footage.people(now)
        if len(people) < LEAST_PEOPLE or not people.seen.any():
            raise Undetermined(
                (
                    f"only {len(people)} people are seen by two cameras at once, but at least "
                    f"{LEAST_PEOPLE} are needed; {FILM}",
                )
            )
        prior = given if scale is None else given.at_poses(now.wTc)
        spread, off = dilution(times.frame_s[np.unique(people.frame)]), misfit(people, now)
        adjusted = adjust(prior, now, people, freedom, spread, off, reference, scale is not None)
        if scale is not None:
            if not np.isfinite(factor := scale(adjusted.people.points)):
                raise Undetermined(
                    (f"no arms and legs are seen by two cameras, so the scale is unknown; {FILM}",)
                )
            adjusted = grown(adjusted, factor)
        before, now = now, adjusted.rig
        still = differences(before, now)[0].max() < _STILL_DEG
        advance(rounds - step if still else 1)
        if still:
            break
    assert adjusted is not None
    return adjusted


def halves(footage: Footage, fit: Callable[[Footage], Adjusted]) -> list[tuple[Rig, People]]:
    """Cameras that `fit` adjusts to the first and to the second half of the frames, each with the
    people of the other half.
    """
    both, found = np.array_split(np.unique(footage.sightings.frame), 2), []
    for used, left in (both, both[::-1]):
        rig = fit(footage.at(used)).rig
        found.append((rig, footage.at(left).people(rig)))
    return found


def dilution(time_s: Array) -> float:
    """Number of correlated errors of a detection, over time and joints, that count as one, for
    frames at `time_s` (T,).
    """
    return float(correlated(time_s[:, None] - time_s).sum() / len(time_s))


def scaled(rig: Rig, factor: float, fixed: Array | float = 0.0) -> Rig:
    """The rig scaled by `factor` about the `fixed` point (3,), by default the origin."""
    wTc = rig.wTc
    wTc[:, :3, 3] = fixed + factor * (wTc[:, :3, 3] - fixed)
    return rig.at_poses(wTc)


def grown(adjusted: Adjusted, factor: float) -> Adjusted:
    """Cameras, people and covariances scaled by `factor` about the origin."""
    unit = np.ones(adjusted.covariance.shape[1])
    unit[parameters.MOVE] = factor
    return replace(
        adjusted,
        rig=scaled(adjusted.rig, factor),
        covariance=adjusted.covariance * unit[:, None, None] * unit,
        people=replace(adjusted.people, points=factor * adjusted.people.points),
    )


def differences(one: Rig, other: Rig) -> tuple[Array, Array]:
    """(V,) degrees and metres between the cameras of two rigs, after alignment by a similarity."""
    near, far = (each.wTc[:, :3, :3] for each in (one, other))
    a, b = (each.centres - each.centres.mean(axis=0) for each in (one, other))
    size = max(float(np.linalg.norm(a) * np.linalg.norm(b)) / len(one), 1e-9)
    R = nearest_rotation(b.T @ a / size + np.einsum("vij,vkj->ik", far, near))
    grown = float(np.linalg.norm(b) / max(np.linalg.norm(a), 1e-9))
    return np.degrees(rotation_angle(R @ near @ far.mT)), np.linalg.norm(
        grown * a @ R.T - b, axis=1
    )
