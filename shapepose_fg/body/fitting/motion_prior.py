"""How fast people's poses change: noise in the motion of every angle, learnt from motion capture."""

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from factors import CONSTANT_VELOCITY, Motion
from shapepose_fg.body.fitting.pose_prior import NUM_ANGLES
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.storage.npz import read_npz

Array = NDArray[np.float64]

NUM_MOVING = 3 + NUM_ANGLES + 3
"""Rotation of the root, the other 69 angles, the root's place."""

_DEFAULT = Path(__file__).parents[1] / "data" / "motion_prior.npz"
_ARRAYS = ("acceleration", "velocity")


@dataclass(frozen=True)
class MotionPrior:
    """Power spectral densities of the 75 numbers that move, in the order root, angles, place.

    Between rows at the times t_k, with h_k = t_k+1 - t_k and v_k = (q_k+1 - q_k) / h_k:

        v_k ~ N(0, velocity / h_k),   v_k+1 - v_k ~ N(0, acceleration (h_k + h_k+1) / 2)

    the second for smooth motion, the first so that what nothing shows does not drift away. Another `law` of motion
    takes the place of the second.
    Made by `scripts/fit_motion_prior.py`.
    """

    acceleration: Array
    """(75,) of the acceleration: rad²/s³, of the place m²/s³."""
    velocity: Array
    """(75,) of the velocity: rad²/s, of the place m²/s."""
    provenance: str
    """Where the motions came from and how the prior was made."""
    law: Motion = CONSTANT_VELOCITY
    """How the numbers move; `acceleration` becomes the density of its noise (`Motion.density`)."""

    def __post_init__(self) -> None:
        for name in _ARRAYS:
            value = np.asarray(getattr(self, name), dtype=np.float64)
            if value.shape != (NUM_MOVING,):
                raise ValueError(f"the motion prior's {name} must be ({NUM_MOVING},), got {value.shape}")
            if not (np.isfinite(value) & (value > 0)).all():
                raise ValueError(f"the motion prior's {name} must be positive numbers: fit it again")
            object.__setattr__(self, name, value)

    @staticmethod
    def default() -> "MotionPrior":
        """The prior that ships with the package (read once)."""
        return _load_default()

    @classmethod
    def load(cls, path: str | Path) -> "MotionPrior":
        """Read a prior that `save` wrote; InputError naming the file if something is missing."""
        data = read_npz(Path(path), (*_ARRAYS, "provenance"), "fit it again")
        missing = [name for name in (*_ARRAYS, "provenance") if name not in data]
        if missing:
            raise InputError(f"{path}: not a motion prior, it has no {' '.join(missing)}; fit it again")
        return cls(*(data[name] for name in _ARRAYS), provenance=str(data["provenance"]))

    def save(self, path: str | Path) -> None:
        """Write the prior as .npz, readable without pickle."""
        arrays = {name: getattr(self, name) for name in _ARRAYS}
        np.savez_compressed(path, allow_pickle=False, **arrays, provenance=np.array(self.provenance))

    def part(self, angles: NDArray[np.intp]) -> tuple[Array, Array]:
        """Densities (N,) of the noise and the velocity of the root, some of the `angles` (A,) and the place."""
        kept = np.concatenate([np.arange(3), 3 + angles, np.arange(-3, 0) + NUM_MOVING])
        return self.law.density(self.acceleration[kept]), self.velocity[kept]


@lru_cache(maxsize=1)
def _load_default() -> MotionPrior:
    return MotionPrior.load(_DEFAULT)
