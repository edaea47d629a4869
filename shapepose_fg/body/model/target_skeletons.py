"""The list of all points of a body, and skeletons as subsets of it."""

from shapepose_fg.core.joint_names import mirrored
from shapepose_fg.core.skeleton import BODY_25, COCO_17, HALPE_26, SMPL_24

HEAD_TOP = "Head"
"""Name of HALPE's top of the head."""

BODY_POINTS: tuple[str, ...] = (*BODY_25.joints, HEAD_TOP, *SMPL_24)
"""(K,) all points to which a body can be fitted: BODY_25's, HALPE's top of the head, SMPL's own
joints."""

TARGET_SKELETONS: dict[str, tuple[str, ...]] = {
    "BODY_25": BODY_25.joints,
    "COCO_17": COCO_17.joints[:17],
    "HALPE_26": HALPE_26.joints,
    "SMPL_24": SMPL_24,
}
"""Names of the joints of each skeleton, in its own order; a subset of `BODY_POINTS`."""

MIRROR: tuple[int, ...] = tuple(BODY_POINTS.index(mirrored(name)) for name in BODY_POINTS)
"""(K,) index of the mirrored point; of itself for central points."""


def slots(names: tuple[str, ...]) -> tuple[int, ...]:
    """Indices of points in `BODY_POINTS`; raises ValueError naming unknown ones."""
    unknown = [name for name in names if name not in BODY_POINTS]
    if unknown:
        raise ValueError(f"a body has no {' '.join(unknown)}; it has {' '.join(BODY_POINTS)}")
    return tuple(BODY_POINTS.index(name) for name in names)
