"""What poses people take: a Gaussian over the joint angles of a body, learnt from motion capture."""

from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

NUM_ANGLES = 69
"""The 23 local rotations below the root, axis-angle, in SMPL's order."""

_DEFAULT = Path(__file__).parent / "data" / "pose_prior.npz"


@dataclass(frozen=True)
class PosePrior:
    """A Gaussian over the axis-angle of every joint but the root, and limits for drawing from it.

    Made by `scripts/fit_pose_prior.py`. Angles are relative to the T-pose, in radians. Fits do not need the
    limits: with them as a penalty, no error changed on held-out motions, noisy or seen by one view only.
    """

    mean: NDArray[np.float64]
    """(69,) mean angles, rad."""
    covariance: NDArray[np.float64]
    """(69, 69) covariance, rad², positive definite."""
    lower: NDArray[np.float64]
    """(69,) angles under which a joint is bent the wrong way, rad; -inf where there is no limit."""
    upper: NDArray[np.float64]
    """(69,) angles over which a joint is bent the wrong way, rad; inf where there is no limit."""
    provenance: str
    """Where the motions came from and how the prior was made."""

    def __post_init__(self) -> None:
        for name, shape in (("mean", (69,)), ("covariance", (69, 69)), ("lower", (69,)), ("upper", (69,))):
            value = np.asarray(getattr(self, name), dtype=np.float64)
            if value.shape != shape:
                raise ValueError(f"the pose prior's {name} must be {shape}, got {value.shape}")
            if np.isnan(value).any():
                raise ValueError(f"the pose prior's {name} holds NaN: fit it again")
            object.__setattr__(self, name, value)
        if np.abs(self.covariance - self.covariance.T).max() > 1e-9:
            raise ValueError("the pose prior's covariance must be symmetric")
        if np.linalg.eigvalsh(self.covariance)[0] <= 0:
            raise ValueError("the pose prior's covariance must be positive definite: regularise it")
        if (self.lower >= self.upper).any():
            raise ValueError("the pose prior's lower limits must be below the upper ones")

    @staticmethod
    def default() -> "PosePrior":
        """The prior that ships with the package (read once)."""
        return _load_default()

    @classmethod
    def load(cls, path: str | Path) -> "PosePrior":
        """Read a prior that `save` wrote; ValueError naming the file if something is missing."""
        with np.load(path, allow_pickle=False) as data:
            names = ("mean", "covariance", "lower", "upper", "provenance")
            missing = [name for name in names if name not in data.files]
            if missing:
                raise ValueError(f"{path}: not a pose prior, it has no {' '.join(missing)}")
            mean, covariance, lower, upper = (data[name].astype(np.float64) for name in names[:4])
            return cls(mean, covariance, lower, upper, str(data["provenance"]))

    def save(self, path: str | Path) -> None:
        """Write the prior as .npz, readable without pickle."""
        np.savez_compressed(
            path,
            mean=self.mean,
            covariance=self.covariance,
            lower=self.lower,
            upper=self.upper,
            provenance=np.array(self.provenance),
        )

    @cached_property
    def precision(self) -> NDArray[np.floating]:
        """(69, 69) inverse of the covariance, 1/rad²."""
        return np.linalg.inv(self.covariance)

    def marginal_precision(self, angles: NDArray[np.intp]) -> NDArray[np.floating]:
        """Inverse covariance of some `angles` (K,) when the others are free: (K, K), 1/rad²."""
        return np.linalg.inv(self.covariance[np.ix_(angles, angles)])

    def regression(self, given: NDArray[np.intp], asked: NDArray[np.intp]) -> NDArray[np.floating]:
        """The matrix (M, K) that predicts `asked` (M,) from `given` (K,) angles.

        E[asked | given] = mean[asked] + G (given - mean[given]), the best guess of a Gaussian.
        """
        S = self.covariance
        return np.linalg.solve(S[np.ix_(given, given)], S[np.ix_(given, asked)]).T

    def sample(self, rng: np.random.Generator, count: int) -> NDArray[np.float64]:
        """Draw `count` poses (count, 23, 3), rad; angles past a limit are brought back to it."""
        draw = rng.multivariate_normal(self.mean, self.covariance, size=count, method="cholesky")
        return np.clip(draw, self.lower, self.upper).reshape(count, 23, 3)

    def log_density(self, poses: NDArray[np.float64]) -> NDArray[np.float64]:
        """Log density of poses (..., 23, 3) or (..., 69) under the Gaussian (limits left out), nats."""
        leading = poses.shape[:-2] if poses.shape[-1] == 3 else poses.shape[:-1]
        error = poses.reshape(*leading, NUM_ANGLES) - self.mean
        squared = np.einsum("...i,ij,...j->...", error, self.precision, error)
        return -0.5 * (squared + np.linalg.slogdet(2 * np.pi * self.covariance)[1])


@lru_cache(maxsize=1)
def _load_default() -> PosePrior:
    return PosePrior.load(_DEFAULT)
