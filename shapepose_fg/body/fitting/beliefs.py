"""What a fit is worth: joints of fitted bodies with covariances, with and without their own targets."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from shapepose_fg.body.fitting.energy import BodyEnergy, Evaluated, WhitenedTargets, robust_weight
from shapepose_fg.body.fitting.fitter import BodyFit, FitStatus
from shapepose_fg.body.fitting.leave_one_out import joint_posterior

Array = NDArray[np.float64]


def fill(
    fit: BodyFit,
    rows: NDArray[np.intp],
    energy: BodyEnergy,
    body: Evaluated,
    targets: WhitenedTargets,
    centre: Array,
    *,
    kernel_scale: float,
    model_sigma_m: float,
    unfinished: float,
    spread: Tensor | None = None,
) -> None:
    """Fill `fit`'s `rows` (R,) with the `body` of each and what is known about their joints (Laplace).

    `centre` (R, 3) is each row's origin. Rows whose energy a Newton step would lower by more than `unfinished`,
    or that are not finite, become NOT_CONVERGED. `spread` (K,) multiplies the variance of what the body says of
    joints without help of their own targets.
    """
    scale, xyz, here = torch.tensor(kernel_scale), body.xyz, body.here
    factor, _ = torch.linalg.cholesky_ex(here.hessian.double())
    right = torch.cat((body.jacobian.mT, here.gradient[..., None]), -1).double()
    half = torch.linalg.solve_triangular(factor, right, upper=False)
    left = half[..., -1].square().sum(-1)  # what a Newton step would still gain
    root = robust_weight(here.squared, scale).sqrt()[..., None, None] * targets.root
    posterior = joint_posterior(xyz.double(), half[..., :-1], (xyz - targets.xyz).double(), root.double())
    unseen = (targets.root == 0).all(-1).all(-1)[..., None, None]
    wider = torch.ones(1) if spread is None else spread.double()[:, None, None]
    covariance = torch.where(unseen, wider * posterior.covariance, posterior.covariance)
    information = targets.root.square().sum(dim=(-1, -2)).sum(-1) / 3
    residual_m = (here.squared.sum(-1) / information).sqrt()

    whole, done = energy.complete(body.free), (left < unfinished).numpy()  # NaN is not
    fit.status[rows[~done]] = FitStatus.NOT_CONVERGED
    rows, origin = rows[done], centre[done]
    fit.betas[rows] = _double(whole.betas)[done]
    fit.global_orient[rows] = _double(whole.global_orient)[done]
    fit.body_pose[rows] = _double(whole.body_pose)[done]
    fit.transl[rows] = _double(whole.transl)[done] + origin
    fit.joints[rows] = _double(xyz)[done] + origin[:, None]
    fit.covariance[rows] = _double(covariance)[done]
    fit.prior_xyz[rows] = _double(posterior.left_out_xyz)[done] + origin[:, None]
    model_error = model_sigma_m**2 * np.eye(3)
    fit.prior_covariance[rows] = _double(wider * posterior.left_out_covariance)[done] + model_error
    fit.residual_m[rows] = _double(residual_m)[done]


def _double(tensor: Tensor) -> Array:
    return tensor.double().numpy()
