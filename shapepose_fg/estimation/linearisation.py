"""What the views saw of each person, and what that says about each joint: gates, weights, information."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from factors import KernelName, in_front, kernel_weight, sigma_px
from shapepose_fg.camera import Rig
from shapepose_fg.observations import Observations


@dataclass(frozen=True)
class ObservationConfig:
    """How far a 2D observation is trusted."""

    sigma_m: float = 0.013
    """How far a detection of confidence 1 is from the joint, one sigma per axis, as a length at the joint's
    depth: a person's image shrinks with distance, and so does the detector's error. Measured on real detections
    without any annotation, each view against where the others see the joint (docs/evaluation.md)."""
    confidence_power: float = 2.0
    """w_ij of Eq. 1 is the confidence to this power. The paper's weight is the confidence itself; measured, sigma
    falls faster than its square root, nearly as 1 / confidence."""
    floor_px: float = 1.0
    """What the detector's grid costs at any size."""
    rho_2d_m: float = 0.15
    """rho_2D of Eq. 2, as a length at the joint's depth: an observation farther from the projected joint is
    discarded. Half the distance between a person's own shoulders or hips."""
    min_depth_m: float = 0.2
    """An observation counts only if the joint is at least this far in front of the camera."""
    kernel: KernelName | None = "cauchy"
    """Robust kernel of the projection factors."""

    def __post_init__(self) -> None:
        for name in ("sigma_m", "confidence_power", "rho_2d_m", "min_depth_m"):
            if getattr(self, name) <= 0:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")
        if self.floor_px < 0:
            raise ValueError(f"floor_px must not be negative, got {self.floor_px}")


@dataclass(frozen=True)
class Evidence:
    """What the observations say of the joints when these are at `points`."""

    points: NDArray[np.float64]
    """(P, J, 3) the joints, metres in the world; NaN where not known."""
    inlier: NDArray[np.bool_]
    """(P, J, V) delta_ij of Eq. 2: seen, in front of the camera and within rho_2D of the projection."""
    residual_px: NDArray[np.float64]
    """(P, J, V, 2) projection minus observation; NaN where unseen or unknown."""
    information: NDArray[np.float64]
    """(P, J, 3, 3) J^T W J over the inliers, robust weights included, 1/m²; zero where there is none."""
    gradient: NDArray[np.float64]
    """(P, J, 3) J^T W r over the inliers, 1/m."""

    @cached_property
    def target(self) -> NDArray[np.float64]:
        """(P, J, 3) where the observations alone would put each joint: one Gauss-Newton step from `points`.

        A joint that one view saw stays at its depth and moves onto the ray. NaN where `points` is.
        """
        return self.points - np.einsum("...ij,...j->...i", _pseudo_inverse(self.information), self.gradient)


def observation_sigmas(
    observations: Observations, points: NDArray[np.float64], rig: Rig, config: ObservationConfig
) -> NDArray[np.float64]:
    """Sigma (P, J, V) in pixels of every observation, for joints near `points` (P, J, 3); 0 where unseen.

    A joint whose place is not known takes the mean depth of the person's known ones.
    """
    _, depth = rig.project(points)
    depth = np.moveaxis(depth, 0, -1)
    usable = depth >= config.min_depth_m
    mean = np.where(usable, depth, 0.0).sum(axis=1) / np.maximum(usable.sum(axis=1), 1)
    depth = np.where(usable, depth, np.maximum(mean, config.min_depth_m)[:, None, :])
    seen = observations.seen
    sigmas = np.zeros(observations.confidence.shape)
    focal = np.broadcast_to(rig.focal_px, sigmas.shape)
    sigmas[seen] = sigma_px(
        observations.confidence[seen] ** config.confidence_power,
        depth[seen],
        focal[seen],
        sigma_m=config.sigma_m,
        floor_px=config.floor_px,
    )
    return sigmas


def weigh(
    observations: Observations,
    sigmas: NDArray[np.float64],
    points: NDArray[np.float64],
    rig: Rig,
    config: ObservationConfig,
) -> Evidence:
    """Decide the gates (Eq. 2) at `points` (P, J, 3) and sum up what the inliers say of each joint.

    `sigmas` (P, J, V) in pixels come from `observation_sigmas`.
    """
    points_camera = np.einsum("vij,pqj->pqvi", rig.cTw[:, :, :3], points) + rig.cTw[:, :, 3]
    depth = points_camera[..., 2]
    ahead = in_front(depth, config.min_depth_m)
    inverse_depth = 1.0 / np.where(ahead, depth, 1.0)
    pinhole = np.zeros((*depth.shape, 2, 3))
    pinhole[..., 0, 0] = pinhole[..., 1, 1] = inverse_depth
    pinhole[..., :2, 2] = -points_camera[..., :2] * inverse_depth[..., None] ** 2
    jacobian = rig.K[:, :2, :2] @ pinhole @ rig.cTw[:, :, :3]
    normalised = points_camera[..., :2] * inverse_depth[..., None]
    projected = np.einsum("vij,pqvj->pqvi", rig.K[:, :2, :2], normalised) + rig.K[:, :2, 2]
    usable = observations.seen & ahead
    residual = np.where(usable[..., None], projected - observations.xy, np.nan)
    distance = np.linalg.norm(residual, axis=-1)
    inlier = usable & (np.nan_to_num(distance, nan=np.inf) < config.rho_2d_m * rig.focal_px * inverse_depth)
    whitened = np.where(inlier, distance / np.where(inlier, sigmas, 1.0), 0.0)
    weight = kernel_weight(config.kernel, whitened) * inlier / np.where(inlier, sigmas, 1.0) ** 2
    jacobian = np.where(inlier[..., None, None], jacobian, 0.0)
    weighted = jacobian * weight[..., None, None]
    information = np.einsum("pqvki,pqvkj->pqij", weighted, jacobian)
    gradient = np.einsum("pqvki,pqvk->pqi", weighted, np.where(inlier[..., None], residual, 0.0))
    return Evidence(points, inlier, residual, information, gradient)


def mean_confidence(observations: Observations, inlier: NDArray[np.bool_]) -> NDArray[np.float64]:
    """w_i of Eq. 4: (P, J) mean confidence of each joint over all views.

    A view that did not see the joint counts 0, and so does one whose observation the gate discards: where the
    views contradict each other the joint is doubtful, however sure each of them is.
    """
    return np.where(inlier, observations.confidence, 0.0).mean(axis=-1)


def triangulate(
    observations: Observations,
    rig: Rig,
    sigmas: NDArray[np.float64],
    config: ObservationConfig,
    steps: int = 3,
) -> NDArray[np.float64]:
    """X_0 made complete: joints that at least two views saw but stage I did not place, (P, J, 3) metres.

    Linear triangulation, iterated with robust weights; joints that stage I placed keep their place, and what
    fewer than two views saw, or views that disagree, stays NaN.
    """
    missing = np.isnan(observations.initial).any(axis=-1) & (observations.seen.sum(axis=-1) >= 2)
    person, joint = np.nonzero(missing)
    if len(person) == 0:
        return observations.initial
    xy, seen = observations.xy[person, joint], observations.seen[person, joint]
    K_inverse = np.linalg.inv(rig.K)
    normalised = np.einsum("vij,mvj->mvi", K_inverse[:, :2, :2], xy) + K_inverse[:, :2, 2]
    rows = normalised[..., None] * rig.cTw[:, 2:3, :] - rig.cTw[:, :2, :]
    weight = seen * observations.confidence[person, joint]
    points = np.full((len(person), 3), np.nan)
    for _ in range(steps):
        A = np.einsum("mv,mvki,mvkj->mij", weight, rows, rows)
        damping = 1e-9 * np.trace(A[:, :3, :3], axis1=1, axis2=2)[:, None, None] * np.eye(3)
        points = np.linalg.solve(A[:, :3, :3] + damping, -A[:, :3, 3:])[..., 0]
        camera = np.einsum("vij,mj->mvi", rig.cTw[:, :, :3], points) + rig.cTw[:, :, 3]
        error_m = np.linalg.norm(camera[..., :2] - normalised * camera[..., 2:], axis=-1)
        weight = seen * observations.confidence[person, joint] / (1.0 + (error_m / (2.0 * config.sigma_m)) ** 2)
        weight /= np.maximum(camera[..., 2], config.min_depth_m) ** 2
    agrees = (seen & (error_m < config.rho_2d_m) & (camera[..., 2] > config.min_depth_m)).sum(axis=1) >= 2
    complete = observations.initial.copy()
    complete[person[agrees], joint[agrees]] = points[agrees]
    return complete


def _pseudo_inverse(information: NDArray[np.float64]) -> NDArray[np.float64]:
    """Pseudo-inverse (..., 3, 3) of symmetric matrices, directions below 1e-6 of the strongest left out."""
    values, vectors = np.linalg.eigh(information)
    certain = values > 1e-6 * np.maximum(values[..., -1:], 1e-12)
    inverse = np.where(certain, 1.0 / np.where(certain, values, 1.0), 0.0)
    return np.einsum("...ik,...k,...jk->...ij", vectors, inverse, vectors)
