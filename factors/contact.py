"""Factor of a standing foot: its position stays constant between successive frames.

Residual, in metres in the world:

    r = x' - x  ~  N(0, q dt I)

with q the density of a random walk, m²/s: a standing foot turns and slides a little, in random
directions. Native and linear. Used in addition to `factors.motion`, it constrains the mean velocity
of the joint to zero.
"""

from itertools import repeat

import gtsam
import numpy as np
from numpy.typing import ArrayLike, NDArray

from factors.noise import isotropic_models


def standing_factors(
    before_keys: ArrayLike, after_keys: ArrayLike, dt_s: ArrayLike, density: ArrayLike
) -> list[gtsam.NoiseModelFactor]:
    """One factor for each of D steps, from the joint position `before_keys` (D,) to `after_keys`
    (D,), `dt_s` (D,) seconds later.

    `density` is q (D,), m²/s. ValueError for shapes that disagree, or if a time or a density is not
    positive and finite.
    """
    before, after = np.asarray(before_keys), np.asarray(after_keys)
    dt, q = (np.asarray(values, dtype=np.float64) for values in (dt_s, density))
    if not before.shape == after.shape == dt.shape == q.shape == (len(before),):
        raise ValueError(
            "before_keys, after_keys, dt_s and density must be (D,), got"
            f" {before.shape}, {after.shape}, {dt.shape}, {q.shape}"
        )
    if not (_positive(dt) and _positive(q)):
        raise ValueError("dt_s and density must be positive and finite: leave out empty steps")
    models = isotropic_models(3, np.sqrt(q * dt))
    return list(
        map(gtsam.BetweenFactorPoint3, before.tolist(), after.tolist(), repeat(np.zeros(3)), models)
    )


def _positive(values: NDArray[np.float64]) -> bool:
    return bool(np.all((values > 0) & np.isfinite(values)))
