"""What the views saw of each person, and what that says of each joint: gates, weights, information."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Literal

import numpy as np
from annotated_types import Interval

from factors import DEFAULT_WIDTH_SIGMA, KernelName, kernel_weight
from shapepose_fg.body.fitting.fitter import JointTargets
from shapepose_fg.core.arrays import Array, Mask
from shapepose_fg.core.bounds import Factor, Metres, MetresOrNone, Settings, Share
from shapepose_fg.core.camera import Views
from shapepose_fg.core.observations import Observations
from shapepose_fg.core.pieces import ROBUST
from shapepose_fg.estimation.kernels import complete, look, ready

MIN_DEPTH_M = 0.2
"""An observation counts only if the joint is at least this far in front of the camera."""
LEAST_PROBABILITY = 0.01
"""An observation that is less probably the person's counts as if it were this."""
_DAMPING = 1e-7
"""Share of the information of the joint that is added in all directions: a ray's length stays as it is."""
_DEPTH_M = 8.0
"""Median depth of joints before the cameras of the `tune` sequences (7 to 10 m), metres: where lengths become
pixels in the paper's setting."""


@dataclass(frozen=True)
class ObservationConfig(Settings):
    """How far a 2D observation is trusted."""

    sigma_m: Metres = 0.0105
    """How far a detection of confidence 1 is from the joint, one sigma per axis, as a length at the joint's
    depth: a person's image shrinks with distance, and so does the detector's error."""
    confidence_power: Annotated[float, Interval(gt=0, le=100)] = 5.0
    """p of w_ij, the weight in Eq. 1 of an observation of confidence c: w_ij = (c^p + w_0) / (1 + w_0). The
    paper's weight is the confidence itself. Measured, sigma at 0.95 is a third of what it is under 0.4."""
    least_weight: Share = 0.077
    """w_0 in it: what the least confident observation weighs."""
    by_joint: bool = True
    """Whether sigma differs from joint to joint (`JOINT_SCATTER`): a detector knows an eye better than a hip."""
    floor_rad: Share = 0.001
    """What the detector's grid costs at any size: an angle, one pixel where the focal length is 1,000. A detector
    scales a picture to its own size, so that it is no number of the picture's pixels."""
    rho_2d_m: Factor = 0.15
    """rho_2D of Eq. 2, as a length at the joint's depth: an observation farther from the projected joint is
    discarded. Half the distance between a person's own shoulders or hips."""
    fixed_depth_m: MetresOrNone = 0.0
    """Positive: `sigma_m` and `rho_2d_m` are lengths at this depth, wherever the joint is, so that d_2D is in
    pixels, as in the paper. 0: at the joint's own depth."""
    kernel: KernelName | Literal["none"] = "cauchy"
    """Robust kernel of the projection factors. The paper has none."""

    @classmethod
    def paper(cls) -> "ObservationConfig":
        """As written in Eqs. 1 and 2: squared pixels times the confidence, of all that lies within rho_2D.

        A detection has the measured sigma at a confidence of 0.7: 2 cm.
        """
        return cls(
            sigma_m=0.02,
            confidence_power=1.0,
            least_weight=0.0,
            by_joint=False,
            floor_rad=0.0,
            fixed_depth_m=_DEPTH_M,
            kernel="none",
        )

    def weight(self, confidence: Array) -> Array:
        """w_ij of Eq. 1 for observations of this confidence."""
        return (confidence**self.confidence_power + self.least_weight) / (1.0 + self.least_weight)

    @property
    def robust_kernel(self) -> KernelName | None:
        """The kernel's name, None for plain least squares."""
        return None if self.kernel == "none" else self.kernel

    def scatter(self, joints: Sequence[str]) -> Array:
        """(J,) what sigma is multiplied with for each joint; 1 for names that are not known."""
        return np.array([JOINT_SCATTER.get(name, 1.0) if self.by_joint else 1.0 for name in joints])


def _both(joint: str, scatter: float) -> dict[str, float]:
    return {f"R{joint}": scatter, f"L{joint}": scatter}


JOINT_SCATTER = {
    "Nose": 0.65, **_both("Eye", 0.67), **_both("Ear", 0.68), "Neck": 1.05, **_both("Shoulder", 1.08),
    **_both("Elbow", 0.88), **_both("Wrist", 0.90), "MidHip": 1.33, **_both("Hip", 1.28), **_both("Knee", 1.18),
    **_both("Ankle", 1.00), **_both("BigToe", 0.90), **_both("SmallToe", 0.96), **_both("Heel", 1.02),
}  # fmt: skip
"""How much farther than the mean a detection of a joint is from it at the same confidence. As sigma by confidence,
measured where simulated detections of the `tune` sequences lie beside the truth; the simulated detector draws from
statistics of real ones, and these, each view of Shelf against the others, give the same within a few per cent
(docs/evaluation.md)."""


def inverses(A: Array) -> Array:
    """Inverses (..., 3, 3) of symmetric matrices, by their cofactors; nothing is raised for singular ones."""
    a, b, c, d, e, f = (A[..., i, j] for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)))
    first, second, third = d * f - e * e, c * e - b * f, b * e - c * d
    whole = np.stack(
        [first, second, third, second, a * f - c * c, b * c - a * e, third, b * c - a * e, a * d - b * b]
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        whole /= a * first + b * second + c * third
    return np.ascontiguousarray(np.moveaxis(whole, 0, -1).reshape(A.shape))


def squared_distance(said: JointTargets, xyz: Array, covariance: Array) -> Array:
    """Squared Mahalanobis distance (N, J) of what is `said` of joints, whose information may be singular, from
    Gaussians at `xyz` (N, J, 3) with this `covariance` (N, J, 3, 3); NaN where these are not known.
    """
    known = np.asarray(np.isfinite(xyz).all(axis=-1) & np.isfinite(covariance).all(axis=(-2, -1)))
    away = np.where(known[..., None], xyz - np.nan_to_num(said.xyz), 0.0)[..., None]
    # (L^-1 + C)^-1 = (1 + L C)^-1 L, which holds for information L that is singular, too.
    both = np.eye(3) + said.information @ np.where(known[..., None, None], covariance, 0.0)
    squared = (away.mT @ np.linalg.solve(both, said.information @ away))[..., 0, 0]
    return np.where(known, squared, np.nan)


@dataclass(frozen=True)
class ViewEvidence:
    """What the observations say of the joints when these are at `points`."""

    points: Array
    """(N, J, 3) the joints, metres in the world; NaN where not known."""
    inlier: Mask
    """(N, J, V) delta_ij of Eq. 2: seen, in front of the camera and within rho_2D of the projection."""
    residual_px: Array
    """(N, J, V, 2) projection minus observation; NaN where unseen or unknown."""
    information: Array
    """(N, J, 3, 3) J^T W J over the inliers, robust weights included, 1/m²; zero where there is none."""
    gradient: Array
    """(N, J, 3) J^T W r over the inliers, 1/m."""

    @cached_property
    def target(self) -> Array:
        """(N, J, 3) where the observations alone would put each joint: one Gauss-Newton step from `points`.

        A joint that one view saw stays at its depth and moves onto the ray. NaN where `points` is.
        """
        scale = np.trace(self.information, axis1=-2, axis2=-1)[..., None, None]
        known = np.where(scale > 0, self.information + _DAMPING * scale * np.eye(3), np.eye(3))
        return self.points - (inverses(known) @ self.gradient[..., None])[..., 0]

    @cached_property
    def sigma_m(self) -> Array:
        """(N, J) standard deviation along the direction that the views know least, metres; infinite for a ray."""
        return weakest_sigma(self.information)

    @property
    def message(self) -> JointTargets:
        """The evidence as Gaussians."""
        return JointTargets(self.target, self.information)


def weakest_sigma(information: Array) -> Array:
    """Standard deviation (...,) along the direction that `information` (..., 3, 3) knows least; infinite for a
    ray.
    """
    values = np.asarray(np.linalg.eigvalsh(information), dtype=np.float64)
    # Under 1e-10 of the strongest is rounding: nothing.
    weakest = np.where(values[..., 0] > 1e-10 * values[..., 2], values[..., 0], 0.0)
    with np.errstate(divide="ignore"):
        return 1.0 / np.sqrt(weakest)


def observation_sigmas(
    observations: Observations, points: Array, views: Views, config: ObservationConfig, joints: Sequence[str]
) -> Array:
    """Sigma (N, J, V) in pixels of every observation, for joints near `points` (N, J, 3); 0 where unseen.

    `joints` are the J joints' names: some are seen more sharply than others. A joint whose place is not known
    takes the mean depth of the person's known ones.
    """
    ahead = views.cTw[..., 2, :]
    ahead = ahead if ahead.ndim == 3 else ahead[None]
    depth = points @ ahead[..., :3].mT + ahead[:, None, :, 3]
    usable = depth >= MIN_DEPTH_M
    mean = np.where(usable, depth, 0.0).sum(axis=1) / np.maximum(usable.sum(axis=1), 1)
    depth = np.where(usable, depth, np.maximum(mean, MIN_DEPTH_M)[:, None, :])
    focal, scatter = views.focal[:, None], config.scatter(joints)[:, None]
    weight = config.weight(observations.confidence) / scatter**2
    # What is as probably somebody else's says half as much.
    weight *= np.maximum(observations.probability, LEAST_PROBABILITY)
    at = config.fixed_depth_m if config.fixed_depth_m > 0 else depth
    sigma = np.hypot(config.floor_rad * focal, config.sigma_m * focal / at)
    return np.where(observations.seen, sigma / np.sqrt(np.where(observations.seen, weight, 1.0)), 0.0)


def linearise(
    observations: Observations,
    sigmas: Array,
    points: Array,
    views: Views,
    config: ObservationConfig,
    reach_m: float | None = None,
) -> ViewEvidence:
    """Decide the gates (Eq. 2) at `points` (N, J, 3) and sum up what the inliers say of each joint.

    `sigmas` (N, J, V) in pixels come from `observation_sigmas`. With `reach_m` a Geman-McClure kernel takes the
    place of gates and kernel: a weight of a quarter at this distance from the projection, as a length at the
    joint's depth. `inlier` is then every observation before its camera.
    """
    shape, kernel = observations.confidence.shape, config.robust_kernel
    inlier, residual = np.zeros(shape, dtype=bool), np.full((*shape, 2), np.nan)
    information, gradient = np.zeros((*shape[:2], 3, 3)), np.zeros((*shape[:2], 3))
    look(
        ready(points), views.projection, views.focal, ready(observations.xy),
        ready(np.where(observations.seen, sigmas, 0.0)), config.fixed_depth_m, MIN_DEPTH_M,
        config.rho_2d_m if reach_m is None else reach_m, reach_m is not None, ROBUST[kernel],
        1.0 if kernel is None else DEFAULT_WIDTH_SIGMA[kernel],
        inlier, residual, information, gradient,
    )  # fmt: skip
    return ViewEvidence(points, inlier, residual, information, gradient)


def information_by_view(evidence: ViewEvidence, sigmas: Array, views: Views, config: ObservationConfig) -> Array:
    """(N, J, V, 3, 3) what each observation says of its joint, robust weight included, 1/m²; zero for others."""
    _, _, slope = views.project(np.nan_to_num(evidence.points))
    used = evidence.inlier & (sigmas > 0) & np.isfinite(slope).all(axis=(-1, -2))
    sigma = np.where(used, sigmas, 1.0)
    off = np.nan_to_num(np.linalg.norm(evidence.residual_px, axis=-1)) / sigma
    weight = np.where(used, kernel_weight(config.robust_kernel, off) / sigma**2, 0.0)
    slope = np.where(used[..., None, None], slope, 0.0)
    return weight[..., None, None] * slope.mT @ slope


def mean_confidence(observations: Observations, inlier: Mask) -> Array:
    """w_i of Eq. 4: (N, J) mean confidence of each joint over all views.

    A view that did not see the joint counts 0, and so does one whose observation the gate discards: where the
    views contradict each other the joint is doubtful, however sure each of them is.
    """
    return np.where(inlier, observations.confidence, 0.0).mean(axis=-1)


def triangulate(observations: Observations, views: Views, config: ObservationConfig) -> Array:
    """X_0 made complete: joints that at least two views saw but stage I did not place, (N, J, 3) metres.

    Linear triangulation, iterated with robust weights; joints that stage I placed keep their place, and what
    fewer than two views saw, or views that disagree, stays NaN.
    """
    points = np.array(observations.initial, dtype=float, order="C")
    given = views.projection, views.focal, ready(observations.xy), ready(observations.confidence)
    complete(*given, 2.0 * config.sigma_m, config.rho_2d_m, MIN_DEPTH_M, points)
    return points
