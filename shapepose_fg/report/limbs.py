"""Bodies as bones with a width, which a page can draw without a mesh."""

import numpy as np

from shapepose_fg.body.model.smpl_file import SMPL_PARENTS
from shapepose_fg.export.skinned import BONES, LEAVES, RestBody

STARTS = (*SMPL_PARENTS, *LEAVES)
"""(29,) where the bone to each of the 24 joints and five tips begins; -1 for the pelvis, to which none leads."""
ENDS = len(STARTS)
"""How many joints and tips that is."""
_THIN_M = 0.03
"""Width of a bone without skin of its own beside it."""


def widths(rest: RestBody) -> list[float]:
    """(29,) width of the bone to each joint and tip: the median distance of its skin from it, metres."""
    bone_of = rest.arrays.weights.argmax(axis=1)
    ends = np.concatenate([rest.joints, np.stack([rest.joints[leaf] + rest.tips()[leaf] for leaf in LEAVES])])
    found = [0.0]
    for end in range(1, ENDS):
        start = ends[STARTS[end]]
        along = ends[end] - start
        skin = rest.vertices[bone_of == STARTS[end]] - start
        share = skin @ along / max(float(along @ along), 1e-9)
        beside = (share > 0) & (share < 1)
        away = np.linalg.norm(skin[beside] - share[beside, None] * along, axis=1)
        found.append(float(np.median(away)) if len(away) > 0 else _THIN_M)
    return found
