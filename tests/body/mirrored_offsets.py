"""Detectors with joints of their own, alike on both sides."""

import numpy as np

from shapepose_fg.body.model.keypoint_offsets import RIDES_ON, KeypointOffsets
from shapepose_fg.core.skeleton import BODY_25


def symmetric(metres: dict[str, tuple[float, float, float]]) -> KeypointOffsets:
    """Offsets by joint name, (x, y, z) metres; the mirror joint gets the mirrored offset."""
    xyz = np.zeros((25, 3))
    for name, offset in metres.items():
        joint = BODY_25.index(name)
        xyz[BODY_25.mirror[joint]] = np.array(offset) * (-1.0, 1.0, 1.0)
        xyz[joint] = offset
    return KeypointOffsets(xyz, np.zeros(25), np.zeros(25, dtype=np.intp), RIDES_ON)
