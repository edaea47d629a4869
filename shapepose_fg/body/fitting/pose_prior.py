"""What poses people take: a Gaussian over the joint angles of a body, learnt from motion capture."""

from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.errors import InputError
from shapepose_fg.core.storage.npz import read_npz

Array = NDArray[np.float64]

NUM_ANGLES = 69
"""The 23 local rotations below the root, axis-angle, in SMPL's order."""

_DEFAULT = Path(__file__).parents[1] / "data" / "pose_prior.npz"
_ARRAYS = ("weights", "means", "covariances", "lower", "upper")
"""Of the file, which could hold several Gaussians: (K,), (K, 69), (K, 69, 69), (69,), (69,)."""


@dataclass(frozen=True)
class PosePrior:
    """A Gaussian over the axis-angle of every joint but the root, and limits for drawing from it.

    Made by `scripts/fit_pose_prior.py`. Angles are relative to the T-pose, in radians. Fits do not need the
    limits: with them as a penalty, no error changed on held-out motions, noisy or seen by one view only.
    """

    mean: Array
    """(69,) mean angles, rad."""
    covariance: Array
    """(69, 69) covariance, rad², positive definite."""
    lower: Array
    """(69,) angles under which a joint is bent the wrong way, rad; -inf where there is no limit."""
    upper: Array
    """(69,) angles over which a joint is bent the wrong way, rad; inf where there is no limit."""
    provenance: str
    """Where the motions came from and how the prior was made."""

    def __post_init__(self) -> None:
        shapes = {"mean": (NUM_ANGLES,), "covariance": (NUM_ANGLES, NUM_ANGLES)}
        for name, shape in (shapes | dict.fromkeys(("lower", "upper"), (NUM_ANGLES,))).items():
            value = np.asarray(getattr(self, name), dtype=np.float64)
            if value.shape != shape:
                raise ValueError(f"the pose prior's {name} must be {shape}, got {value.shape}")
            if np.isnan(value).any():
                raise ValueError(f"the pose prior's {name} holds NaN: fit it again")
            object.__setattr__(self, name, value)
        if np.abs(self.covariance - self.covariance.T).max() > 1e-9:
            raise ValueError("the pose prior's covariance must be symmetric")
        if np.linalg.eigvalsh(self.covariance).min() <= 0:
            raise ValueError("the pose prior's covariance must be positive definite: regularise it")
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
        count = data["weights"].size
        if count != 1 or len(data["means"]) != 1 or len(data["covariances"]) != 1:
            raise InputError(f"{path}: a mixture of {count} Gaussians; fits take one: fit it again")
        arrays = (data["means"][0], data["covariances"][0], data["lower"], data["upper"])
        return cls(*(value.astype(np.float64) for value in arrays), provenance=str(data["provenance"]))

    def save(self, path: str | Path) -> None:
        """Write the prior as .npz, readable without pickle."""
        arrays = (np.ones(1), self.mean[None], self.covariance[None], self.lower, self.upper)
        named = dict(zip(_ARRAYS, arrays, strict=True))
        np.savez_compressed(path, allow_pickle=False, **named, provenance=np.array(self.provenance))

    def widened(self, factor: float) -> "PosePrior":
        """The same with standard deviations `factor` times as large."""
        return replace(self, covariance=factor**2 * self.covariance)

    def marginal_precision(self, angles: NDArray[np.intp]) -> Array:
        """(A, A) inverse covariance of some `angles` (A,), the others free, 1/rad²."""
        precision = np.linalg.inv(self.covariance[angles[:, None], angles])
        return np.asarray((precision + precision.T) / 2, dtype=np.float64)

    def regression(self, given: NDArray[np.intp], asked: NDArray[np.intp]) -> Array:
        """Matrix G (M, A) that predicts angles `asked` (M,) from `given` ones (A,).

        E[asked | given] = mean[asked] + G (given - mean[given]).
        """
        S = self.covariance
        G = np.linalg.solve(S[given[:, None], given], S[given[:, None], asked])
        return np.asarray(G.T, dtype=np.float64)

    def sample(self, rng: np.random.Generator, count: int) -> Array:
        """Draw `count` poses (count, 23, 3), rad; angles past a limit are brought back to it."""
        rng.random(count)  # once chose between Gaussians: what a seed gives stays what it was
        white = rng.normal(size=(count, NUM_ANGLES))
        factor = np.broadcast_to(np.linalg.cholesky(self.covariance), (count, NUM_ANGLES, NUM_ANGLES))
        draw = self.mean + np.einsum("nij,nj->ni", factor, white)
        return np.clip(draw, self.lower, self.upper).reshape(count, 23, 3)

    def log_density(self, poses: Array) -> Array:
        """Log density of poses (..., 23, 3) or (..., 69), nats (limits left out)."""
        leading = poses.shape[:-2] if poses.shape[-1] == 3 else poses.shape[:-1]
        error = poses.reshape(*leading, NUM_ANGLES) - self.mean
        squared = np.einsum("...i,ij,...j->...", error, np.linalg.inv(self.covariance), error, optimize=True)
        return -0.5 * (squared + np.linalg.slogdet(2 * np.pi * self.covariance)[1])


@lru_cache(maxsize=1)
def _load_default() -> PosePrior:
    return PosePrior.load(_DEFAULT)
