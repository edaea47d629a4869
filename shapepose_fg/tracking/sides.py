"""The side of the body that a detector confuses for a while in some views, held by those who are followed.

Seen from behind, people get their left joints called right and the right ones left, for seconds, and in several
views at once. But nobody turns round between two frames: where a 2D person fits a predicted one only with the
sides exchanged, they are exchanged back, as long as another view has that person with the sides as they are.
"""

from dataclasses import replace
from functools import cache

import numpy as np

from shapepose_fg.core.arrays import Array, Index
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

    That may be the whole person, or arms, legs or face only.
    `places` (A, J, 3), metres, are where the joints of A people are predicted, to `sigma_m` (A, J).
    """
    mirror, part = np.array(skeleton.mirror), paired_parts(skeleton)
    groups = [group for group in group_people(found) if len(group) >= len(skeleton.core) // 2]
    if len(groups) == 0 or len(places) == 0:
        return found
    xy, depth = rig.project(places)  # (V, A, J, 2), (V, A, J)
    unit_px = rig.focal_px[:, None, None] / np.maximum(depth, 0.2) * np.hypot(_NEAR_M, sigma_m)
    who, gain = np.full(len(groups), -1), np.zeros((len(groups), part.max() + 1))
    for number, group in enumerate(groups):
        view, joint = found.view[group[0]], found.joint[group]
        apart = [
            np.square((xy[view][:, each] - found.xy[group]) / unit_px[view][:, each, None]).sum(axis=-1)
            for each in (joint, mirror[joint])
        ]
        of_part = np.eye(gain.shape[1])[part[joint]]
        same, turned = np.minimum(np.nan_to_num(apart, nan=_FARTHEST), _FARTHEST) @ of_part  # (A, parts)
        apart_of = np.minimum(same, turned).sum(axis=1) / len(group)
        best = int(apart_of.argmin())
        if apart_of[best] < _FITS:
            who[number], gain[number] = best, (same - turned)[best] / 2
    # The middle takes no side: its column is the whole person, where no part speaks against it.
    gain[:, 0] = np.where((gain > -_SURE).all(axis=1) | (gain < _SURE).all(axis=1), gain.sum(axis=1), 0.0)
    wrong = np.zeros(len(found), dtype=bool)
    for number, of in np.argwhere(gain > _SURE).tolist():
        if (gain[who == who[number], of] < -_SURE).any():
            wrong[groups[number]] |= (part[found.joint[groups[number]]] == of) | (of == 0)
    if not wrong.any():
        return found
    first, second = found.pairs.T
    middle = mirror[found.joint] == found.joint
    whole = (wrong[first] == wrong[second]) | middle[first] | middle[second]
    joint = np.where(wrong, mirror[found.joint], found.joint)
    return replace(found, joint=joint, pairs=found.pairs[whole], affinity=found.affinity[whole])


@cache
def paired_parts(skeleton: Skeleton) -> Index:
    """(J,) number of the part (arms, legs, face) that each joint belongs to; 0 for joints in the middle."""
    top = np.arange(len(skeleton))
    for level in skeleton.tree_levels[1:]:
        for j in level.tolist():
            above = skeleton.parents[j]
            if skeleton.mirror[above] != above:
                top[j] = top[above]
    mirror = np.array(skeleton.mirror)
    pair = np.where(mirror == np.arange(len(mirror)), -1, np.minimum(top, mirror[top]))
    return np.unique(np.append(-1, pair), return_inverse=True)[1][1:]
