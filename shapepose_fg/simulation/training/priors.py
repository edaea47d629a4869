"""The priors of bodies, learnt from recorded motions: which poses people take, and how fast they change."""

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from shapepose_fg.body.fitting.priors import NUM_ANGLES, NUM_MOVING, MotionPrior, PosePrior
from shapepose_fg.core.skeleton import SMPL_24
from shapepose_fg.simulation.mocap import Clip
from shapepose_fg.simulation.shoulder import COLLARS, SHOULDERS, shoulder_rhythm
from shapepose_fg.simulation.training.motions import MIRROR_JOINTS, Motions

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_NAMES = SMPL_24[1:]
_WRISTS, _HANDS, _TOES = (20, 21), (22, 23), (10, 11)
_ASSUMED_SIGMA_RAD = {"collar": (0.06, 0.12, 0.15), "hand": (0.2, 0.2, 0.2)}
"""Not recorded, so from anatomy, (x, y, z): the shoulder girdle follows the arm at about one degree in three and
hardly turns about its own axis; fingers are one block that is bent or spread by 0.2 rad."""
_STRAIGHT_RAD = 0.12
"""Play past straight of the joints in `_FLEXION`."""
_FLEXION = {"left_knee": (0, 1), "right_knee": (0, 1), "left_elbow": (1, -1), "right_elbow": (1, 1)}
"""SMPL's knee flexes about +x, the left elbow about -y, the right about +y."""
_SLACK_RAD = 0.08
"""Sigma added (in squares) to every angle: the play between a recording's skeleton and another body. The sources
agree with their own limb directions within 1 to 5 degrees (0.09 rad) and turn hinges about one axis exactly."""
_EVERY = 3
"""Of the frames that follow each other, each third is used: 10 a second."""
_ROUNDS = 40
"""Of expectation maximisation."""
_STEP_S = 1.0
"""Over which velocities are measured, seconds: what is not seen moves as far as people do in that time."""
_FLOORS = (1.0, 0.1)
"""Root densities of acceleration, rad/s^1.5, and velocity, rad/s^0.5, that no angle goes below: recorded knees and
toes are hinges, and collars were not recorded."""
_WRAPS_RAD = 2.6
"""Angle of a joint from which on its axis-angle may jump to the other side of the turn."""


def learn_pose_prior(motions: Motions, provenance: str) -> PosePrior:
    """The Gaussian of the poses and their mirror images, with play and limits; the same for the same input.

    Eight Gaussians are likelier on validation subjects by 3 nats a frame, but fits get caught in the wrong one:
    with 20 mm of noise and 30 % of the joints missing they are 0.9 mm worse on the joints that are seen (measured
    at 77ab725, which has the code).
    """
    motions = motions.rows(np.arange(0, len(motions), _EVERY))
    fitted = [joint for joint in range(len(_NAMES)) if not _NAMES[joint].endswith(tuple(_ASSUMED_SIGMA_RAD))]
    angles, partner = (
        _angles_of(part) for part in (fitted, [fitted.index(MIRROR_JOINTS[joint + 1] - 1) for joint in fitted])
    )
    rows, seen = (values[:, angles] for values in _recorded_angles(motions))
    rows = np.concatenate([rows, rows[:, partner] * np.tile([1.0, -1.0, -1.0], len(fitted))])
    seen = np.concatenate([seen, seen[:, partner]])
    weight = _EVERY * np.concatenate([motions.weight, motions.weight])
    mean, covariance = np.zeros(NUM_ANGLES), np.zeros((NUM_ANGLES, NUM_ANGLES))
    mean[angles], found = fit_gaussian(rows, seen, weight)
    covariance[angles[:, None], angles] = found + _SLACK_RAD**2 * np.eye(len(angles))
    for joint, name in enumerate(_NAMES):
        if joint not in fitted:
            place = _angles_of([joint])
            covariance[place, place] = np.square(_ASSUMED_SIGMA_RAD[name.split("_")[1]])
    lower, upper = np.full(NUM_ANGLES, -np.inf), np.full(NUM_ANGLES, np.inf)
    for name, (axis, direction) in _FLEXION.items():
        (lower if direction > 0 else upper)[3 * _NAMES.index(name) + axis] = -direction * _STRAIGHT_RAD
    return PosePrior(mean, covariance, lower, upper, provenance)


def fit_gaussian(rows: Array, seen: Mask, weight: Array) -> tuple[Array, Array]:
    """Mean (D,) and covariance (D, D) of the likeliest Gaussian of `rows` (N, D), of which some values are `seen`
    (N, D), weighing (N,): expectation maximisation.
    """
    D, total = rows.shape[1], np.maximum(weight @ seen, 1e-12)
    mean = (weight @ (rows * seen)) / total
    S = np.diag((weight @ (np.square(rows - mean) * seen)) / total + 1e-4)
    patterns, place = np.unique(seen, axis=0, return_inverse=True)
    alike = [(np.flatnonzero(place.ravel() == index), known) for index, known in enumerate(patterns)]
    for _ in range(_ROUNDS):
        first, second = np.zeros(D), np.zeros((D, D))
        for index, known in alike:
            gap, filled, part = ~known, rows[index], weight[index]
            if gap.any():
                gain = np.linalg.solve(S[np.ix_(known, known)], S[np.ix_(known, gap)]).T
                filled[:, gap] = mean[gap] + (filled[:, known] - mean[known]) @ gain.T
                second[np.ix_(gap, gap)] += part.sum() * (S[np.ix_(gap, gap)] - gain @ S[np.ix_(known, gap)])
            first += part @ filled
            second += (filled * part[:, None]).T @ filled
        mean = first / weight.sum()
        S = second / weight.sum() - np.outer(mean, mean) + 1e-6 * np.eye(D)
        S = (S + S.T) / 2
    return mean, S


def learn_motion_prior(clips: Iterable[Clip], weights: Iterable[float], provenance: str) -> MotionPrior:
    """Densities from `clips`, a frame of each of which counts for its weight; left and right are taken together.

    With h the time between frames, q h³ is the mean square of second differences and, over `_STEP_S`, r h that of
    first ones. Wrists and toes count where they were recorded; hands, which never are, move as wrists do.
    """
    total, count = np.zeros((2, NUM_MOVING)), np.zeros((2, NUM_MOVING))
    for clip, weight in zip(clips, weights, strict=True):
        h, step = 1 / clip.fps, round(_STEP_S * clip.fps)
        if len(clip) <= max(step, 2):
            continue
        rotations = shoulder_rhythm(clip.rotations)[:, 1:]
        angles = Rotation.from_matrix(rotations.reshape(-1, 3, 3)).as_rotvec().reshape(len(clip), 23, 3)
        known = np.ones((len(clip), NUM_MOVING), dtype=bool)
        joints = np.linalg.norm(angles, axis=-1) < _WRAPS_RAD
        for places, recorded in ((_HANDS, False), (_WRISTS, clip.wrist_valid), (_TOES, clip.toe_valid)):
            joints[:, np.array(places) - 1] &= recorded
        known[:, 3:-3] = np.repeat(joints, 3, axis=1)
        angles = angles.reshape(len(clip), -1)
        velocity, within = _change(clip, angles, 1), known[1:] & known[:-1]
        far, both = _change(clip, angles, step), known[step:] & known[:-step]
        parts = ((np.diff(velocity, axis=0), within[1:] & within[:-1], h**3), (far, both, step * h))
        for row, (change, used, scale) in enumerate(parts):
            total[row] += weight * np.where(used, np.square(change), 0.0).sum(axis=0) / scale
            count[row] += weight * used.sum(axis=0)
    mean = _symmetric(total / np.maximum(count, 1e-9))
    mean[:, 3:-3] = np.maximum(mean[:, 3:-3], np.square(_FLOORS)[:, None])
    return MotionPrior(*mean, provenance=provenance)


def _angles_of(joints: list[int]) -> NDArray[np.intp]:
    """Places of the joints' three angles each among the 69."""
    return (np.array(joints, dtype=np.intp)[:, None] * 3 + np.arange(3)).ravel()


def _recorded_angles(motions: Motions) -> tuple[Array, Mask]:
    """Angles (N, 69) as they were recorded, and which were: collars stay, the shoulder turns for both."""
    poses = motions.poses.astype(np.float64)
    for collar, shoulder in zip(COLLARS, SHOULDERS, strict=True):
        both = Rotation.from_rotvec(poses[:, collar]) * Rotation.from_rotvec(poses[:, shoulder])
        poses[:, collar], poses[:, shoulder] = 0.0, both.as_rotvec()
    return poses[:, 1:].reshape(len(motions), NUM_ANGLES), np.repeat(motions.observed[:, 1:], 3, axis=1)


def _change(clip: Clip, angles: Array, frames: int) -> Array:
    """(T - frames, 75) by how much everything changes over so many frames."""
    root = Rotation.from_matrix(clip.rotations[:, 0])
    turned = (root[frames:] * root[:-frames].inv()).as_rotvec()
    parts = (turned, angles[frames:] - angles[:-frames], clip.pelvis[frames:] - clip.pelvis[:-frames])
    return np.concatenate(parts, axis=1)


def _symmetric(density: Array) -> Array:
    """(2, 75) the same for left and right, for all axes of the root, and for hands as for wrists."""
    angles = density[:, 3:-3].reshape(2, 23, 3).copy()
    for hand, wrist in zip(_HANDS, _WRISTS, strict=True):
        angles[:, hand - 1] = angles[:, wrist - 1]
    angles = (angles + angles[:, np.array(MIRROR_JOINTS)[1:] - 1]) / 2
    root, place = (
        density[:, part].mean(axis=1, keepdims=True).repeat(3, axis=1) for part in (slice(3), slice(-3, None))
    )
    return np.concatenate([root, angles.reshape(2, -1), place], axis=1)
