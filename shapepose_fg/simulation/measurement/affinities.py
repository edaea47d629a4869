"""Part affinities of pairs that belong together, and of pairs that do not."""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from shapepose_fg.simulation.measurement.classes import LEVELS, rounded
from shapepose_fg.simulation.measurement.sample_tables import LIMBS, MIRROR

DETOURS = np.array([0.0, 0.25, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0, 5.0])
"""Lower edges of the classes of wrong pairs, in limb lengths."""
_LIMB_NAMES = [min(tuple(limb), tuple(MIRROR[limb].tolist())) for limb in LIMBS.tolist()]
LIMB_GROUP = np.array([sorted(set(_LIMB_NAMES)).index(name) for name in _LIMB_NAMES])
"""(26,) the same for limbs: 14."""


def affinity_tables(pairs: dict[str, NDArray]) -> dict[str, Any]:
    """Right pairs by limb, with the lower confidence; wrong ones by how far the wrong end is off."""
    limb_group, right = LIMB_GROUP[pairs["limb"]], pairs["right"]
    count = LIMB_GROUP.max() + 1
    affinity = np.stack([np.quantile(pairs["affinity"][right & (limb_group == g)], LEVELS) for g in range(count)])
    confidence = np.stack(
        [np.quantile(pairs["confidence"][right & (limb_group == g)], LEVELS) for g in range(count)]
    )
    scores = []
    for g in range(count):
        those = np.flatnonzero(right & (limb_group == g))
        rank = [np.argsort(np.argsort(pairs[name][those])) for name in ("affinity", "confidence")]
        scores.append(ndtri((np.array(rank) + 0.5) / len(those)))
    scores = np.concatenate(scores, axis=1)
    wrong = ~right & ~pairs["nobody"]
    which = np.searchsorted(DETOURS, pairs["detour"], side="right") - 1
    listed = pairs["affinity"] > 0
    result = {
        "limbs": [list(map(int, LIMBS[g == LIMB_GROUP][0])) for g in range(count)],
        "right": rounded(affinity),
        "right_confidence": rounded(confidence),
        "correlation": round(float(np.corrcoef(scores)[0, 1]), 3),
        "detours": DETOURS.tolist(),
    }
    for name, those in (("wrong", wrong), ("nobody", pairs["nobody"])):
        share, quantiles = [], []
        for b in range(len(DETOURS)):
            here = those & (which == b)
            share.append(float(listed[here].mean()) if here.any() else 0.0)
            values = pairs["affinity"][here & listed]
            values = values if len(values) >= 8 else pairs["affinity"][those & listed]
            quantiles.append(np.quantile(values, LEVELS))
        result[f"{name}_share"], result[name] = rounded(np.array(share), 4), rounded(np.array(quantiles))
    return result
