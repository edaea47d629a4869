"""A pose prior learnt from motions: a Gaussian over the recorded angles, and anatomy for what was not recorded."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from shapepose_fg.body.fitting.pose_prior import NUM_ANGLES, PosePrior
from shapepose_fg.core.skeleton import SMPL_24
from shapepose_fg.simulation.shoulder import COLLARS, SHOULDERS
from shapepose_fg.simulation.training.motions import MIRROR_JOINTS, Motions

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_NAMES = SMPL_24[1:]
# Not recorded, so from anatomy, (x, y, z) in rad. The shoulder girdle follows the arm at about one degree in three
# (scapulohumeral rhythm): the clavicle rises up to 0.5 rad and moves to the front or back by 0.35, rarely. About
# its own axis it hardly turns. Fingers as one block: the hand is bent or spread by 0.2 rad.
_ASSUMED_SIGMA_RAD = {"collar": (0.06, 0.12, 0.15), "hand": (0.2, 0.2, 0.2)}
# Play past straight; SMPL's knee flexes about +x, the left elbow about -y, the right about +y.
_STRAIGHT_RAD = 0.12
_FLEXION = {"left_knee": (0, 1), "right_knee": (0, 1), "left_elbow": (1, -1), "right_elbow": (1, 1)}
_SLACK_RAD = 0.08
"""Sigma added (in squares) to every angle: the play between a recording's skeleton and another body. The sources
agree with their own limb directions within 1 to 5 degrees (0.09 rad) and turn hinges about one axis exactly.
Held-out recordings share those hinges, so their likelihood alone would ask for no play."""
_EVERY = 3
"""Of the frames that follow each other, each third is used: 10 a second."""
_ROUNDS = 40
"""Of expectation maximisation."""


@dataclass(frozen=True)
class Gaussian:
    """A Gaussian in D dimensions, learnt from rows with gaps."""

    mean: Array
    """(D,)."""
    covariance: Array
    """(D, D)."""

    @classmethod
    def fit(cls, rows: Array, seen: Mask, weight: Array) -> "Gaussian":
        """The likeliest one of `rows` (N, D), of which some values are `seen` (N, D), weighing (N,)."""
        total = np.maximum(weight @ seen, 1e-12)
        mean = (weight @ (rows * seen)) / total
        variance = (weight @ (np.square(rows - mean) * seen)) / total
        found, gaps = cls(mean, np.diag(variance + 1e-4)), _by_gaps(seen)
        for _ in range(_ROUNDS):
            found = found._refitted(rows, gaps, weight)
        return found

    def _refitted(self, rows: Array, gaps: "list[tuple[NDArray[np.intp], Mask]]", weight: Array) -> "Gaussian":
        """One round of expectation maximisation."""
        S, D = self.covariance, len(self.mean)
        first, second = np.zeros(D), np.zeros((D, D))
        for index, seen in gaps:
            gap, filled, part = ~seen, rows[index], weight[index]
            if gap.any():
                gain = np.linalg.solve(S[np.ix_(seen, seen)], S[np.ix_(seen, gap)]).T
                filled[:, gap] = self.mean[gap] + (filled[:, seen] - self.mean[seen]) @ gain.T
                second[np.ix_(gap, gap)] += part.sum() * (S[np.ix_(gap, gap)] - gain @ S[np.ix_(seen, gap)])
            first += part @ filled
            second += (filled * part[:, None]).T @ filled
        mean = first / weight.sum()
        covariance = second / weight.sum() - np.outer(mean, mean) + 1e-6 * np.eye(D)
        return Gaussian(mean, (covariance + covariance.T) / 2)

    def log_density(self, rows: Array, seen: Mask) -> Array:
        """Log density (N,) of what was `seen` (N, D) of `rows` (N, D), nats."""
        result = np.empty(len(rows))
        for index, known in _by_gaps(seen):
            S, error = self.covariance[np.ix_(known, known)], rows[np.ix_(index, known)] - self.mean[known]
            squared = (error * np.linalg.solve(S, error.T).T).sum(axis=1)
            result[index] = -0.5 * (squared + np.linalg.slogdet(2 * np.pi * S)[1])
        return result


def _by_gaps(seen: Mask) -> list[tuple[NDArray[np.intp], Mask]]:
    """Rows that have the same gaps, and which values they have."""
    patterns, place = np.unique(seen, axis=0, return_inverse=True)
    return [(np.flatnonzero(place.ravel() == index), known) for index, known in enumerate(patterns)]


def learn_pose_prior(motions: Motions, provenance: str) -> PosePrior:
    """The Gaussian of the poses and their mirror images, with play and limits; the same for the same input.

    Eight Gaussians are likelier on validation subjects by 3 nats a frame, but fits get caught in the wrong one:
    with 20 mm of noise and 30 % of the joints missing they are 0.9 mm worse on the joints that are seen, no better
    on those missing, and surer of them than they may be (measured at 77ab725, which has the code).
    """
    motions = motions.rows(np.arange(0, len(motions), _EVERY))
    fitted = [joint for joint in range(len(_NAMES)) if not _NAMES[joint].endswith(tuple(_ASSUMED_SIGMA_RAD))]
    rows, seen = recorded_angles(motions)
    rows, seen = rows[:, angles_of(fitted)], seen[:, angles_of(fitted)]
    partner = angles_of([fitted.index(MIRROR_JOINTS[joint + 1] - 1) for joint in fitted])
    rows = np.concatenate([rows, rows[:, partner] * np.tile([1.0, -1.0, -1.0], len(fitted))])
    seen = np.concatenate([seen, seen[:, partner]])
    found = Gaussian.fit(rows, seen, _EVERY * np.concatenate([motions.weight, motions.weight]))
    return _with_anatomy(found, angles_of(fitted), provenance)


def expected_angles(prior: PosePrior, poses: Array, asked: NDArray[np.intp]) -> Array:
    """Mean (N, M) of the angles `asked` (M,) given the other angles of `poses` (N, 69)."""
    given = np.setdiff1d(np.arange(NUM_ANGLES), asked)
    return prior.mean[asked] + (poses[:, given] - prior.mean[given]) @ prior.regression(given, asked).T


def angles_of(joints: list[int]) -> NDArray[np.intp]:
    """Places of the joints' three angles each among the 69."""
    return (np.array(joints, dtype=np.intp)[:, None] * 3 + np.arange(3)).ravel()


def recorded_angles(motions: Motions) -> tuple[Array, Mask]:
    """Angles (N, 69) as they were recorded, and which were: collars stay, the shoulder turns for both."""
    poses = motions.poses.astype(np.float64)
    for collar, shoulder in zip(COLLARS, SHOULDERS, strict=True):
        both = Rotation.from_rotvec(poses[:, collar]) * Rotation.from_rotvec(poses[:, shoulder])
        poses[:, collar], poses[:, shoulder] = 0.0, both.as_rotvec()
    return poses[:, 1:].reshape(len(motions), NUM_ANGLES), np.repeat(motions.observed[:, 1:], 3, axis=1)


def _with_anatomy(found: Gaussian, angles: NDArray[np.intp], provenance: str) -> PosePrior:
    mean, covariance = np.zeros(NUM_ANGLES), np.zeros((NUM_ANGLES, NUM_ANGLES))
    mean[angles] = found.mean
    covariance[angles[:, None], angles] = found.covariance + _SLACK_RAD**2 * np.eye(len(angles))
    for joint, name in enumerate(_NAMES):
        for part, sigma in _ASSUMED_SIGMA_RAD.items():
            if name.endswith(part):
                place = angles_of([joint])
                covariance[place, place] = np.square(sigma)
    lower, upper = np.full(NUM_ANGLES, -np.inf), np.full(NUM_ANGLES, np.inf)
    for name, (axis, direction) in _FLEXION.items():
        angle = 3 * _NAMES.index(name) + axis
        (lower if direction > 0 else upper)[angle] = -direction * _STRAIGHT_RAD
    return PosePrior(mean, covariance, lower, upper, provenance)
