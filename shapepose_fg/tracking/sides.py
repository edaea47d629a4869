"""The side of the body that a detector confuses for a while in some views, held by those who are followed.

Seen from behind, people get their left joints called right and the right ones left, for seconds, and in several
views at once. But nobody turns round between two frames: where a 2D person fits a predicted one only with the
sides exchanged, they are exchanged back, as long as another view has that person with the sides as they are.
"""

from dataclasses import replace

import numpy as np

from shapepose_fg.core.arrays import Array
from shapepose_fg.core.camera import Rig
from shapepose_fg.core.detections import Detections
from shapepose_fg.core.skeleton import Skeleton
from shapepose_fg.proposal.people_2d import group_people

_NEAR_M = 0.05
"""Standard deviation of a detection from where an exactly predicted joint is, as a length at its depth."""
_FARTHEST = 9.0
"""Squared distance in variances at which a detection speaks no more against a place."""
_FITS = 3.0
"""Mean squared distance in variances up to which a 2D person is that of a predicted one."""
_SURE = 6.0
"""Log-likelihood ratio from which on sides are exchanged, or are as they should be."""


def with_sides_held(found: Detections, places: Array, sigma_m: Array, rig: Rig, skeleton: Skeleton) -> Detections:
    """The detections of a frame, left and right exchanged where a view has a person's sides the wrong way round.

    `places` (A, J, 3), metres, are where the joints of A people are predicted, to `sigma_m` (A, J).
    """
    mirror = np.array(skeleton.mirror)
    groups = [group for group in group_people(found) if len(group) >= len(skeleton.core) // 2]
    if len(groups) == 0 or len(places) == 0:
        return found
    xy, depth = rig.project(places)  # (V, A, J, 2), (V, A, J)
    unit_px = rig.focal_px[:, None, None] / np.maximum(depth, 0.2) * np.hypot(_NEAR_M, sigma_m)
    who, gain = np.full(len(groups), -1), np.zeros(len(groups))
    for number, group in enumerate(groups):
        view, joint = found.view[group[0]], found.joint[group]
        apart = [
            np.square((xy[view][:, each] - found.xy[group]) / unit_px[view][:, each, None]).sum(axis=-1)
            for each in (joint, mirror[joint])
        ]
        same, turned = np.minimum(np.nan_to_num(apart, nan=_FARTHEST), _FARTHEST)
        best = int(np.minimum(same.mean(axis=1), turned.mean(axis=1)).argmin())
        if min(same[best].mean(), turned[best].mean()) < _FITS:
            who[number], gain[number] = best, (same - turned)[best].sum() / 2
    wrong = np.zeros(len(found), dtype=bool)
    for number in np.flatnonzero(gain > _SURE).tolist():
        wrong[groups[number]] = (gain[who == who[number]] < -_SURE).any()
    if not wrong.any():
        return found
    whole = wrong[found.pairs[:, 0]] == wrong[found.pairs[:, 1]]
    joint = np.where(wrong, mirror[found.joint], found.joint)
    return replace(found, joint=joint, pairs=found.pairs[whole], affinity=found.affinity[whole])
