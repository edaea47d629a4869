"""Spread of joints due to uncertain associations and exchanged limbs."""

from collections.abc import Sequence

import numpy as np

from factors import kernel_weight
from shapepose_fg.body.fitting.fitter import JointTargets
from shapepose_fg.core.arrays import Array, Index, Whole
from shapepose_fg.core.camera import Views
from shapepose_fg.core.joint_names import mirrored as mirror_of
from shapepose_fg.core.observations import Observations
from shapepose_fg.estimation.limbs import ARMS_AND_LEGS, on_both_sides
from shapepose_fg.estimation.linearisation import LEAST_PROBABILITY, ObservationConfig, ViewEvidence

CERTAIN = 0.99
"""Probability above which an observation counts as certainly the person's: four in five."""
FREE_M = 0.3
"""Standard deviation of a joint with a single, uncertain observation if that is wrong, metres: half
an arm."""

DOUBTED = 0.05
"""Median probability of swapped sides above which a row is not `Status.OK`: its 95 % regions would
be wrong."""
REACH_M = 0.6
"""Maximum distance between the ends of two people's limbs that may be exchanged, metres."""
FITS_M = 0.05
"""Standard deviation of the length of an exchanged limb from the body's, metres, as for correctly
solved limbs."""
_FEET = ("BigToe", "SmallToe", "Heel")


def limbs_to_exchange(joints: Sequence[str]) -> Index:
    """(L, 3) joints of a detector that may be exchanged with a limb, and the two ends of the limb.

    A foot goes with its ankle.
    """
    named = [(far, near, far) for near, far in ARMS_AND_LEGS] + [
        (foot, "Knee", "Ankle") for foot in _FEET
    ]
    return np.array(on_both_sides(named, joints), dtype=np.intp).reshape(-1, 3)


def exchange_spread(joints: Array, bodies: Array, frame: Whole, limbs: Index) -> Array:
    """(N, J, 3, 3) outer products of displacements from joints to others' that may be the person's
    own, m².

    For `joints` (N, J, 3) in the `frame` (N,). Two people's limbs may be exchanged over a long
    time, without uncertainty in any single frame. But both rarely have lengths as in the fitted
    `bodies` (N, J, 3); the displacement is weighted by this likelihood.
    """
    spread = np.zeros((*joints.shape, 3))
    far, near, end = limbs.T
    length = np.linalg.norm(bodies[:, end] - bodies[:, near], axis=-1)
    for number in np.unique(frame).tolist():
        rows = np.flatnonzero(frame == number)
        X = joints[rows]
        away = X[None, :, far] - X[:, None, far]  # (P, P, L, 3) from each person's to each other's
        across = np.linalg.norm(X[None, :, end] - X[:, None, near], axis=-1)
        misfit = across - length[rows][:, None]
        fits = np.exp(-0.5 * (misfit**2 + misfit.swapaxes(0, 1) ** 2) / FITS_M**2)
        fits = np.where(np.linalg.norm(away, axis=-1) < REACH_M, np.nan_to_num(fits), 0.0)
        spread[rows[:, None], far] = np.einsum(
            "pql,pqli,pqlk->plik", fits, *(np.nan_to_num(away),) * 2
        )
    return spread


def mirrored_spread(joints: Array, mirrored: Array, names: Sequence[str]) -> Array:
    """(N, J, 3, 3) outer products of displacements from joints (N, J, 3) to those of the other
    side, m².

    Weighted by the probability of exchanged sides, `mirrored` (N, J, V) of the row's observations.
    """
    other = [
        names.index(mirror_of(name)) if mirror_of(name) in names else n
        for n, name in enumerate(names)
    ]
    doubt = mirrored.max(axis=2, initial=0.0)
    doubt = np.maximum(doubt, doubt[:, other])
    away = np.nan_to_num(joints[:, other] - joints) * np.sqrt(doubt)[..., None]
    return away[..., None] * away[..., None, :]


def association_spread(
    observations: Observations,
    sigmas: Array,
    evidence: ViewEvidence,
    body: JointTargets,
    views: Views,
    config: ObservationConfig,
) -> Array:
    """(N, J, 3, 3) covariance between the estimates of joints with and without each uncertain
    observation, m².

    For an observation of probability p it is p (1 - p) d d^T, with d the displacement between the
    estimates with it, as if it were certain, and without it. Whole segments are right or wrong
    together, so that d is computed from one frame's views, `evidence` at the solved joints, and the
    `body`, without motion. Summed over the views.
    """
    joints = evidence.points
    spread = np.zeros((*joints.shape, 3))
    probability = np.maximum(observations.probability, LEAST_PROBABILITY)
    doubtful = evidence.inlier & (probability < CERTAIN)
    row, joint, view = np.nonzero(doubtful)
    if len(row) == 0:
        return spread
    _, _, jacobian = views.rows(row).project(joints[row, joint][:, None])
    jacobian, residual = (
        jacobian[np.arange(len(row)), 0, view],
        evidence.residual_px[row, joint, view],
    )
    sigma, p = sigmas[row, joint, view], probability[row, joint, view]
    weight = (
        kernel_weight(config.robust_kernel, np.linalg.norm(residual, axis=-1) / sigma) / sigma**2
    )
    information = weight[:, None, None] * jacobian.mT @ jacobian
    gradient = weight[:, None] * np.einsum("nik,ni->nk", jacobian, residual)
    pull = np.einsum("...ij,...j->...i", body.information, joints - np.nan_to_num(body.xyz))
    all_of_it = (evidence.gradient + pull)[row, joint] - gradient
    rest = (
        (evidence.information + body.information)[row, joint] - information + np.eye(3) / FREE_M**2
    )
    without = np.linalg.solve(rest, all_of_it[..., None])
    certain = np.linalg.solve(
        rest + information / p[:, None, None], (all_of_it + gradient / p[:, None])[..., None]
    )
    apart = (without - certain)[..., 0] * np.sqrt(p * (1 - p))[:, None]
    np.add.at(spread, (row, joint), apart[:, :, None] * apart[:, None])
    return spread
