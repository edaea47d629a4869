"""Measurements of the views about each person's joints: gates, weights, information."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Literal

import numpy as np
from annotated_types import Interval

from factors import DEFAULT_WIDTH_SIGMA, KernelName, kernel_weight
from shapepose_fg.core.arrays import Array, Mask
from shapepose_fg.core.bounds import Factor, Metres, MetresOrNone, Settings, Share
from shapepose_fg.core.camera import Views
from shapepose_fg.core.kernel_geometry import ROBUST
from shapepose_fg.core.observations import Observations
from shapepose_fg.core.rows import Rows
from shapepose_fg.estimation.kernels import complete, gate_and_linearise, ready

MIN_DEPTH_M = 0.2
"""Minimum depth of a joint in front of a camera for its observation to be used, m."""
LEAST_PROBABILITY = 0.01
"""Lower limit of an observation's probability."""
_DAMPING = 1e-7
"""Share of a joint's information that is added in all directions, so that depth along a single ray
does not change."""
_DEPTH_M = 8.0
"""Median depth of joints in the `tune` sequences (7 to 10 m), metres, for converting lengths to
pixels in the paper's setting."""


@dataclass(frozen=True)
class ObservationConfig(Settings):
    """Noise model of 2D observations."""

    sigma_m: Metres = 0.0105
    """Standard deviation per axis of a detection with confidence 1, as a length at the joint's
    depth, metres: like a person's image, the detector's error shrinks with distance."""
    confidence_power: Annotated[float, Interval(gt=0, le=100)] = 5.0
    """p of w_ij, the weight in Eq. 1 of an observation of confidence c: w_ij = (c^p + w_0) / (1 +
    w_0). In the paper it is the confidence itself. Measured, sigma at 0.95 is a third of that below
    0.4."""
    least_weight: Share = 0.077
    """w_0 of w_ij: the minimum weight of an observation."""
    by_joint: bool = True
    """Whether sigma differs by joint (`JOINT_SCATTER`): a detector localises an eye better than a
    hip."""
    floor_rad: Share = 0.001
    """Contribution of the detector's grid, rad: one pixel at a focal length of 1,000 px. It is an
    angle, because a detector rescales pictures to its own size."""
    rho_2d_m: Factor = 0.15
    """rho_2D of Eq. 2, as a length at the joint's depth, metres: observations farther from the
    projected joint are rejected. Half the distance between a person's own shoulders or hips."""
    fixed_depth_m: MetresOrNone = 0.0
    """Positive: fixed depth, metres, at which `sigma_m` and `rho_2d_m` are lengths, so that d_2D is
    in pixels, as in the paper. 0: at the joint's own depth."""
    kernel: KernelName | Literal["none"] = "cauchy"
    """Robust kernel of the projection factors. The paper has none."""

    @classmethod
    def paper(cls) -> "ObservationConfig":
        """The settings of Eqs. 1 and 2: squared pixels times the confidence, for all within rho_2D.

        A detection with confidence 0.7 has the measured sigma: 2 cm.
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
        """(J,) factor on sigma for each joint; 1 for unknown names."""
        return np.array([JOINT_SCATTER.get(name, 1.0) if self.by_joint else 1.0 for name in joints])


def _both(joint: str, scatter: float) -> dict[str, float]:
    return {f"R{joint}": scatter, f"L{joint}": scatter}


JOINT_SCATTER = {
    "Nose": 0.65, **_both("Eye", 0.67), **_both("Ear", 0.68), "Neck": 1.05,
    **_both("Shoulder", 1.08), **_both("Elbow", 0.88), **_both("Wrist", 0.90), "MidHip": 1.33,
    **_both("Hip", 1.28), **_both("Knee", 1.18), **_both("Ankle", 1.00), **_both("BigToe", 0.90),
    **_both("SmallToe", 0.96), **_both("Heel", 1.02),
}  # fmt: skip
"""Ratio of each joint's detection error to the mean at the same confidence. Like sigma by
confidence, measured on simulated detections of the `tune` sequences against the ground truth. The
simulated detector uses statistics of real ones, and these, for each view of Shelf against the
others, agree within a few per cent (docs/evaluation.md)."""


def inverses(A: Array) -> Array:
    """Inverses (..., 3, 3) of symmetric matrices, by cofactors; singular ones raise no error."""
    a, b, c, d, e, f = (A[..., i, j] for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)))
    first, second, third = d * f - e * e, c * e - b * f, b * e - c * d
    whole = np.stack(
        [
            first,
            second,
            third,
            second,
            a * f - c * c,
            b * c - a * e,
            third,
            b * c - a * e,
            a * d - b * b,
        ]
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        whole /= a * first + b * second + c * third
    return np.ascontiguousarray(np.moveaxis(whole, 0, -1).reshape(A.shape))


@dataclass(frozen=True)
class ViewEvidence(Rows):
    """Linearised measurements of the views at joints `points`."""

    points: Array
    """(N, J, 3) linearisation points, metres in the world; NaN if unknown."""
    inlier: Mask
    """(N, J, V) delta_ij of Eq. 2: observed, in front of the camera and within rho_2D of the
    projection."""
    residual_px: Array
    """(N, J, V, 2) projection minus observation; NaN where unseen or unknown."""
    information: Array
    """(N, J, 3, 3) J^T W J over the inliers, including robust weights, 1/m²; zero without any."""
    gradient: Array
    """(N, J, 3) J^T W r over the inliers, 1/m."""

    @cached_property
    def target(self) -> Array:
        """(N, J, 3) estimate of each joint from the observations only: one Gauss-Newton step from
        `points`.

        A joint seen by one view keeps its depth and moves onto the ray. NaN where `points` is.
        """
        scale = np.trace(self.information, axis1=-2, axis2=-1)[..., None, None]
        known = np.where(scale > 0, self.information + _DAMPING * scale * np.eye(3), np.eye(3))
        return self.points - (inverses(known) @ self.gradient[..., None])[..., 0]

    @cached_property
    def sigma_m(self) -> Array:
        """(N, J) standard deviation in the worst direction, metres; infinite for a ray."""
        return weakest_sigma(self.information)


def weakest_sigma(information: Array) -> Array:
    """Standard deviation (...,) in the worst direction for `information` (..., 3, 3); infinite for
    a ray.
    """
    values = np.asarray(np.linalg.eigvalsh(information), dtype=np.float64)
    # Below 1e-10 of the largest eigenvalue it is rounding.
    weakest = np.where(values[..., 0] > 1e-10 * values[..., 2], values[..., 0], 0.0)
    with np.errstate(divide="ignore"):
        return 1.0 / np.sqrt(weakest)


def observation_sigmas(
    observations: Observations,
    points: Array,
    views: Views,
    config: ObservationConfig,
    joints: Sequence[str],
) -> Array:
    """Standard deviation (N, J, V) of every observation, pixels, for joints near `points` (N, J,
    3); 0 if not observed.

    `joints` are the names of the J joints, with different accuracies. A joint of unknown position
    is assumed at the mean depth of the person's known ones.
    """
    ahead = views.cTw[..., 2, :]
    ahead = ahead if ahead.ndim == 3 else ahead[None]
    depth = points @ ahead[..., :3].mT + ahead[:, None, :, 3]
    usable = depth >= MIN_DEPTH_M
    mean = np.where(usable, depth, 0.0).sum(axis=1) / np.maximum(usable.sum(axis=1), 1)
    depth = np.where(usable, depth, np.maximum(mean, MIN_DEPTH_M)[:, None, :])
    focal, scatter = views.focal[:, None], config.scatter(joints)[:, None]
    weight = config.weight(observations.confidence) / scatter**2
    # The information is multiplied by the probability that the observation is the person's.
    weight *= np.maximum(observations.probability, LEAST_PROBABILITY)
    at = config.fixed_depth_m if config.fixed_depth_m > 0 else depth
    sigma = np.hypot(config.floor_rad * focal, config.sigma_m * focal / at)
    return np.where(
        observations.seen, sigma / np.sqrt(np.where(observations.seen, weight, 1.0)), 0.0
    )


def linearise(
    observations: Observations,
    sigmas: Array,
    points: Array,
    views: Views,
    config: ObservationConfig,
    reach_m: float | None = None,
) -> ViewEvidence:
    """Gate observations (Eq. 2) at `points` (N, J, 3), and sum the information of the inliers about
    each joint.

    `sigmas` (N, J, V) in pixels are from `observation_sigmas`. With `reach_m`, a Geman-McClure
    kernel replaces gates and kernel: its weight is a quarter at this distance from the projection,
    as a length at the joint's depth, metres. `inlier` is then every observation in front of its
    camera.
    """
    shape, kernel = observations.confidence.shape, config.robust_kernel
    inlier, residual = np.zeros(shape, dtype=bool), np.full((*shape, 2), np.nan)
    information, gradient = np.zeros((*shape[:2], 3, 3)), np.zeros((*shape[:2], 3))
    gate_and_linearise(
        ready(points), views.projection, views.focal, ready(observations.xy),
        ready(np.where(observations.seen, sigmas, 0.0)), config.fixed_depth_m, MIN_DEPTH_M,
        config.rho_2d_m if reach_m is None else reach_m, reach_m is not None, ROBUST[kernel],
        1.0 if kernel is None else DEFAULT_WIDTH_SIGMA[kernel],
        inlier, residual, information, gradient,
    )  # fmt: skip
    return ViewEvidence(points, inlier, residual, information, gradient)


def information_by_view(
    evidence: ViewEvidence, sigmas: Array, views: Views, config: ObservationConfig
) -> Array:
    """(N, J, V, 3, 3) information of each used observation, times its robust weight, 1/m²; else
    zero.
    """
    _, _, slope = views.project(np.nan_to_num(evidence.points))
    used = evidence.inlier & (sigmas > 0) & np.isfinite(slope).all(axis=(-1, -2))
    sigma = np.where(used, sigmas, 1.0)
    off = np.nan_to_num(np.linalg.norm(evidence.residual_px, axis=-1)) / sigma
    weight = np.where(used, kernel_weight(config.robust_kernel, off) / sigma**2, 0.0)
    slope = np.where(used[..., None, None], slope, 0.0)
    return weight[..., None, None] * slope.mT @ slope


def mean_confidence(observations: Observations, inlier: Mask) -> Array:
    """w_i of Eq. 4: (N, J) mean confidence of each joint over all views.

    Views without a detection of the joint, or with a rejected one, count as 0: where views
    contradict each other, the joint is uncertain however confident each of them is.
    """
    return np.where(inlier, observations.confidence, 0.0).mean(axis=-1)


def triangulate(observations: Observations, views: Views, config: ObservationConfig) -> Array:
    """Complete X_0, (N, J, 3) metres, with joints that at least two views see but stage I does not
    find.

    Linear triangulation, iterated with robust weights; joints of stage I keep their position, and
    joints seen by fewer than two views, or by views that disagree, stay NaN.
    """
    points = observations.initial.astype(float, order="C")
    given = views.projection, views.focal, ready(observations.xy), ready(observations.confidence)
    complete(*given, 2.0 * config.sigma_m, config.rho_2d_m, MIN_DEPTH_M, points)
    return points
