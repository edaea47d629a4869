"""The motion model's numbers: how joints of recorded people move, how long errors of detector and body last."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment, nnls
from scipy.spatial.transform import Rotation

from shapepose_fg.body.fitting.fitter import BodyFitter
from shapepose_fg.body.model.body_model import BodyModel, BodyParameters
from shapepose_fg.core.camera import Rig, Views
from shapepose_fg.core.detections import Detections
from shapepose_fg.core.observations import Observations
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.estimation.body_step import joint_targets
from shapepose_fg.estimation.in_time import speeds
from shapepose_fg.estimation.linearisation import (
    ObservationConfig,
    linearise,
    observation_sigmas,
    symmetric_roots,
    triangulate,
)
from shapepose_fg.simulation import Scene, simulate
from shapepose_fg.simulation.mocap import Clip, Mocap
from shapepose_fg.simulation.shoulder import shoulder_rhythm
from shapepose_fg.simulation.training.split import Split, split_of

Array = NDArray[np.float64]

SECONDS = 10.0
"""Of each clip, its beginning: a long one is one person's habit."""
SPEEDS_M_S = (0.0, 0.1, 0.25, 0.5, 1.0, 1.5, 2.0, 3.0, 5.0)
"""Borders of the speeds between which densities are averaged."""
GAP_S = 0.4
"""How long a joint is hidden that motion is to bridge."""
LAGS_S = (0.1, 1.0)
"""Between these lags an exponential is fitted to the autocorrelation: what fades sooner is the white share."""
OWN_M = 0.12
"""A detection this near to the true joint is the joint's."""


@dataclass(frozen=True)
class LastingErrors:
    """What is left of an error after a while."""

    lags_s: Array
    """(L,) seconds."""
    autocorrelation: Array
    """(L,) of whitened errors."""
    white_share: float
    """Share of the variance that has faded after 0.1 s."""
    correlation_s: float
    """The rest fades as exp(-t / this)."""


def recorded_joints(path: Path, split: Split) -> Iterator[tuple[Array, float]]:
    """BODY_25's joints (T, 25, 3), metres, and frames a second, of one part's people on the mean body."""
    mocap, body = Mocap.load(path), BodyModel.default()
    for index, subject in enumerate(mocap.subjects):
        if split_of(subject) == split:
            clip = mocap.clip(index)
            yield _joints(clip.between(0, min(len(clip), int(SECONDS * clip.fps))), body), clip.fps


def densities(motions: Iterable[tuple[Array, float]]) -> dict[str, tuple[float, float, float]]:
    """Power spectral density of every joint's acceleration, m²/s³ per axis: still, per (m/s)², and across a gap.

    The second difference of positions has the variance 2/3 q dt³ under white noise on acceleration; its mean
    within classes of speed is fitted by q_still + q_speed v². The third number is for joints that are hidden for
    `GAP_S` between known states: the middle is then known to q h³ / 192. Left and right are taken together.
    """
    found = [_steps(joints, fps) for joints, fps in motions if len(joints) > GAP_S * fps + 3]
    density, speed, bridged = (np.concatenate([part[n] for part in found]) for n in range(3))
    result = {}
    for joint, name in enumerate(BODY_25.joints):
        both = [joint, BODY_25.mirror[joint]]
        still, rising = _by_speed(density[:, both].ravel(), speed[:, both].ravel())
        result[name] = (still, rising, float(bridged[:, both].mean()))
    return result


def _steps(joints: Array, fps: float) -> tuple[Array, Array, Array]:
    """Densities (N, J) of single steps, the speeds (N, J) there, and densities (N, J) that gaps would need."""
    dt, half = 1.0 / fps, round(GAP_S * fps / 2)
    times = np.asarray(np.arange(len(joints)) * dt, dtype=np.float64)
    density = 1.5 * np.mean(np.diff(joints, 2, axis=0) ** 2, axis=-1) / dt**3
    speed = speeds(joints, times)[1:]
    velocity = np.gradient(joints, dt, axis=0)
    first, middle, last = (slice(k * half, len(joints) - (2 - k) * half) for k in range(3))
    h = 2 * half * dt
    hermite = (joints[first] + joints[last]) / 2 + h / 8 * (velocity[first] - velocity[last])
    bridged = 192.0 * np.mean((joints[middle] - hermite) ** 2, axis=-1) / h**3
    count = min(len(density), len(bridged))
    return density[:count], speed[:count], bridged[:count]


def _by_speed(density: Array, speed: Array) -> tuple[float, float]:
    """Density at rest, and what each (m/s)² adds; classes of speed count alike, by their relative error."""
    which = np.digitize(speed, SPEEDS_M_S)
    classes = [which == n for n in range(1, len(SPEEDS_M_S)) if (which == n).sum() > 100]
    mean = np.array([density[here].mean() for here in classes])
    design = np.array([[1.0, np.mean(speed[here] ** 2)] for here in classes]) / mean[:, None]
    still, rising = nnls(design, np.ones(len(mean)))[0]
    return float(still), float(rising)


def detected(scene: Scene, seed: int) -> Observations:
    """What the simulated detector sees of a scene's people, each joint's own detections chosen by the truth."""
    recording = simulate(scene, seed=seed)
    parts = []
    for frame in range(len(scene)):
        truth = scene.truth_at(frame)
        candidate = _own(recording[frame], truth, scene.rig)
        part = Observations.of(candidate, recording[frame], np.full(truth.shape, np.nan))
        parts.append(part)
    return Observations.concatenate(parts)


def lasting_errors(
    observations: Observations, truth: Array, fps: float, rig: Rig, fitter: BodyFitter
) -> tuple[LastingErrors, LastingErrors]:
    """How long errors last of what views say of a joint, and of what the body says without the joint's own views.

    Rows are frames, then people, as `detected` gives them; `truth` (T, P, J, 3), metres.
    """
    config, views = ObservationConfig(), Views.of(rig)
    points = triangulate(observations, views, config)
    sigmas = observation_sigmas(observations, points, views, config, BODY_25.joints)
    evidence = linearise(observations, sigmas, points, views, config)
    body = fitter.fit(joint_targets(evidence, np.ones(len(observations), dtype=bool)))
    told = np.linalg.inv(np.where(body.ok[:, None, None, None], body.prior_covariance, np.eye(3)))
    seen = evidence.sigma_m < 0.1
    return (
        _lasting(evidence.target, evidence.information, seen, truth, fps),
        _lasting(body.prior_xyz, told, np.repeat(body.ok[:, None], seen.shape[1], axis=1), truth, fps),
    )


def _lasting(xyz: Array, information: Array, known: NDArray[np.bool_], truth: Array, fps: float) -> LastingErrors:
    """Autocorrelation of whitened errors, outliers cut at 4 sigma, and the exponential that fits it."""
    T, P, J, _ = truth.shape
    error = np.nan_to_num(xyz.reshape(truth.shape) - truth)
    roots = symmetric_roots(information.reshape(-1, 3, 3)).reshape(T, P, J, 3, 3)
    whitened = np.clip(np.einsum("...ij,...j->...i", roots, error), -4.0, 4.0)
    there = known.reshape(T, P, J)
    lags = np.unique(np.round(np.geomspace(1, min(fps, T - 2), 12)).astype(int))
    variance = np.mean(whitened[there] ** 2)
    pairs = [there[lag:] & there[:-lag] for lag in lags]
    found = np.array(
        [np.mean(whitened[lag:][both] * whitened[:-lag][both]) for lag, both in zip(lags, pairs, strict=True)]
    )
    correlation, seconds = found / variance, lags / fps
    fitted = (seconds >= LAGS_S[0]) & (seconds <= LAGS_S[1]) & (correlation > 0)
    slope, level = np.polyfit(seconds[fitted], np.log(correlation[fitted]), 1)
    return LastingErrors(seconds, correlation, float(1.0 - np.exp(level)), float(-1.0 / slope))


def _own(detections: Detections, truth: Array, rig: Rig) -> NDArray[np.intp]:
    """(P, J, V) the detection of each true joint (P, J, 3), one-to-one, -1 where none is within `OWN_M`."""
    xy, depth = rig.project(truth)
    chosen = np.full((*truth.shape[:2], len(rig)), -1, dtype=np.intp)
    for view in range(len(rig)):
        metres = depth[view] / rig.focal_px[view]
        for joint in range(truth.shape[1]):
            index = np.flatnonzero((detections.view == view) & (detections.joint == joint))
            apart = np.linalg.norm(xy[view, :, joint][:, None] - detections.xy[index], axis=-1)
            apart = np.nan_to_num(apart * metres[:, joint][:, None], nan=OWN_M)
            person, which = linear_sum_assignment(np.minimum(apart, OWN_M))
            near = apart[person, which] < OWN_M
            chosen[person[near], joint, view] = index[which[near]]
    return chosen


def _joints(clip: Clip, body: BodyModel) -> Array:
    """BODY_25's joints (T, 25, 3) of a clip on the mean body; what was not recorded is still."""
    rotations = shoulder_rhythm(clip.rotations)
    vectors = Rotation.from_matrix(rotations.reshape(-1, 3, 3)).as_rotvec().reshape(-1, 24, 3)
    unknown = [22, 23, *(() if clip.wrist_valid else (20, 21)), *(() if clip.toe_valid else (10, 11))]
    vectors[:, unknown] = 0.0
    parts = (np.zeros((len(clip), body.num_betas)), vectors[:, 0], vectors[:, 1:], clip.pelvis)
    with torch.no_grad():
        return (
            body.keypoints(BodyParameters(*(torch.from_numpy(part).to(body.dtype) for part in parts)))
            .double()
            .numpy()
        )
