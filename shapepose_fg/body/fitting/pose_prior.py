"""What poses people take: a Gaussian mixture over the joint angles of a body, learnt from motion capture."""

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.errors import InputError
from shapepose_fg.core.storage.npz import read_npz

NUM_ANGLES = 69
"""The 23 local rotations below the root, axis-angle, in SMPL's order."""

_DEFAULT = Path(__file__).parents[1] / "data" / "pose_prior.npz"
_ARRAYS = ("weights", "means", "covariances", "lower", "upper")
_SHARES_SUM = 1e-6
"""Weights may miss 1 by this much: rounding in a file."""


@dataclass(frozen=True)
class PosePrior:
    """K Gaussians over the axis-angle of every joint but the root, and limits for drawing from them.

    Made by `scripts/fit_pose_prior.py`. Angles are relative to the T-pose, in radians. Fits do not need the
    limits: with them as a penalty, no error changed on held-out motions, noisy or seen by one view only.
    """

    weights: NDArray[np.float64]
    """(K,) share of each component, positive, 1 in all."""
    means: NDArray[np.float64]
    """(K, 69) mean angles of each component, rad."""
    covariances: NDArray[np.float64]
    """(K, 69, 69) covariance of each, rad², positive definite."""
    lower: NDArray[np.float64]
    """(69,) angles under which a joint is bent the wrong way, rad; -inf where there is no limit."""
    upper: NDArray[np.float64]
    """(69,) angles over which a joint is bent the wrong way, rad; inf where there is no limit."""
    provenance: str
    """Where the motions came from and how the prior was made."""

    def __post_init__(self) -> None:
        K = len(self.weights)
        shapes = ((K,), (K, NUM_ANGLES), (K, NUM_ANGLES, NUM_ANGLES), (NUM_ANGLES,), (NUM_ANGLES,))
        for name, shape in zip(_ARRAYS, shapes, strict=True):
            value = np.asarray(getattr(self, name), dtype=np.float64)
            if value.shape != shape:
                raise ValueError(f"the pose prior's {name} must be {shape}, got {value.shape}")
            if np.isnan(value).any():
                raise ValueError(f"the pose prior's {name} holds NaN: fit it again")
            object.__setattr__(self, name, value)
        if K == 0 or self.weights.min() <= 0 or abs(self.weights.sum() - 1) > _SHARES_SUM:
            raise ValueError("the pose prior's weights must be positive and 1 in all: divide them by their sum")
        if np.abs(self.covariances - self.covariances.swapaxes(1, 2)).max() > 1e-9:
            raise ValueError("the pose prior's covariances must be symmetric")
        if np.linalg.eigvalsh(self.covariances).min() <= 0:
            raise ValueError("the pose prior's covariances must be positive definite: regularise them")
        if (self.lower >= self.upper).any():
            raise ValueError("the pose prior's lower limits must be below the upper ones")

    @staticmethod
    def default() -> "PosePrior":
        """The prior that ships with the package (read once)."""
        return _load_default()

    @classmethod
    def load(cls, path: str | Path) -> "PosePrior":
        """Read a prior that `save` wrote; InputError naming the file if something is missing."""
        data = read_npz(Path(path), (*_ARRAYS, "provenance"), "fit it again")
        missing = [name for name in (*_ARRAYS, "provenance") if name not in data]
        if missing:
            raise InputError(f"{path}: not a pose prior, it has no {' '.join(missing)}; fit it again")
        arrays = (data[name].astype(np.float64) for name in _ARRAYS)
        return cls(*arrays, provenance=str(data["provenance"]))

    def save(self, path: str | Path) -> None:
        """Write the prior as .npz, readable without pickle."""
        arrays = {name: getattr(self, name) for name in _ARRAYS}
        np.savez_compressed(path, allow_pickle=False, **arrays, provenance=np.array(self.provenance))

    def __len__(self) -> int:
        """Count of components, K."""
        return len(self.weights)

    @cached_property
    def mean(self) -> NDArray[np.float64]:
        """(69,) mean angles over all components, rad."""
        return self.weights @ self.means

    @cached_property
    def covariance(self) -> NDArray[np.float64]:
        """(69, 69) covariance over all components: within and between them, rad²."""
        apart = self.means - self.mean
        within = np.einsum("k,kij->ij", self.weights, self.covariances)
        return within + np.einsum("k,ki,kj->ij", self.weights, apart, apart)

    def widened(self, factor: float) -> "PosePrior":
        """The same with every component's standard deviations `factor` times as large."""
        return replace(self, covariances=factor**2 * self.covariances)

    def marginal_precisions(self, angles: NDArray[np.intp]) -> NDArray[np.float64]:
        """Inverse covariance of some `angles` (A,) in each component, the others free: (K, A, A), 1/rad²."""
        precisions = np.linalg.inv(self.covariances[:, angles[:, None], angles])
        return np.asarray((precisions + precisions.swapaxes(1, 2)) / 2, dtype=np.float64)

    def regressions(self, given: NDArray[np.intp], asked: NDArray[np.intp]) -> NDArray[np.float64]:
        """Matrices (K, M, A) that predict `asked` (M,) from `given` (A,) angles in each component.

        E[asked | given, k] = means[k, asked] + G_k (given - means[k, given]), the best guess of a Gaussian.
        """
        S = self.covariances
        G = np.linalg.solve(S[:, given[:, None], given], S[:, given[:, None], asked])
        return np.asarray(G.swapaxes(1, 2), dtype=np.float64)

    def sample(self, rng: np.random.Generator, count: int) -> NDArray[np.float64]:
        """Draw `count` poses (count, 23, 3), rad; angles past a limit are brought back to it."""
        component = rng.choice(len(self), size=count, p=self.weights / self.weights.sum())
        factor = np.linalg.cholesky(self.covariances)
        white = rng.normal(size=(count, NUM_ANGLES))
        draw = self.means[component] + np.einsum("nij,nj->ni", factor[component], white)
        return np.clip(draw, self.lower, self.upper).reshape(count, 23, 3)

    def log_density(self, poses: NDArray[np.float64]) -> NDArray[np.float64]:
        """Log density of poses (..., 23, 3) or (..., 69) under the mixture (limits left out), nats."""
        leading = poses.shape[:-2] if poses.shape[-1] == 3 else poses.shape[:-1]
        error = poses.reshape(*leading, 1, NUM_ANGLES) - self.means
        precisions = self.marginal_precisions(np.arange(NUM_ANGLES))
        squared = np.einsum("...ki,kij,...kj->...k", error, precisions, error, optimize=True)
        log_normal = -0.5 * (squared + np.linalg.slogdet(2 * np.pi * self.covariances)[1])
        return np.logaddexp.reduce(log_normal + np.log(self.weights), axis=-1)


@lru_cache(maxsize=1)
def _load_default() -> PosePrior:
    return PosePrior.load(_DEFAULT)
