"""Priors on human poses and motion, and bounds on bone lengths.

Both priors were learnt from motion capture (`body/data/*.md`).
"""

from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from shapepose_fg.body.model.smpl_file import DATA
from shapepose_fg.body.model.target_skeletons import BODY_POINTS
from shapepose_fg.core.arrays import Array, Index
from shapepose_fg.core.skeleton import Skeleton
from shapepose_fg.core.storage.npz import read_npz

NUM_ANGLES = 69
"""Number of angles: 23 local rotations below the root, axis-angle, in SMPL's order."""
NUM_MOVING = 3 + NUM_ANGLES + 3
"""Number of parameters that change over time: rotation vector of the root (3), 69 angles, position
of the root (3)."""

_CURE = "install the package again"
_SAMPLES = 2000
_MARGIN, _NOISE_M = 1.25, 0.05
"""Margin for people outside the body model, and for the errors of two joints (3 cm each, 1.5
sigma)."""


@dataclass(frozen=True)
class PosePrior:
    """A Gaussian over the axis-angles of all joints but the root, with limits for sampling.

    Angles are relative to the T-pose, in radians. Fits do not need the limits: as a penalty, they
    changed no error on held-out motions, noisy or seen by one view only.
    """

    mean: Array
    """(69,) mean angles, rad."""
    covariance: Array
    """(69, 69) covariance, rad², positive definite."""
    lower: Array
    """(69,) lower limits of the angles, rad; -inf for none."""
    upper: Array
    """(69,) upper limits of the angles, rad; inf for none."""
    provenance: str
    """Source of the motions, and how the prior was fitted."""

    def __post_init__(self) -> None:
        for name in ("mean", "covariance", "lower", "upper"):
            shape = (NUM_ANGLES,) * (2 if name == "covariance" else 1)
            value = np.asarray(getattr(self, name), dtype=np.float64)
            if value.shape != shape:
                raise ValueError(f"the pose prior's {name} must be {shape}, got {value.shape}")
            if np.isnan(value).any():
                raise ValueError(
                    f"the pose prior's {name} has values that are not finite: fit it again"
                )
            object.__setattr__(self, name, value)
        if np.abs(self.covariance - self.covariance.T).max() > 1e-9:
            raise ValueError("the pose prior's covariance must be symmetric")
        if np.linalg.eigvalsh(self.covariance).min() <= 0:
            raise ValueError("the pose prior's covariance must be positive definite: regularise it")
        if (self.lower >= self.upper).any():
            raise ValueError("the pose prior's lower limits must be below the upper ones")

    @staticmethod
    @cache
    def default() -> "PosePrior":
        """The prior that ships with the package (read once)."""
        data = read_npz(
            DATA / "pose_prior.npz",
            ("means", "covariances", "lower", "upper", "provenance"),
            _CURE,
        )
        arrays = (data["means"][0], data["covariances"][0], data["lower"], data["upper"])
        return PosePrior(
            *(value.astype(np.float64) for value in arrays), provenance=str(data["provenance"])
        )

    def widened(self, factor: float) -> "PosePrior":
        """Return this prior with standard deviations `factor` times as large."""
        return replace(self, covariance=factor**2 * self.covariance)

    def marginal_precision(self, angles: Index) -> Array:
        """(A, A) inverse of the marginal covariance of some `angles` (A,), 1/rad²."""
        precision = np.linalg.inv(self.covariance[angles[:, None], angles])
        return np.asarray((precision + precision.T) / 2, dtype=np.float64)

    def regression(self, given: Index, predicted: Index) -> Array:
        """Matrix G (M, A) that predicts angles `predicted` (M,) from `given` ones (A,).

        E[predicted | given] = mean[predicted] + G (given - mean[given]).
        """
        S = self.covariance
        G = np.linalg.solve(S[given[:, None], given], S[given[:, None], predicted])
        return np.asarray(G.T, dtype=np.float64)

    def sample(self, rng: np.random.Generator, count: int) -> Array:
        """Draw `count` poses (count, 23, 3), rad; angles are clipped to the limits."""
        rng.random(count)  # unused draw; keeps the samples of each seed unchanged
        white = rng.normal(size=(count, NUM_ANGLES))
        factor = np.broadcast_to(
            np.linalg.cholesky(self.covariance), (count, NUM_ANGLES, NUM_ANGLES)
        )
        draw = self.mean + np.einsum("nij,nj->ni", factor, white)
        return np.clip(draw, self.lower, self.upper).reshape(count, 23, 3)


@dataclass(frozen=True)
class MotionPrior:
    """Power spectral densities of the 75 moving parameters: root, angles, position.

    Between rows at times t_k, with h_k = t_k+1 - t_k and v_k = (q_k+1 - q_k) / h_k:

        v_k ~ N(0, velocity / h_k),   v_k+1 - v_k ~ N(0, acceleration (h_k + h_k+1) / 2)

    The second makes motion smooth, the first limits the drift of unobserved parameters.
    """

    acceleration: Array
    """(75,) power spectral density of the acceleration: angles rad²/s³, position m²/s³."""
    velocity: Array
    """(75,) power spectral density of the velocity: angles rad²/s, position m²/s."""
    provenance: str
    """Source of the motions, and how the prior was fitted."""

    def __post_init__(self) -> None:
        for name in ("acceleration", "velocity"):
            value = np.asarray(getattr(self, name), dtype=np.float64)
            if value.shape != (NUM_MOVING,):
                raise ValueError(
                    f"the motion prior's {name} must be ({NUM_MOVING},), got {value.shape}"
                )
            if not (np.isfinite(value) & (value > 0)).all():
                raise ValueError(
                    f"the motion prior's {name} must be positive numbers: fit it again"
                )
            object.__setattr__(self, name, value)

    @staticmethod
    @cache
    def default() -> "MotionPrior":
        """The prior that ships with the package (read once)."""
        data = read_npz(
            DATA / "motion_prior.npz", ("acceleration", "velocity", "provenance"), _CURE
        )
        return MotionPrior(data["acceleration"], data["velocity"], str(data["provenance"]))

    def part(self, angles: Index) -> tuple[Array, Array]:
        """Acceleration and velocity densities (N,) of the root, some of the `angles` (A,) and the
        position.
        """
        kept = np.concatenate([np.arange(3), 3 + angles, np.arange(-3, 0) + NUM_MOVING])
        return self.acceleration[kept], self.velocity[kept]


@cache
def longest_bones(skeleton: Skeleton) -> Array:
    """(J,) upper bounds on the distance of each joint from its parent, metres; infinite for the
    root.

    The 99.9 % quantile over bodies within three standard deviations of shape, in poses drawn from
    the pose prior, plus a margin. Joints unknown to the body get the maximum over all.
    """
    from shapepose_fg.body.model.body_model import BodyModel, BodyParameters

    known = [j for j, name in enumerate(skeleton.joints) if name in BODY_POINTS]
    model = BodyModel.default().with_keypoints(tuple(skeleton.joints[j] for j in known))
    rng = np.random.default_rng(0)
    pose = PosePrior.default().sample(rng, _SAMPLES)
    betas = rng.standard_normal((_SAMPLES, 10)).clip(-3, 3)
    still = np.zeros((_SAMPLES, 3))
    xyz = np.full((_SAMPLES, len(skeleton), 3), np.nan)
    xyz[:, known] = model.keypoints(BodyParameters(betas, still, pose, still))
    parents = np.array(skeleton.parents)
    length = np.quantile(np.linalg.norm(xyz - xyz[:, parents], axis=-1), 0.999, axis=0)
    # Maximum length of a bone unknown to the body, m: the trunk of a tall adult, hip to neck, is
    # about 0.65 m.
    longest = np.where(np.isfinite(length), _MARGIN * length + _NOISE_M, 0.75)
    return np.where(parents < 0, np.inf, longest)
