"""Detections associated again, one by one, with people who are placed: what 2D grouping mixed is put right."""

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.camera import Rig
from shapepose_fg.core.detections import Detections
from shapepose_fg.proposal.assignment import match_best_first

Array = NDArray[np.float64]


def nearest_given(
    found: Detections, joints: Array, held: NDArray[np.intp], rig: Rig, gate_m: float
) -> NDArray[np.intp]:
    """Which detection each view has of each joint (P, J, V), -1 for none: the nearest, one-to-one.

    A detection goes to a joint (P, J, 3) that is projected within `gate_m` of it, at the joint's depth. Joints
    that are not placed keep what they `held` (P, J, V), where no other joint has it now.
    """
    projected, depth = rig.project(joints)  # (V, P, J, 2), (V, P, J)
    placed = np.asarray(np.isfinite(joints).all(axis=-1))
    here = projected[found.view, :, found.joint] if len(joints) > 0 else np.zeros((len(found), 0, 2))
    metres = depth[found.view, :, found.joint] / rig.focal_px[found.view, None]
    distance = np.linalg.norm(here - found.xy[:, None], axis=-1) * metres  # (D, P)
    detection, person = np.nonzero(distance < gate_m)
    # One-to-one in each view and joint: a person is another one in each.
    V, J = len(rig), joints.shape[1]
    slot = (person * J + found.joint[detection]) * V + found.view[detection]
    picked = match_best_first(slot, detection, -distance[detection, person])
    given = np.where(placed[..., None], -1, held).ravel()
    given[np.isin(given, detection[picked])] = -1
    given[slot[picked]] = detection[picked]
    return given.reshape(held.shape)


def grown(found: Detections, joints: Array, held: NDArray[np.intp]) -> NDArray[np.intp]:
    """What each view has of joints that are not placed, chosen anew by affinity to what the person holds there.

    Along one limb at a time, until nothing changes; best affinities first, each detection to one person.
    """
    P, J, V = held.shape
    placed = np.asarray(np.isfinite(joints).all(axis=-1))
    held = np.where(placed[..., None], held, -1)
    both = np.concatenate([found.pairs, found.pairs[:, ::-1]])
    affinity = np.concatenate([found.affinity, found.affinity])
    while True:
        owner = np.full(len(found) + 1, -1)
        owner[held.ravel()] = np.repeat(np.arange(P), J * V)
        owner = owner[:-1]
        person, free = owner[both[:, 0]], both[:, 1]
        slot = (person * J + found.joint[free]) * V + found.view[free]
        usable = (person >= 0) & (owner[free] < 0)
        usable[usable] = held.ravel()[slot[usable]] < 0
        usable[usable] &= ~placed[person[usable], found.joint[free[usable]]]
        if not usable.any():
            return held
        picked = np.flatnonzero(usable)[match_best_first(slot[usable], free[usable], affinity[usable])]
        held = held.ravel()
        held[slot[picked]] = free[picked]
        held = held.reshape(P, J, V)
