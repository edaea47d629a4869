"""The energy of a body given joint targets, and its Gauss-Newton linearisation, batched over rows.

    E(Theta) = sum_i rho(|S_i (x_i(Theta) - z_i)|²) + |betas|² - 2 log p(theta) + constant

with S_iᵀ S_i the information of target z_i, rho a robust kernel, p the pose prior, a Gaussian: SMPLify
(Bogo et al. 2016) for 3D joints. There is no factor 1/2, so that the inverse of the Hessian below is a covariance.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from shapepose_fg.body.fitting.fitter import BodyFit, Rows
from shapepose_fg.body.fitting.priors import NUM_ANGLES, PosePrior
from shapepose_fg.body.model.body_model import BodyModel, BodyParameters, accumulate
from shapepose_fg.body.model.rotation import exp_so3, log_so3, right_jacobian

SETTLED = 1e6
"""Precision of a beta that other rows of the same person have settled."""
VISIBLE_M_PER_RAD = 1e-3
"""A joint whose rotation moves no keypoint faster than this is invisible: a radian would move 1 mm."""


@dataclass(frozen=True)
class WhitenedTargets(Rows):
    """Targets as the energy wants them: torch, one floating point type."""

    xyz: Tensor
    """(B, K, 3) metres, finite."""
    root: Tensor
    """(B, K, 3, 3) symmetric square root S_i of the information, 1/m."""


@dataclass(frozen=True)
class Held(Rows):
    """Around what shape and pose are held."""

    betas: Tensor
    """(B, 10) shape, or one for all (10,)."""
    stiffness: Tensor
    """(B, 1) precision of each beta, or one for all (1,)."""
    angles: Tensor | None = None
    """(B, A) free angles, held as tightly as the pose prior holds there; None: where it expects them."""

    @classmethod
    def by_priors(cls, rows: int | None = None) -> "Held":
        """By nothing else than the priors: one for all, or one for each of so many rows."""
        lead = () if rows is None else (rows,)
        return cls(torch.zeros(*lead, 10), torch.ones(*lead, 1))

    @staticmethod
    def concatenated(parts: "list[Held]") -> "Held":
        """The rows of all, in order; all hold the same."""
        columns = zip(*((part.betas, part.stiffness, part.angles) for part in parts), strict=True)
        return Held(*(None if column[0] is None else torch.cat(column) for column in columns))  # type: ignore[arg-type]

    def at_shape(self, betas: Tensor, settled: Tensor) -> "Held":
        """The same, but next to immovable at shapes `betas` (B, 10) in the rows that are `settled` (B,)."""
        rows = settled[:, None]
        return Held(torch.where(rows, betas, self.betas), torch.where(rows, SETTLED, self.stiffness), self.angles)


def robust_cost(squared: Tensor, scale: Tensor) -> Tensor:
    """Geman-McClure: c² s / (c² + s), which grows to c² and no further."""
    c2 = scale.square()
    return c2 * squared / (c2 + squared)


def robust_weight(squared: Tensor, scale: Tensor) -> Tensor:
    """Derivative of `robust_cost`: the weight of a joint in iterated least squares, 1 at its target."""
    c2 = scale.square()
    return (c2 / (c2 + squared)).square()


def _chosen(where: Tensor, new: Tensor, old: Tensor) -> Tensor:
    """The rows `where` (B,) of `new`, the others of `old`."""
    return torch.where(where.view(-1, *(1,) * (old.ndim - 1)), new, old)


@dataclass(frozen=True)
class Slope(Rows):
    """Bodies and the slope of their energy, at 40 % of the cost of a `Linearisation`."""

    xyz: Tensor
    """(B, K, 3) keypoints, metres."""
    squared: Tensor
    """(B, K) squared Mahalanobis distance of every joint to its target."""
    prior: Tensor
    """(B,) what betas and pose prior add to the energy."""
    gradient: Tensor
    """(B, P) half the gradient, in the tangent of the free parameters."""

    def energy(self, kernel_scale: Tensor) -> Tensor:
        """(B,) the energy with the kernel's scale (B, 1)."""
        return robust_cost(self.squared, kernel_scale).sum(-1) + self.prior


@dataclass(frozen=True)
class Linearisation(Slope):
    """Bodies, and gradient and Hessian of their energy."""

    hessian: Tensor
    """(B, P, P) half the Gauss-Newton Hessian, robust weights included."""

    def replaced(self, where: Tensor, other: Slope) -> "Linearisation":
        """The same, but with the rows `where` (B,) taken from another, if that is a slope all but the Hessian."""
        return replace(self, **{name: _chosen(where, new, vars(self)[name]) for name, new in vars(other).items()})


@dataclass(frozen=True)
class Evaluated:
    """Bodies, the Jacobian of their keypoints and the energy around them."""

    free: Tensor
    """(B, P) free parameters."""
    jacobian: Tensor
    """(B, 3 K, P) of the keypoints by the free parameters."""
    here: Linearisation
    """The energy."""
    factor: Tensor
    """(B, P, P) lower Cholesky factor of its Hessian, see `factored`."""

    @property
    def step(self) -> Tensor:
        """(B, P) the Newton step."""
        return -torch.cholesky_solve(self.here.gradient[..., None], self.factor).squeeze(-1)

    @property
    def left(self) -> Tensor:
        """(B,) by how much that step would lower the energy."""
        gradient = self.here.gradient[..., None]
        return torch.linalg.solve_triangular(self.factor, gradient, upper=False).square().sum((-1, -2))

    def moved(self, where: Tensor, free: Tensor, slope: Slope) -> "Evaluated":
        """Rows `where` (B,) at `free` (B, P) with the slope there; Jacobian and Hessian stay as they were."""
        return replace(self, free=_chosen(where, free, self.free), here=self.here.replaced(where, slope))

    def put(self, index: Tensor, other: "Evaluated") -> None:
        """Write the rows of `other` over the rows `index` (R,)."""
        own, new = ({**vars(body), **vars(body.here)} for body in (self, other))
        for name in own.keys() - {"here"}:
            own[name].index_copy_(0, index, new[name])


def factored(hessian: Tensor) -> Tensor:
    """Lower Cholesky factor of Hessians (B, P, P), with next to no information about the root added.

    Priors say nothing about rotation and place of the root. Where too few joints are left to determine them, as in
    some leave-one-out passes, they are known to a radian and a metre.
    """
    added = hessian.new_zeros(hessian.shape[-1])
    added[10:13] = added[-3:] = 1.0
    return torch.linalg.cholesky_ex(hessian + torch.diag(added))[0]


class BodyEnergy:
    """Evaluates the energy over the *free* parameters of a row, a vector (P,).

    It holds betas, root orientation, angles, translation. The angles are the axis-angles of joints that some
    keypoint can see. The others (hands) have no evidence: the prior's marginal over the visible angles accounts
    for them exactly, and `complete` fills them in with what it expects of them.
    """

    def __init__(self, model: BodyModel, prior: PosePrior):
        self.model, self.dtype = model, model.dtype
        visible = visible_joints(model, prior)
        self.angles = (visible[:, None] * 3 + np.arange(3)).ravel()
        """(A,) places of the visible angles among the 69."""
        hidden = np.setdiff1d(np.arange(NUM_ANGLES), self.angles)
        self.num_angles = len(self.angles)
        self.num_free = 10 + 3 + self.num_angles + 3
        gain = prior.regression(self.angles, hidden)
        self._mean, self.precision, self._gain, self._at_zero = (
            torch.from_numpy(np.ascontiguousarray(array)).to(self.dtype)
            for array in (prior.mean[self.angles], prior.marginal_precision(self.angles), gain,
                          prior.mean[hidden] - gain @ prior.mean[self.angles])
        )  # fmt: skip
        self._hidden, self._visible = torch.from_numpy(hidden), torch.from_numpy(self.angles)
        self._columns = torch.cat((torch.arange(13), 13 + self._visible, torch.arange(-3, 0) + 85))
        self._visible_joints = 1 + torch.from_numpy(visible)

    def complete(self, free: Tensor) -> BodyParameters:
        """The body (B rows) of free parameters (B, P); invisible joints are where the prior expects them."""
        angles = free[:, 13:-3]
        pose = free.new_empty(len(free), NUM_ANGLES)
        pose[:, self._visible] = angles
        pose[:, self._hidden] = angles @ self._gain.T + self._at_zero
        return BodyParameters(free[:, :10], free[:, 10:13], pose.unflatten(1, (23, 3)), free[:, -3:])

    def parameters(self, fit: BodyFit, origin: np.ndarray) -> Tensor:
        """Free parameters (B, P) of fitted bodies around their origins (B, 3), double precision."""
        angles = fit.body_pose.reshape(len(fit), -1)[:, self.angles]
        parts = (fit.betas, fit.global_orient, angles, fit.transl - origin)
        return torch.from_numpy(np.concatenate(parts, axis=1))

    def retract(self, free: Tensor, step: Tensor) -> Tensor:
        """Move by a step (B, P): the orientation by R exp(step), all else by addition.

        Angles are added to as vectors, for in them the pose prior's components are exactly quadratic.
        """
        moved = free + step
        moved[:, 10:13] = log_so3(exp_so3(free[:, 10:13]) @ exp_so3(step[:, 10:13]))
        return moved

    def keypoints_with_jacobian(self, free: Tensor) -> tuple[Tensor, Tensor]:
        """Keypoints (B, K, 3) and their Jacobian by the free parameters (B, 3 K, P)."""
        tangents = torch.eye(3, dtype=self.dtype).repeat(len(free), 24, 1, 1)
        tangents[:, self._visible_joints] = right_jacobian(free[:, 13:-3].unflatten(1, (-1, 3)))
        xyz, jacobian = self.model.keypoints_with_jacobian(self.complete(free), tangents)
        return xyz, jacobian.flatten(1, 2).index_select(2, self._columns)

    def evaluate(
        self, free: Tensor, targets: WhitenedTargets, kernel_scale: Tensor, held: Held | None = None
    ) -> Evaluated:
        """Bodies, and the energy around them, at free parameters (B, P); the kernel has the scale (B, 1).

        What is `held` stays around there instead of where the priors expect it.
        """
        jacobian, here = self._linearised(free, targets, kernel_scale, held)
        return Evaluated(free, jacobian, here, factored(here.hessian))

    def linearise(
        self, free: Tensor, targets: WhitenedTargets, kernel_scale: Tensor, held: Held | None = None
    ) -> Linearisation:
        """The energy alone, see `evaluate`."""
        return self._linearised(free, targets, kernel_scale, held)[1]

    def _linearised(
        self, free: Tensor, targets: WhitenedTargets, kernel_scale: Tensor, held: Held | None
    ) -> tuple[Tensor, Linearisation]:
        xyz, jacobian = self.keypoints_with_jacobian(free)
        residual = (targets.root @ (xyz - targets.xyz)[..., None]).squeeze(-1)
        squared = residual.square().sum(-1)
        weight = robust_weight(squared, kernel_scale).sqrt()[..., None]
        root = weight[..., None] * targets.root
        rows = (root @ jacobian.unflatten(1, xyz.shape[1:])).flatten(1, 2)
        gradient = (rows.mT @ (weight * residual).flatten(1)[..., None]).squeeze(-1)
        hessian = rows.mT @ rows
        prior, by_betas, by_angles, stiffness = self._pulls(free, held)
        gradient[:, :10] += by_betas
        gradient[:, 13:-3] += by_angles
        torch.diagonal(hessian, dim1=-2, dim2=-1)[:, :10] += stiffness
        hessian[:, 13:-3, 13:-3] += self.precision
        return jacobian, Linearisation(xyz, squared, prior, gradient, hessian)

    def slope(
        self, free: Tensor, targets: WhitenedTargets, kernel_scale: Tensor, held: Held | None = None
    ) -> Slope:
        """Keypoints, energy and gradient at free parameters (B, P), with the kernel's scale (B, 1)."""

        def pull(xyz: Tensor) -> tuple[Tensor, Tensor]:
            residual = (targets.root @ (xyz - targets.xyz)[..., None]).squeeze(-1)
            squared = residual.square().sum(-1)
            weight = robust_weight(squared, kernel_scale)[..., None]
            return squared, (targets.root @ (weight * residual)[..., None]).squeeze(-1)

        return self.slope_of(free, pull, held)

    def slope_of(
        self, free: Tensor, pull: Callable[[Tensor], tuple[Tensor, Tensor]], held: Held | None = None
    ) -> Slope:
        """The slope where something else than targets pulls the keypoints.

        `pull` gives, of keypoints (B, K, 3), squared distances (B, K) and half the gradient of its energy
        (B, K, 3).
        """
        body, points = self.complete(free), self.model.keypoint_points
        local = exp_so3(torch.cat((body.global_orient[:, None], body.body_pose), 1))
        rotations = accumulate(local)
        xyz, arms = points.positions_with_arms(rotations, body.betas, body.transl, points.feature(local))
        squared, forces = pull(xyz)
        by_column = points.pull_back(forces, arms, rotations, local)
        prior, by_betas, by_angles, _ = self._pulls(free, held)
        torques = by_column[:, 13 + self._visible].unflatten(1, (-1, 3))
        turned = (right_jacobian(free[:, 13:-3].unflatten(1, (-1, 3))).mT @ torques[..., None]).flatten(1)
        parts = (by_column[:, :10] + by_betas, by_column[:, 10:13], turned + by_angles, by_column[:, -3:])
        return Slope(xyz, squared, prior, torch.cat(parts, 1))

    def _pulls(self, free: Tensor, held: Held | None) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Of what holds the rows: energy (B,), half its gradient by betas (B, 10) and angles (B, A), stiffness."""
        held = Held.by_priors() if held is None else held
        away = free[:, :10] - held.betas
        error = free[:, 13:-3] - (self._mean if held.angles is None else held.angles)
        by_angles = error @ self.precision
        energy = (held.stiffness * away.square()).sum(-1) + (by_angles * error).sum(-1)
        return energy, held.stiffness * away, by_angles, held.stiffness


def visible_joints(model: BodyModel, prior: PosePrior) -> np.ndarray:
    """Which of the 23 joints below the root move some keypoint, by the model's own Jacobian (indices)."""
    poses = torch.from_numpy(prior.sample(np.random.default_rng(0), 8)).to(model.dtype)
    still = poses.new_zeros(8, 3)
    parameters = BodyParameters(poses.new_zeros(8, 10), still, poses, still)
    _, jacobian = model.keypoints_with_jacobian(parameters)
    speed = jacobian[..., 13:-3].unflatten(-1, (23, 3)).abs().amax(dim=(0, 1, 2, 4))
    return np.flatnonzero(speed.numpy() > VISIBLE_M_PER_RAD)
