"""A sample's tables, frame by frame: joints expected in a view, candidates, their pairs, joints behind others."""

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.camera import Rig
from shapepose_fg.core.detections import Detections
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.simulation.measurement.people import People

STRANGER_JOINTS = 5
"""Unowned candidates that affinities join in groups of so many are people whom nobody reconstructed."""
STRANGER_PX = 150
"""Single candidates in the background that are this near to such people are theirs."""
NEAR_M = 0.5
"""A false candidate this near to some joint of a person has to do with the person."""
LIMBS = np.array(BODY_25.limbs)
MIRROR = np.array(BODY_25.mirror)


def expected_table(number: int, part: tuple, found: Detections, rig: Rig, people: People) -> dict[str, NDArray]:
    """`Sample.expected` of a view of frame `number`; `part` is what `take_sample` knows of that view."""
    view, rows, mine, hit, offset, _, at, scale, known, spread_m = part
    size = rig.image_sizes[view]
    margin = 0.05 / scale[..., None]
    inside = ((at > margin) & (at < size - 1 - margin)).all(axis=-1)
    person, joint = np.nonzero(known & inside)
    which = hit[person, joint]
    found_it = which >= 0
    residual = np.full((len(which), 2), np.nan)
    residual[found_it] = offset[person[found_it], which[found_it]]
    confidence = np.full(len(which), np.nan)
    confidence[found_it] = found.confidence[mine[which[found_it]]]
    mirror = MIRROR[joint]
    apart = np.linalg.norm(at[person, joint] - at[person, mirror], axis=-1) * scale[person, joint]
    row = rows[person]
    # The candidates of the mirrored joint that lie where this joint is, nearer than to its own place.
    swapped = np.zeros(len(which), dtype=bool)
    double_m, double_confidence = np.full((2, len(which)), np.nan)
    labels = found.joint[mine]
    for index in np.flatnonzero((mirror != joint) & (apart > 0.12)):
        p, j, m = person[index], joint[index], mirror[index]
        other = mine[labels == m]
        gap = np.linalg.norm(found.xy[other] - at[p, j], axis=-1) * scale[p, j]
        home = np.linalg.norm(found.xy[other] - at[p, m], axis=-1) * scale[p, j]
        there = (gap < 0.06) & (gap < 0.4 * home)
        swapped[index] = bool(there.any())
        if there.any() and found_it[index]:
            twice = other[there][gap[there].argmin()]
            own = found.xy[mine[which[index]]]
            double_m[index] = np.linalg.norm(found.xy[twice] - own) * scale[p, j]
            double_confidence[index] = found.confidence[twice]
    behind = (people.visibility.hidden_by[view] >= 0) & (people.visibility.seen[view] < 0.5)
    return {
        "frame": np.full(len(which), number),
        "person": row,
        "track": people.track[row],
        "view": np.full(len(which), view),
        "joint": joint,
        "seen": people.visibility.seen[view, row, joint],
        "hidden_by": people.visibility.hidden_by[view, row, joint],
        "buried": behind.mean(axis=-1)[row],
        "hit": found_it,
        "residual_m": residual,
        "spread_m": spread_m[person, joint],
        "confidence": confidence,
        "mirror_m": np.where(mirror != joint, apart, np.nan),
        "swapped": swapped,
        "double_m": double_m,
        "double_confidence": double_confidence,
        "px_a_metre": 1.0 / scale[person, joint],
    }


def candidate_table(number: int, part: tuple, found: Detections, owner: NDArray) -> dict[str, NDArray]:
    """`Sample.candidates` of a view of frame `number`; `owner` (D,) is the row of each detection, or -1."""
    view, rows, mine, _, _, distance, at, scale, _, _ = part
    joint = found.joint[mine]
    group = _group_sizes(found, owner)
    nobody = np.full(len(mine), np.inf)
    if len(rows) == 0:
        nearest = mirrored = any_joint = nobody
    else:
        nearest = distance.min(axis=0, initial=np.inf)
        offset = np.linalg.norm(found.xy[mine][None] - at[:, MIRROR[joint]], axis=-1) * scale[:, joint]
        mirrored = np.nan_to_num(offset, nan=np.inf).min(axis=0)
        every = np.linalg.norm(found.xy[mine][None, :, None] - at[:, None], axis=-1) * scale[:, None]
        any_joint = np.nan_to_num(every, nan=np.inf).min(axis=(0, 2))
    return {
        "frame": np.full(len(mine), number),
        "view": np.full(len(mine), view),
        "joint": joint,
        "confidence": found.confidence[mine],
        "xy": found.xy[mine],
        "owner": owner[mine],
        "nearest_m": nearest,
        "mirrored_m": mirrored,
        "any_joint_m": any_joint,
        "stranger": _stranger(found.xy[mine], group[mine], any_joint),
    }


def _stranger(xy: NDArray, group: NDArray, any_joint_m: NDArray) -> NDArray[np.bool_]:
    """(D,) which candidates of a view belong to people whom nobody reconstructed, or lie among theirs.

    Far from everybody two that are joined will do: a limb in the background is somebody's.
    """
    far = (group > 0) & (any_joint_m > NEAR_M)
    stranger = (group >= STRANGER_JOINTS) | (far & (group >= 2))
    if not stranger.any():
        return stranger
    gap_px = np.linalg.norm(xy[:, None] - xy[stranger], axis=-1).min(axis=1)
    return stranger | (far & (gap_px < STRANGER_PX))


def _group_sizes(found: Detections, owner: NDArray) -> NDArray[np.intp]:
    """(D,) with how many others, itself included, an unowned candidate hangs together by affinities; owned: 0."""
    label = np.arange(len(found))
    first, second = found.pairs.T
    strong = (owner[first] < 0) & (owner[second] < 0) & (found.affinity > 0.3)
    first, second = first[strong], second[strong]
    for _ in range(25):
        low = np.minimum(label[first], label[second])
        np.minimum.at(label, first, low)
        np.minimum.at(label, second, low)
    return np.where(owner < 0, np.bincount(label, minlength=len(label))[label], 0)


def pair_table(found: Detections, owner: NDArray, rows: NDArray, full_xy: NDArray) -> dict[str, NDArray]:
    """`Sample.pairs` of a frame: `rows` are its people, `full_xy` (V, N, J, 2) their joints in all views."""
    joined = np.full((25, 25), -1)
    joined[LIMBS[:, 0], LIMBS[:, 1]] = np.arange(len(LIMBS))
    limb = np.where(found.view[:, None] == found.view, joined[found.joint[:, None], found.joint], -1)
    a, b = np.nonzero(limb >= 0)
    score = np.zeros((len(found), len(found)))
    score[tuple(found.pairs.T)] = found.affinity
    strangers = _group_sizes(found, owner) >= STRANGER_JOINTS
    known = ((owner[a] >= 0) | (owner[b] >= 0)) & ~strangers[a] & ~strangers[b]
    a, b = a[known], b[known]
    if len(rows) == 0:
        a, b = a[:0], b[:0]
    view, first, second = found.view[a], found.joint[a], found.joint[b]
    expected_b = full_xy[view, owner[a], second]
    expected_a = full_xy[view, owner[b], first]
    length = np.linalg.norm(expected_b - full_xy[view, owner[a], first], axis=-1)
    length_b = np.linalg.norm(expected_a - full_xy[view, owner[b], second], axis=-1)
    by_a = np.linalg.norm(found.xy[b] - expected_b, axis=-1) / np.maximum(length, 8.0)
    by_b = np.linalg.norm(found.xy[a] - expected_a, axis=-1) / np.maximum(length_b, 8.0)
    detour = np.fmin(np.where(owner[a] >= 0, by_a, np.nan), np.where(owner[b] >= 0, by_b, np.nan))
    return {
        "right": owner[a] == owner[b],
        "nobody": (owner[a] < 0) | (owner[b] < 0),
        "limb": limb[a, b],
        "affinity": score[a, b],
        "confidence": np.minimum(found.confidence[a], found.confidence[b]),
        "detour": np.nan_to_num(detour, nan=99.0),
        "length_px": np.linalg.norm(found.xy[a] - found.xy[b], axis=-1),
    }


def captured_table(
    found: Detections, owner: NDArray, rows: NDArray, people: People, full_xy: NDArray, depth: NDArray, rig: Rig
) -> dict[str, NDArray]:
    """Hidden joints without a candidate of their own: does a neighbour's affinity reach the front person's?"""
    adjacency = BODY_25.adjacency.astype(bool)
    at = np.full((len(rig), int(rows.max(initial=0)) + 1, 25), -1)
    mine = np.flatnonzero(owner >= 0)
    at[found.view[mine], owner[mine], found.joint[mine]] = mine
    score = np.zeros((len(found) + 1, len(found) + 1))
    first, second = found.pairs.T
    score[first, second] = score[second, first] = found.affinity
    taken, gap_m = [], []
    hidden = people.visibility.hidden_by[:, rows]
    for view, p, joint in np.argwhere((hidden >= 0) & (people.visibility.seen[:, rows] < 0.5)):
        row, front = rows[p], hidden[view, p, joint]
        if at[view, row, joint] >= 0 or at[view, front, joint] < 0:
            continue
        neighbours = at[view, row, adjacency[joint]]
        if (neighbours < 0).all():
            continue
        taken.append(score[neighbours[neighbours >= 0], at[view, front, joint]].max() > 0.3)
        gap = np.linalg.norm(full_xy[view, row, joint] - full_xy[view, front, joint])
        gap_m.append(gap * depth[view, row, joint] / rig.focal_px[view])
    return {"taken": np.array(taken, dtype=bool), "gap_m": np.array(gap_m, dtype=float)}
