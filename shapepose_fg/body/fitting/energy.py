"""Energy of a body given joint targets; `body/kernels/bodies.py` linearises it row by row.

    E(Theta) = sum_i rho((x_i(Theta) - z_i)ᵀ M_i (x_i(Theta) - z_i))
               + |betas|² - 2 log p(theta) + constant

with M_i the information of target z_i, rho a robust kernel, and p the Gaussian pose prior: SMPLify
(Bogo et al. 2016) for 3D joints. There is no factor 1/2, so that the inverse of half its Hessian is
a covariance.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from shapepose_fg.body.fitting.fitter import BodyFit
from shapepose_fg.body.fitting.priors import NUM_ANGLES, PosePrior
from shapepose_fg.body.kernels.bodies import linearised
from shapepose_fg.body.kernels.rows import Linear, Priors, Rows, Work
from shapepose_fg.body.kernels.solving import known, solved
from shapepose_fg.body.model.body_model import BodyModel, BodyParameters
from shapepose_fg.body.model.rotation import exp_so3, log_so3
from shapepose_fg.core.arrays import Array, Index, Mask
from shapepose_fg.core.rows import Rows as FitRows

BATCH = 64
"""Number of rows whose Hessians fit into the cache, and that are fitted together."""
SETTLED = 1e6
"""Precision of a beta that is fixed by other rows of the same person."""
VISIBLE_M_PER_RAD = 1e-3
"""Speed of the fastest keypoint per rotation of a joint, m/rad, below which the joint is
unobservable."""


@dataclass(frozen=True)
class EnergyTargets(FitRows):
    """Joint targets in the form that the energy takes."""

    xyz: Array
    """(B, K, 3) metres, finite."""
    information: Array
    """(B, K, 3, 3) inverse covariances M_i, 1/m²."""


@dataclass(frozen=True)
class Held(FitRows):
    """Centres of the priors on shape and angles, and the precision of the shape."""

    betas: Array
    """(B, 10) centre of the shape prior."""
    stiffness: Array
    """(B,) precision of each beta."""
    angles: Array
    """(B, A) centre of the pose prior in the free angles, rad."""


def robust_weight(squared: Array, scale: float) -> Array:
    """Derivative of the Geman-McClure cost c² s / (c² + s), which is bounded by c²: the weight of a
    joint in iteratively reweighted least squares, 1 at its target.
    """
    return np.asarray((scale**2 / (scale**2 + squared)) ** 2)


@dataclass(frozen=True)
class Evaluated(FitRows):
    """Bodies with their energy and gradient, and the factored Hessian of the last linearisation."""

    free: Array
    """(B, P) free parameters."""
    energy: Array
    """(B,) energy, in squared standard deviations."""
    xyz: Array
    """(B, K, 3) keypoints, metres."""
    squared: Array
    """(B, K) squared Mahalanobis distance of each keypoint to its target."""
    gradient: Array
    """(B, P) half the gradient."""
    system: Array
    """(B, P + 1 + 3 N + 10, P) systems as in `body/kernels/solving.py`, Hessian and gradient
    reduced; N keypoints."""
    step: Array
    """(B, P) the Newton step."""
    left: Array
    """(B,) predicted decrease of the energy by the next step."""

    def move(self, where: Mask, free: Array, slope: Linear) -> None:
        """Move the rows `where` (B,) to `free` (B, P) with the gradient there; the factored Hessian
        is kept.
        """
        self.free[where] = free[where]
        for name in ("energy", "xyz", "squared", "gradient"):
            getattr(self, name)[where] = getattr(slope, name)[where]
        self.system[:, self.free.shape[1]] = self.gradient
        solved(self.system, np.full(len(self), -1.0), self.step, self.left)

    def covariances(self) -> tuple[Array, Array]:
        """Return the covariances of the systems' keypoints (B, N, 3, 3), m², and of the betas (B,
        10, 10).

        Laplace approximation. Reduces the rest of the systems in place.
        """
        B, M, P = self.system.shape
        covariance, shape = np.zeros((B, (M - P - 11) // 3, 3, 3)), np.zeros((B, 10, 10))
        known(self.system, covariance, shape)
        return covariance, shape


class BodyEnergy:
    """Evaluates the energy over the *free* parameters (P,) of a row: betas, root orientation,
    angles, translation.

    The angles are the axis-angles of joints that move some keypoint. There is no evidence on the
    others (hands): the prior's marginal over the free angles accounts for them exactly, and
    `complete` sets them to their conditional mean.
    """

    def __init__(self, model: BodyModel, prior: PosePrior):
        self.model = model
        visible = visible_joints(model, prior)
        self.angles = (visible[:, None] * 3 + np.arange(3)).ravel()
        """(A,) indices of the free angles among the 69."""
        hidden = np.setdiff1d(np.arange(NUM_ANGLES), self.angles)
        self.num_angles = len(self.angles)
        self.num_free = 10 + 3 + self.num_angles + 3
        gain = prior.regression(self.angles, hidden)
        place = np.zeros(NUM_ANGLES, dtype=np.intp)
        place[self.angles], place[hidden] = np.arange(self.num_angles), -1 - np.arange(len(hidden))
        self._hidden = hidden
        parts = (prior.mean[self.angles], prior.marginal_precision(self.angles), place, gain,
                 prior.mean[hidden] - gain @ prior.mean[self.angles])  # fmt: skip
        self.priors = Priors(*_contiguous(parts))
        """The pose prior of the free parameters."""
        column = np.full(24, -1)
        column[0], column[1 + visible] = 10, 13 + 3 * np.arange(len(visible))
        self._limbs = model.keypoint_points.limbs(column)

    def complete(self, free: Array) -> BodyParameters:
        """The bodies (B rows) for free parameters (B, P); unobservable joints are at their
        conditional mean.
        """
        angles, pose = free[:, 13:-3], np.zeros((len(free), NUM_ANGLES))
        pose[:, self.angles] = angles
        pose[:, self._hidden] = angles @ self.priors.gain.T + self.priors.at_zero
        return BodyParameters(free[:, :10], free[:, 10:13], pose.reshape(-1, 23, 3), free[:, -3:])

    def parameters(self, fit: BodyFit | BodyParameters, origin: Array) -> Array:
        """Free parameters (B, P) of fitted bodies relative to their origins (B, 3)."""
        angles = fit.body_pose.reshape(len(fit), -1)[:, self.angles]
        return np.concatenate((fit.betas, fit.global_orient, angles, fit.transl - origin), axis=1)

    def retract(self, free: Array, step: Array) -> Array:
        """Apply a step (B, P): the orientation is multiplied by exp(step) on the right, and the
        step is added to all other parameters.

        Angles are added as vectors, because the pose prior is exactly quadratic in them.
        """
        moved = free + step
        moved[:, 10:13] = log_so3(exp_so3(free[:, 10:13]) @ exp_so3(step[:, 10:13]))
        return moved

    def held_by_priors(self, count: int) -> Held:
        """`count` rows constrained only by the priors."""
        return Held(np.zeros((count, 10)), np.ones(count), np.tile(self.priors.mean, (count, 1)))

    def linearise(
        self, free: Array, targets: EnergyTargets, scale: Array | float, held: Held,
        keypoints: Index | None = None, *, slope_only: bool = False,
    ) -> Linear:  # fmt: skip
        """Linearise the energy at free parameters (B, P), with a scale of the robust kernel for all
        rows or each row (B,).

        Systems include the Jacobian of some `keypoints` (B, N); None: of all.
        """
        (B, P), K = free.shape, len(self.model.keypoint_names)
        keypoints = np.broadcast_to(np.arange(K), (B, K)) if keypoints is None else keypoints
        size = (0 if slope_only else B, P + 1 + 3 * keypoints.shape[1] + 10, P)
        linear = Linear(*map(np.empty, ((B,), (B, K, 3), (B, K), (B, P), size)))
        scales, work = _plain(np.broadcast_to(scale, (B,))), Work.of(self._limbs, P)
        keypoints = np.require(keypoints, np.intp, ["C", "W"])
        linearised(
            self._limbs,
            self.priors,
            _plain(free),
            _rows(targets, held),
            scales,
            keypoints,
            linear,
            work,
        )
        return linear

    def evaluate(
        self,
        free: Array,
        targets: EnergyTargets,
        scale: float,
        held: Held,
        keypoints: Index | None = None,
    ) -> Evaluated:
        """Bodies at free parameters (B, P) with energy and step; `keypoints` as in `linearise`."""
        linear = self.linearise(free, targets, scale, held, keypoints)
        step, left = np.empty(free.shape), np.empty(len(free))
        solved(linear.system, np.zeros(len(free)), step, left)
        return Evaluated(_plain(free).copy(), *linear, step, left)


def nothing(count: int) -> Index:
    """An empty selection of keypoints for `count` rows."""
    return np.zeros((count, 0), dtype=np.intp)


def _contiguous(parts: Sequence[Any]) -> Iterator[Any]:
    """Copies of arrays, C-contiguous, as kernels require."""
    return (np.array(part, order="C") for part in parts)


def _plain(array: Array) -> Array:
    """The array, C-contiguous, float64 and writable, as kernels require."""
    array = np.ascontiguousarray(array, dtype=np.float64)
    return array if array.flags.writeable else array.copy()


def _rows(targets: EnergyTargets, held: Held) -> Rows:
    """Targets and priors in the form that kernels take."""
    return Rows(
        *map(_plain, (targets.xyz, targets.information, held.betas, held.stiffness, held.angles))
    )


def visible_joints(model: BodyModel, prior: PosePrior) -> Index:
    """Indices of the joints below the root (of 23) whose rotation moves some keypoint, from the
    Jacobian.
    """
    poses, still = prior.sample(np.random.default_rng(0), 8), np.zeros((8, 3))
    _, jacobian = model.keypoints_with_jacobian(
        BodyParameters(np.zeros((8, 10)), still, poses, still)
    )
    speed = np.abs(jacobian[..., 13:-3]).reshape(*jacobian.shape[:3], 23, 3).max(axis=(0, 1, 2, 4))
    return np.flatnonzero(speed > VISIBLE_M_PER_RAD)
