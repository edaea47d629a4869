"""Which way a face looks: nose, eyes and ears are not found from behind, whatever the depth buffer says."""

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.skeleton import BODY_25

FACE = tuple(BODY_25.index(name) for name in ("Nose", "REye", "LEye", "REar", "LEar"))
_EARS = [BODY_25.index("REar"), BODY_25.index("LEar")]


def facing(joints: NDArray[np.float64], centres: NDArray[np.float64]) -> NDArray[np.float64]:
    """Cosine (V, P, 5) between a face joint's way out of the head and the way to the camera: 1 seen frontally.

    `joints` (P, 25, 3) BODY_25, `centres` (V, 3) of the cameras; the head's middle is that of the ears.
    """
    face = joints[:, FACE]
    outward = face - joints[:, _EARS].mean(axis=1, keepdims=True)
    to_camera = centres[:, None, None] - face
    length = np.linalg.norm(outward, axis=-1) * np.linalg.norm(to_camera, axis=-1)
    return (outward * to_camera).sum(axis=-1) / np.maximum(length, 1e-9)


def seen_from_the_front(
    seen: NDArray[np.float64], joints: NDArray[np.float64], centres: NDArray[np.float64], ramp: NDArray[np.float64]
) -> NDArray[np.float64]:
    """`seen` (V, P, 25) with the face joints' share times how far they face the camera.

    `ramp` (5, 2) holds the cosines at which a face joint is wholly lost and wholly there.
    """
    low, high = np.asarray(ramp).T
    share = np.clip((facing(joints, centres) - low) / (high - low), 0.0, 1.0)
    result = np.array(seen)
    result[..., FACE] *= share
    return result
