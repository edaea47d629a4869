"""Joints in plain view without detections: evidence that they are not where the body has them."""

from collections.abc import Sequence

import numpy as np

from shapepose_fg.core.arrays import Array, Index, Mask, Whole
from shapepose_fg.core.camera import Views, beside_segment

LEAST_VIEWS = 3
"""Minimum number of views with the joint in plain view but no detection; fewer often miss it by
chance."""
MISSED = 0.2
"""Share of joints in plain view with a missing or weak detection, in simulated crowds. One, two,
three, four views miss 0.18, 0.046, 0.010 and 0.003 of them simultaneously, as if independent."""
UNUSUAL = 3e-4
"""Prior probability that a detector misses a joint in plain view because the pose is unusual: an
assumption, since the simulated detector knows all poses. With it, a joint's standard deviation
grows by 5 cm if three views miss it, and by 10 cm if four do."""
ELSEWHERE_M = 0.25
"""Standard deviation per axis , metres, of a joint in an unusual pose (`UNUSUAL`) from the body's:
within reach of its neighbour. Also an assumption: in simulated crowds with three and four cameras
and a detector that knows every pose, the log score gives this no weight; the evidence is a
stretched arm on real footage."""
_BEHIND_M = 0.05
"""Minimum depth behind a limb for occlusion, m."""
ARMS_AND_LEGS = {
    ("Shoulder", "Elbow"): 0.06, ("Elbow", "Wrist"): 0.05, ("Hip", "Knee"): 0.09,
    ("Knee", "Ankle"): 0.07,
}  # fmt: skip
"""Limbs on either side, from the trunk outwards, and half their widths, metres."""
_TRUNK = {
    ("Neck", "MidHip"): 0.17,
    ("Neck", "Nose"): 0.11,
    ("RShoulder", "RHip"): 0.1,
    ("LShoulder", "LHip"): 0.1,
}
"""Occluders other than arms and legs: from joint to joint, with half their width in metres."""


def limbs_that_hide(joints: Sequence[str]) -> tuple[Index, Array]:
    """(L, 2) ends of occluding limbs among a detector's joints, and (L,) half their
    widths, metres.
    """
    limbs = _TRUNK | {
        (f"{s}{a}", f"{s}{b}"): width for s in "RL" for (a, b), width in ARMS_AND_LEGS.items()
    }
    present = [
        (joints.index(a), joints.index(b), w)
        for (a, b), w in limbs.items()
        if {a, b} <= set(joints)
    ]
    table = np.array(present).reshape(-1, 3)
    return table[:, :2].astype(np.intp), table[:, 2]


def elsewhere_variance(
    joints: Array, frame: Whole, strong: Mask, views: Views, limbs: tuple[Index, Array]
) -> Array:
    """(N, J) variance, m², added on every axis to joints that views should detect but do not.

    For `joints` (N, J, 3) in the `frame` (N,) without any strong detection, `strong` (N, J, V): if
    m views have the joint in plain view, not behind any limb, either all have missed it, with
    probability `MISSED` to the power of m, or it is elsewhere.
    """
    xy, depth = views.pixels(joints)
    inside = (depth > 0) & ((xy >= 0) & (xy < views.image_sizes)).all(axis=-1) & ~strong
    row, joint = np.nonzero(~strong.any(axis=-1) & (inside.sum(axis=-1) >= LEAST_VIEWS))
    focal = np.broadcast_to(views.focal_px, (len(joints), depth.shape[2]))
    missed = np.zeros(joints.shape[:2])
    for number in np.unique(frame[row]).tolist():
        in_frame, of_frame = frame[row] == number, np.flatnonzero(frame == number)
        hidden = _behind_limbs(
            (xy, depth), (row[in_frame], joint[in_frame]), of_frame, focal[row[in_frame]], limbs
        )
        missed[row[in_frame], joint[in_frame]] = (
            inside[row[in_frame], joint[in_frame]] & ~hidden
        ).sum(axis=-1)
    unusual = UNUSUAL / (UNUSUAL + MISSED**missed)
    return np.where(missed >= LEAST_VIEWS, unusual * ELSEWHERE_M**2, 0.0)


def _behind_limbs(
    projected: tuple[Array, Array],
    places: tuple[Index, Index],
    people: Index,
    focal_px: Array,
    limbs: tuple[Index, Array],
) -> Mask:
    """(K, V) whether joints at rows and columns `places` (K,) are behind a limb of any of the
    `people` (P,), themselves included; `projected` pixels and depths of all, `focal_px` (K, V).
    """
    (xy, depth), (row, joint), (ends, radius) = projected, places, limbs
    coordinates = xy[..., 0], xy[..., 1], depth
    first, second = ([each[people][:, end] for each in coordinates] for end in ends.T)  # (P, L, V)
    x, y, deep = (each[row, joint][:, None, None] for each in coordinates)  # (K, 1, 1, V)
    squared, ahead = beside_segment(x, y, first, second)
    hides = (squared * ahead**2 < (radius[:, None] * focal_px[:, None, None]) ** 2) & (ahead > 0)
    hides &= ahead < deep - _BEHIND_M
    own = (people == row[:, None])[..., None] & (ends == joint[:, None, None]).any(axis=-1)[
        :, None
    ]  # (K, P, L)
    return (hides & ~own[..., None]).any(axis=(1, 2))
