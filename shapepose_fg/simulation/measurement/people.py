"""Whom a recording shows, with bodies, and where its other views put a joint: no annotation is read."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from shapepose_fg.body.fitting.baseline import LevenbergMarquardtFitter
from shapepose_fg.body.fitting.fitter import BodyFit
from shapepose_fg.body.model.body_model import BodyModel
from shapepose_fg.core.camera import Rig, Views
from shapepose_fg.core.detections import DetectionSequence
from shapepose_fg.core.observations import Observations
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.estimation.estimator import Estimator
from shapepose_fg.estimation.linearisation import linearise, observation_sigmas, triangulate
from shapepose_fg.io.calibration import read_rig
from shapepose_fg.io.detections import read_detections
from shapepose_fg.pipeline.pipeline import PipelineConfig, find_people
from shapepose_fg.proposal.assignment import match_best_first
from shapepose_fg.simulation.facing import seen_from_the_front
from shapepose_fg.simulation.motion import Motion
from shapepose_fg.simulation.scene import Scene
from shapepose_fg.simulation.visibility import Skin, Visibility, VisibilityConfig, see

OTHERS = 3
"""Other views that must agree on a joint before it is used to judge a view."""
BATCH = 64
"""Frames whose bodies are fitted together."""
TRACK_M = 0.4
"""A person's trunk moves less than this from one frame to the next."""
SMOOTH_FRAMES = 3.0
"""Sigma of the smoothing of a twin's motions."""
RAMP = np.array([(-0.9, -0.5), (-0.7, 0.0), (-0.7, 0.0), (-0.8, -0.1), (-0.8, -0.1)])
"""Cosines between which nose, eyes and ears come into sight: where misses fell from 90 to 10 % on Shelf."""
CONFIG = PipelineConfig()
"""The settings with which recordings are measured."""
FPS = 25.0
"""Of the Shelf recording."""


@dataclass(frozen=True)
class People:
    """Whom a recording shows: N rows, one per person and frame."""

    frame: NDArray[np.intp]
    """(N,)"""
    observations: Observations
    """What the views saw of them."""
    joints: NDArray[np.float64]
    """(N, J, 3) metres."""
    track: NDArray[np.intp]
    """(N,) who it is, over time."""
    fit: BodyFit
    """Their bodies, N rows."""
    visibility: Visibility
    """Of those bodies, (V, N, J)."""


def shelf_people(folder: Path) -> tuple[DetectionSequence, Rig, People]:
    """The Shelf recording and whom it shows; its annotation is not opened."""
    rig = read_rig(folder / "calibration.json")
    detections = read_detections(folder, rig)
    return detections, rig, find(detections, rig, CONFIG)


def find(detections: DetectionSequence, rig: Rig, config: PipelineConfig) -> People:
    """Everybody in the recording, with bodies, every frame by itself."""
    parts, frames, joints, fits = [], [], [], []
    settings = config.estimator
    fitter = LevenbergMarquardtFitter(config=config.body.plain)
    estimator = Estimator(rig, fitter, BODY_25.joints, settings)
    for start in range(0, len(detections), BATCH):
        numbers = range(start, min(start + BATCH, len(detections)))
        found = [find_people(detections[t], rig, BODY_25, config) for t in numbers]
        frame = np.repeat(np.array(numbers), [len(people) for people in found])
        observations = Observations.concatenate(found)
        alone = replace(observations, track=np.arange(len(observations)))
        estimates = estimator.estimate(alone)
        parts.append(observations)
        frames.append(frame)
        joints.append(estimates.joints)
        fits.append(estimates.fit)
    frame, xyz = np.concatenate(frames), np.concatenate(joints)
    fit = BodyFit(**{name: np.concatenate([getattr(part, name) for part in fits]) for name in vars(fits[0])})
    visibility = visible(rig, frame, fit)
    return People(frame, Observations.concatenate(parts), xyz, tracks(frame, xyz), fit, visibility)


def visible(rig: Rig, frame: NDArray[np.intp], fit: BodyFit) -> Visibility:
    """What each view sees of fitted bodies (N rows); who has no body is seen wholly and hides nobody."""
    body, config = BodyModel.default(), VisibilityConfig()
    rows = (len(rig), len(frame), len(BODY_25))
    seen, inside, hidden_by = np.ones(rows), np.ones(rows, dtype=bool), np.full(rows, -1)
    skin = Skin.of(body, config.cell_m)
    for number in np.unique(frame):
        of_frame = np.flatnonzero((frame == number) & fit.ok)
        motion = Motion(
            fit.betas[of_frame],
            *(getattr(fit, name)[of_frame][None] for name in ("global_orient", "body_pose", "transl")),
        )
        scene = Scene(rig, body, motion, 1.0)
        joints = scene.truth_at(0)
        found = see(rig, joints, scene.vertices_at(0, skin.vertices), skin, config)
        seen[:, of_frame] = seen_from_the_front(found.seen, joints, rig.centres, RAMP)
        inside[:, of_frame] = found.in_image
        who = found.hidden_by
        hidden_by[:, of_frame] = np.where(who >= 0, np.append(of_frame, -1)[np.maximum(who, -1)], who)
    return Visibility(seen, inside, hidden_by)


def tracks(frame: NDArray[np.intp], joints: NDArray[np.float64]) -> NDArray[np.intp]:
    """Link people of successive frames whose trunks are nearest: an identity (N,) that ends where it is lost."""
    trunk = joints[:, [1, 8, 9, 12]]
    known = np.isfinite(trunk.sum(axis=2))[..., None]
    with np.errstate(invalid="ignore"):
        trunk = np.where(known, trunk, 0.0).sum(axis=1) / known.sum(axis=1)
    track = np.full(len(frame), -1, dtype=np.intp)
    count = 0
    for number in np.unique(frame):
        now, before = np.flatnonzero(frame == number), np.flatnonzero(frame == number - 1)
        distance = np.linalg.norm(trunk[now][:, None] - trunk[before], axis=-1)
        a, b = np.nonzero(distance < TRACK_M)
        picked = match_best_first(a, b, -distance[a, b])
        track[now[a[picked]]] = track[before[b[picked]]]
        new = now[track[now] < 0]
        track[new] = count + np.arange(len(new))
        count += len(new)
    return track


def twin(people: People, rig: Rig, fps: float) -> Scene:
    """A scene in which the reconstructed people are the truth: the same poses before the same cameras.

    Who is followed for a second or more takes part; in frames without a body they are far out of every image.
    Motions are smoothed over time: bodies that were fitted frame by frame tremble, people do not.
    """
    names, counts = np.unique(people.track[people.fit.ok], return_counts=True)
    kept = names[counts >= fps]
    frames = int(people.frame.max()) + 1
    shapes = {"global_orient": (3,), "body_pose": (23, 3), "transl": (3,)}
    motion = {name: np.zeros((frames, len(kept), *shape)) for name, shape in shapes.items()}
    motion["transl"][:] = 1000.0 * rig.up_vector
    betas = np.zeros((len(kept), people.fit.betas.shape[1]))
    for index, track in enumerate(kept):
        rows = np.flatnonzero((people.track == track) & people.fit.ok)
        betas[index] = np.median(people.fit.betas[rows], axis=0)
        for run in np.split(rows, np.flatnonzero(np.diff(people.frame[rows]) > 1) + 1):
            for name, values in motion.items():
                smooth = _smooth_places if name == "transl" else _smooth_turns
                values[people.frame[run], index] = smooth(getattr(people.fit, name)[run])
    return Scene(rig, BodyModel.default(), Motion(betas, **motion), fps)


def _smooth_places(places: NDArray) -> NDArray:
    return gaussian_filter1d(places, SMOOTH_FRAMES, axis=0, mode="nearest")


def _smooth_turns(turns: NDArray) -> NDArray:
    """Rotation vectors (T, ..., 3), smoothed as matrices and made rotations again."""
    matrices = Rotation.from_rotvec(turns.reshape(-1, 3)).as_matrix().reshape(*turns.shape, 3)
    U, _, Vt = np.linalg.svd(gaussian_filter1d(matrices, SMOOTH_FRAMES, axis=0, mode="nearest"))
    return Rotation.from_matrix((U @ Vt).reshape(-1, 3, 3)).as_rotvec().reshape(turns.shape)


def left_out(people: People, rig: Rig, view: int, config: PipelineConfig) -> tuple[NDArray, NDArray, NDArray]:
    """Where the other views put each joint in `view`: pixels (N, J, 2), sigma (N, J) m, whether known (N, J)."""
    confidence = people.observations.confidence.copy()
    confidence[..., view] = 0.0
    others = Observations(people.observations.xy, confidence, people.joints)
    views = Views.of(rig)
    sigmas = observation_sigmas(others, people.joints, views, config.observations, BODY_25.joints)
    points = triangulate(others, views, config.observations)
    evidence = linearise(others, sigmas, points, views, config.observations)
    for _ in range(4):
        evidence = linearise(others, sigmas, points, views, config.observations)
        points = evidence.target
    known = evidence.inlier.sum(axis=-1) >= OTHERS
    values, vectors = np.linalg.eigh(evidence.information)
    variance = 1.0 / np.maximum(values, 1e-6)
    # Across the ray of the view, the mean of the two axes: the trace less the part along the ray.
    ray = points - rig.centres[view]
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    along = np.einsum("...ji,...j->...i", vectors, np.nan_to_num(ray)) ** 2
    spread_m = np.sqrt((variance.sum(axis=-1) - (variance * along).sum(axis=-1)) / 2)
    known &= spread_m < 0.03
    xy, depth = rig.project(points)
    return xy[view], np.where(known, spread_m, np.nan), known & (depth[view] > 0.5)
