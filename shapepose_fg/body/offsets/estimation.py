"""Estimates the offsets of a detector's joints from the body's, from well observed joints and
without ground truth.

A body is fitted to each row (a person in a frame). The part of the residuals that is constant over
the rows, in the frame of the bone, is the offset. Around the fits the energy is quadratic; summed
over the rows it is

    E(o, c) = sum_i min_dtheta |r - J dtheta - R o|²_W + |theta + dtheta - mean - c|²_P
              + |o|²_Q + |c|²_P

with r the residuals, R the bones' rotations, W the information of the joints, P the precision of
the prior of shape and pose. `c` is the recording's own mean shape and pose: without it, a room full
of tall standing people would be as many independent reasons to attribute their stature and straight
knees to the detector. As `c` is constrained by a single draw from the prior, it absorbs such
differences first. Anything that pose and shape can explain (a common translation, a rotated limb)
is not attributed to an offset; the prior Q keeps that part at zero.
"""

from dataclasses import dataclass

import numpy as np

from shapepose_fg.body.fitting.energy import BodyEnergy, EnergyTargets, robust_weight
from shapepose_fg.body.fitting.evidence import Evidence, weigh
from shapepose_fg.body.fitting.fitter import BodyConfig, BodyFit, JointTargets
from shapepose_fg.body.fitting.fitters import SmplFitter
from shapepose_fg.body.fitting.priors import PosePrior
from shapepose_fg.body.fitting.sizes import Sizes
from shapepose_fg.body.kernels.solving import reduce_systems
from shapepose_fg.body.model.body_model import BodyModel
from shapepose_fg.body.model.keypoint_offsets import LARGEST_M, RIDES_ON, KeypointOffsets
from shapepose_fg.core.arrays import Array, Real
from shapepose_fg.core.bounds import Metres, Settings
from shapepose_fg.core.skeleton import BODY_25

_CHUNK = 128
"""Number of rows per batch of linearisations."""
_POSE_WIDENING = 3.0
"""Factor on the standard deviations of the pose prior for this estimation. No prior has the exact
distribution of poses, and its error would look like an offset, the same in hundreds of rows."""
_MANY = 0.1
"""Share of rows far from an adult's size above which these are scaled to it: a room full of
children must not change the offsets. One or two rows in a hundred are mixtures of two people."""
_ROWS_PER_DRAW = 4.0
"""Number of rows that count as one independent row: a detector's errors are correlated, and people
reappear."""


@dataclass(frozen=True)
class OffsetPrior(Settings):
    """Prior on a detector's offsets."""

    sigma_m: Metres = 0.02
    """Prior standard deviation of the offsets, metres per axis; they are shrunk towards zero."""
    asymmetry_sigma_m: Metres = 0.003
    """Prior standard deviation of the asymmetry between left and right, metres per axis."""


def learn_offsets(
    targets: JointTargets,
    model: BodyModel,
    config: BodyConfig | None = None,
    prior: OffsetPrior | None = None,
) -> KeypointOffsets:
    """Estimate the offsets of the detector of `targets` (BODY_25), from rows with sufficient
    joints.

    Give only well observed joints, with zero information for all others. Existing offsets of
    `model` are replaced, not added to. If no row can be fitted, the offsets are zero with the
    prior's sigma.
    """
    prior = OffsetPrior() if prior is None else prior
    wide = PosePrior.default().widened(_POSE_WIDENING)
    config = BodyConfig() if config is None else config
    precision = np.linalg.inv(_prior_covariance(prior))
    model = model.with_keypoint_offsets(_made(np.zeros(75), precision, np.zeros(25)))
    fitter, sizes = SmplFitter(model, wide, config), Sizes.of(model)
    fit = fitter.fit(targets)
    far = sizes.far(fit.betas)
    if np.count_nonzero(far) > _MANY * len(far):
        targets = targets.larger(np.where(far, 1 / sizes.ratio(fit.betas), 1.0))
        fit = fitter.fit(targets)
    if not fit.ok.any():
        return model.keypoint_offsets
    # Because bodies are eliminated, not fixed, the first solution is nearly the last: further
    # rounds change the body's predictions by 0.2 mm.
    energy, evidence = BodyEnergy(model, wide), weigh(targets, config.model_sigma_m)
    return _solved(energy, fit, evidence, config.kernel_scale, precision)


def _solved(
    energy: BodyEnergy, fit: BodyFit, evidence: Evidence, kernel_scale: float, precision: Real
) -> KeypointOffsets:
    """One Newton step in offsets and mean; the mean starts at zero, at which the bodies were
    fitted.
    """
    rows, size = np.flatnonzero(fit.ok), 75 + energy.num_free
    hessian, gradient, prior = (
        np.zeros((size, size)),
        np.zeros(size),
        np.zeros((size - 75, size - 75)),
    )
    for start in range(0, len(rows), _CHUNK):
        part = rows[start : start + _CHUNK]
        centred = evidence.xyz[part] - evidence.centre[part, None]
        seen = EnergyTargets(centred, evidence.information[part])
        sums = _eliminate(
            energy, energy.parameters(fit.rows(part), evidence.centre[part]), seen, kernel_scale
        )
        hessian, gradient, prior = (
            hessian + sums[0],
            gradient + sums[1],
            prior + sums[2] / len(rows),
        )
    count = (np.abs(evidence.information[rows]).max(axis=(-1, -2)) > 0).sum(axis=0)
    current = energy.model.keypoint_offsets.xyz_m.ravel()
    hessian, gradient = hessian / _ROWS_PER_DRAW, gradient / _ROWS_PER_DRAW
    hessian[:75, :75] += precision
    gradient[:75] += precision @ current
    # The root's pose has neither prior nor influence on the sums: a small number keeps it at zero.
    hessian[75:, 75:] += prior + 1e-9 * np.eye(len(prior))
    return _made(current - np.linalg.solve(hessian, gradient)[:75], hessian, count)


def _made(xyz_m: Real, precision: Real, count: Real) -> KeypointOffsets:
    """Offsets (75,) with their standard deviations from the joint `precision` (75 +
    ..., 75 + ...).
    """
    variance = np.diagonal(np.linalg.inv(precision))[:75].reshape(25, 3).mean(axis=1)
    xyz = xyz_m.reshape(25, 3)
    length = np.linalg.norm(xyz, axis=1, keepdims=True)
    inside = xyz * np.minimum(1.0, 0.999 * LARGEST_M / np.maximum(length, 1e-9))
    return KeypointOffsets(inside, np.sqrt(variance), count.astype(np.intp), RIDES_ON)


def _eliminate(
    energy: BodyEnergy, free: Array, targets: EnergyTargets, kernel_scale: float
) -> tuple[Real, Real, Real]:
    """Sums over the rows `free` (R, P), with each row's body eliminated.

    Returns Hessian and gradient by (offsets 75, mean of the free parameters P), and the prior's
    Hessian (P, P).
    """
    (R, P), K = free.shape, len(BODY_25)
    linear = energy.linearise(free, targets, kernel_scale, energy.held_by_priors(R))
    hessians, jacobian = linear.hessian, linear.jacobian
    information = robust_weight(linear.squared, kernel_scale)[..., None, None] * targets.information
    by_offset = energy.model.bone_rotations(energy.complete(free))[:, RIDES_ON]  # (R, 25, 3, 3)
    force = information @ (targets.xyz - linear.xyz)[..., None]
    weighed = information @ jacobian.reshape(R, K, 3, P)
    prior_hessian = hessians - jacobian.swapaxes(1, 2) @ weighed.reshape(R, 3 * K, P)
    prior_gradient = linear.gradient + (jacobian.swapaxes(1, 2) @ force.reshape(R, -1, 1))[..., 0]
    crossed = (by_offset.swapaxes(-1, -2) @ weighed).reshape(R, 3 * K, P)
    both = np.concatenate(
        [crossed, -prior_hessian], axis=1
    )  # (R, 75 + P, P): second derivatives with the body
    by_own = -(by_offset.swapaxes(-1, -2) @ force).reshape(R, -1)
    gradient = np.concatenate([by_own, -prior_gradient], axis=1)
    system = np.concatenate([hessians, both, linear.gradient[:, None]], axis=1)
    reduce_systems(system)
    half = system[:, P:].swapaxes(0, 1).reshape(76 + P, -1)  # all rows in one matrix
    hessian = -(half[:-1] @ half[:-1].T)
    own = (by_offset.swapaxes(-1, -2) @ information @ by_offset).sum(axis=0)
    for joint in range(K):
        here_ = slice(3 * joint, 3 * joint + 3)
        hessian[here_, here_] += own[joint]
    hessian[75:, 75:] += prior_hessian.sum(axis=0)
    return hessian, gradient.sum(axis=0) - half[:-1] @ half[-1], prior_hessian.sum(axis=0)


def _prior_covariance(prior: OffsetPrior) -> Real:
    """(75, 75) prior covariance of the offsets: symmetric and antisymmetric part."""
    flip = np.diag([-1.0, 1.0, 1.0])
    mirrored = np.zeros((75, 75))  # maps offsets to the mirror joints
    for joint, mirror in enumerate(BODY_25.mirror):
        mirrored[3 * joint : 3 * joint + 3, 3 * mirror : 3 * mirror + 3] = flip
    even, odd = (np.eye(75) + mirrored) / 2, (np.eye(75) - mirrored) / 2
    # Projections onto the symmetric and the antisymmetric part.
    return prior.sigma_m**2 * even + prior.asymmetry_sigma_m**2 * odd
