"""Which joints a line joins where people are drawn."""

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.skeleton import BODY_25


def bones_of(joint_names: tuple[str, ...]) -> NDArray[np.intp]:
    """(B, 2) joints that a line joins: each of BODY_25 and the nearest joint towards the hip that is there."""
    parents = {
        name: BODY_25.joints[parent]
        for name, parent in zip(BODY_25.joints, BODY_25.parents, strict=True)
        if parent >= 0
    }
    parents["Head"] = "Neck"
    pairs = []
    for place, name in enumerate(joint_names):
        parent = parents.get(name)
        while parent is not None and parent not in joint_names:
            parent = parents.get(parent)
        if parent is not None:
            pairs.append((joint_names.index(parent), place))
    return np.array(pairs, dtype=np.intp).reshape(-1, 2)
