"""A pose prior learnt from motions: a mixture over the recorded angles, and anatomy for what nobody recorded."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from shapepose_fg.body.fitting.pose_prior import NUM_ANGLES, PosePrior
from shapepose_fg.body.training.mixture import Mirror, Mixture, MixtureConfig, fit_mixture
from shapepose_fg.body.training.motions import Motions, mirror_joints
from shapepose_fg.core.skeleton import SMPL_24
from shapepose_fg.simulation.shoulder import COLLARS, SHOULDERS

Array = NDArray[np.float64]

_NAMES = SMPL_24[1:]
# Not recorded, so from anatomy, (x, y, z) in rad. The shoulder girdle follows the arm at about one degree in three
# (scapulohumeral rhythm): the clavicle rises up to 0.5 rad and moves to the front or back by 0.35, rarely. About
# its own axis it hardly turns. Fingers as one block: the hand is bent or spread by 0.2 rad.
_ASSUMED_SIGMA_RAD = {"collar": (0.06, 0.12, 0.15), "hand": (0.2, 0.2, 0.2)}
# Play past straight; SMPL's knee flexes about +x, the left elbow about -y, the right about +y.
_STRAIGHT_RAD = 0.12
_FLEXION = {"left_knee": (0, 1), "right_knee": (0, 1), "left_elbow": (1, -1), "right_elbow": (1, 1)}


@dataclass(frozen=True)
class PriorConfig:
    """Settings of `learn_pose_prior`."""

    mixture: MixtureConfig = MixtureConfig(components=1)  # noqa: RUF009 - frozen
    """How many components, how they are fitted. 8 are likelier on validation subjects by 3 nats a frame, but fits
    get caught in the wrong one: with 20 mm of noise and 30 % of the joints missing they are 0.9 mm worse on the
    joints that are seen, no better on those missing, and surer of them than they may be."""
    slack_rad: float = 0.08
    """Sigma added (in squares) to every angle: the play between a recording's skeleton and another body.

    The sources agree with their own limb directions within 1 to 5 degrees (0.09 rad) and turn hinges about one
    axis exactly. Held-out recordings share those hinges, so their likelihood alone would ask for no play."""
    every: int = 3
    """Of the frames that follow each other, every so manieth is used: 10 a second."""


def learn_pose_prior(motions: Motions, config: PriorConfig, provenance: str) -> PosePrior:
    """The mixture of the poses and their mirror images, with play and limits; the same for the same input."""
    motions = motions.rows(np.arange(0, len(motions), config.every))
    fitted = [joint for joint in range(len(_NAMES)) if not _NAMES[joint].endswith(tuple(_ASSUMED_SIGMA_RAD))]
    mixture = fit_mixture(
        _angles(motions)[:, angles_of(fitted)],
        np.repeat(motions.observed[:, 1:][:, fitted], 3, axis=1),
        motions.weight * config.every,
        _mirror(fitted),
        config.mixture,
        np.random.default_rng(0),
    )
    return _with_anatomy(mixture, angles_of(fitted), config.slack_rad, provenance)


def log_likelihood(prior: PosePrior, motions: Motions) -> Array:
    """Log density (N,) under the prior of what was recorded of each frame, nats."""
    mixture = Mixture(prior.weights, prior.means, prior.covariances)
    return mixture.log_density(_angles(motions), np.repeat(motions.observed[:, 1:], 3, axis=1))


def expected_angles(prior: PosePrior, poses: Array, asked: NDArray[np.intp]) -> Array:
    """Mean (N, M) of the angles `asked` (M,) given the other angles of `poses` (N, 69).

    Every component's regression counts by its share of the density of what is given.
    """
    given = np.setdiff1d(np.arange(NUM_ANGLES), asked)
    precisions, gains = prior.marginal_precisions(given), prior.regressions(given, asked)
    constant = np.log(prior.weights) + 0.5 * np.linalg.slogdet(precisions)[1]
    log_share, guesses = np.empty((len(poses), len(prior))), np.empty((len(prior), len(poses), len(asked)))
    for k, mean in enumerate(prior.means):
        error = poses[:, given] - mean[given]
        log_share[:, k] = constant[k] - 0.5 * ((error @ precisions[k]) * error).sum(axis=1)
        guesses[k] = mean[asked] + error @ gains[k].T
    share = np.exp(log_share - np.logaddexp.reduce(log_share, axis=1)[:, None])
    return np.einsum("nk,knm->nm", share, guesses)


def angles_of(joints: list[int]) -> NDArray[np.intp]:
    """Places of the joints' three angles each among the 69."""
    return (np.array(joints, dtype=np.intp)[:, None] * 3 + np.arange(3)).ravel()


def _angles(motions: Motions) -> Array:
    """Angles (N, 69) as they were recorded: collars stay as in the T-pose, the shoulder turns for both."""
    poses = motions.poses.astype(np.float64)
    for collar, shoulder in zip(COLLARS, SHOULDERS, strict=True):
        both = Rotation.from_rotvec(poses[:, collar]) * Rotation.from_rotvec(poses[:, shoulder])
        poses[:, collar], poses[:, shoulder] = 0.0, both.as_rotvec()
    return poses[:, 1:].reshape(len(motions), NUM_ANGLES)


def _mirror(joints: list[int]) -> Mirror:
    """What a mirror does to the angles of some joints, which must come with their partners."""
    partner = [joints.index(mirror_joints()[joint + 1] - 1) for joint in joints]
    return Mirror(angles_of(partner), np.tile([1.0, -1.0, -1.0], len(joints)))


def _with_anatomy(mixture: Mixture, angles: NDArray[np.intp], slack_rad: float, provenance: str) -> PosePrior:
    K = len(mixture.weights)
    means, covariances = np.zeros((K, NUM_ANGLES)), np.zeros((K, NUM_ANGLES, NUM_ANGLES))
    means[:, angles] = mixture.means
    covariances[:, angles[:, None], angles] = mixture.covariances + slack_rad**2 * np.eye(len(angles))
    for joint, name in enumerate(_NAMES):
        for part, sigma in _ASSUMED_SIGMA_RAD.items():
            if name.endswith(part):
                place = angles_of([joint])
                covariances[:, place, place] = np.square(sigma)
    lower, upper = np.full(NUM_ANGLES, -np.inf), np.full(NUM_ANGLES, np.inf)
    for name, (axis, direction) in _FLEXION.items():
        angle = 3 * _NAMES.index(name) + axis
        (lower if direction > 0 else upper)[angle] = -direction * _STRAIGHT_RAD
    return PosePrior(mixture.weights, means, covariances, lower, upper, provenance)
