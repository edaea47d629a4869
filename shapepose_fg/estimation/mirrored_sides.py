"""Uncertainty of joints because left and right of a person may be exchanged."""

from collections.abc import Sequence

import numpy as np

from shapepose_fg.core.arrays import Array
from shapepose_fg.core.joint_names import mirrored as mirror_of

DOUBTED = 0.05
"""Median probability of swapped sides above which a row is not `Status.OK`: its 95 % regions would
be wrong."""


def mirrored_spread(joints: Array, mirrored: Array, names: Sequence[str]) -> Array:
    """(N, J, 3, 3) outer products of displacements from joints (N, J, 3) to those of the other
    side, m².

    Weighted by the probability of exchanged sides, `mirrored` (N, J, V) of the row's observations.
    """
    other = [
        names.index(mirror_of(name)) if mirror_of(name) in names else n
        for n, name in enumerate(names)
    ]
    doubt = mirrored.max(axis=2, initial=0.0)
    doubt = np.maximum(doubt, doubt[:, other])
    displacement = np.nan_to_num(joints[:, other] - joints) * np.sqrt(doubt)[..., None]
    return displacement[..., None] * displacement[..., None, :]
