"""Who is who in different views: geometric affinity between 2D people, and matches that agree over all views.

After Dong et al. 2019 (CVPR), "Fast and Robust Multi-Person 3D Pose Estimation from Multiple Views", without the
appearance: section 3.1 (affinity from epipolar distances) and 3.2 (cycle consistency as low rank, by ADMM).
"""

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.camera import Rig
from shapepose_fg.evaluation.baseline.people_2d import People2D

Array = NDArray[np.float64]

_FAR_M = 0.5
"""Rays that miss each other by more are equally wrong: one joint of another person must not decide."""
_MIN_SHARED = 3
"""Two who have fewer joints in common cannot be compared."""
_MIN_SINE = np.sin(np.deg2rad(3.0))
"""Rays at a smaller angle meet anywhere."""


def geometric_affinity(people: People2D, rig: Rig, largest_m: float) -> Array:
    """(S, S) 1 where the rays to two people's joints meet, 0 where they miss by `largest_m` in the mean.

    The distance between two rays is the epipolar distance as a length at the joint. 0 within a view, and for two
    with fewer than three joints in common.
    """
    S, J = people.confidence.shape
    rays, centre = people.rays(rig), rig.centres[people.view]
    between = centre[None] - centre[:, None]
    total, weights, count = np.zeros((S, S)), np.zeros((S, S)), np.zeros((S, S))
    for joint in range(J):
        direction = rays[:, joint]
        normal = np.cross(direction[:, None], direction[None])
        sine = np.linalg.norm(normal, axis=2)
        gap = np.abs(np.einsum("abi,abi->ab", normal, between)) / np.maximum(sine, _MIN_SINE)
        # Where the rays are nearest: in front of both cameras?
        sine2 = np.maximum(sine, _MIN_SINE) ** 2
        along = np.einsum("abi,abi->ab", np.cross(between, direction[None]), normal) / sine2
        other = np.einsum("abi,abi->ab", np.cross(between, direction[:, None]), normal) / sine2
        gap = np.where((along > 0) & (other > 0), np.minimum(gap, _FAR_M), _FAR_M)
        weight = np.sqrt(np.outer(people.confidence[:, joint], people.confidence[:, joint])) * (sine > _MIN_SINE)
        total += weight * gap
        weights += weight
        count += weight > 0
    distance = total / np.maximum(weights, 1e-9)
    affinity = np.maximum(0.0, 1.0 - distance / largest_m)
    apart = people.view[:, None] != people.view[None]
    return np.where(apart & (count >= _MIN_SHARED), affinity, 0.0)


def consistent_matches(affinity: Array, view: NDArray[np.intp], *, rank_weight: float, steps: int = 100) -> Array:
    """(S, S) how far two are one person, 0 to 1, so that matches agree over all views.

    Minimises -<A, P> + `rank_weight` |P|_* over symmetric P between 0 and 1 whose rows add up to 1 at most in each
    view, by ADMM (Dong et al. 2019, section 3.2): the nuclear norm stands in for the rank, which is the number of
    people where matches agree.
    """
    S = len(affinity)
    same = view[:, None] == view[None]
    P = affinity.copy()
    dual, penalty = np.zeros((S, S)), 4.0
    of_view = [np.flatnonzero(view == each) for each in np.unique(view)]
    for _ in range(steps):
        left, values, right = np.linalg.svd(P + dual / penalty)
        Q = (left * np.maximum(values - rank_weight / penalty, 0.0)) @ right
        before, P = P, _permitted(Q - (dual - affinity) / penalty, same, of_view)
        dual += penalty * (P - Q)
        primal, change = np.linalg.norm(P - Q) / S, penalty * np.linalg.norm(P - before) / S
        if primal < 5e-4 and change < 5e-4:
            break
        # Balanced as in Boyd et al. 2011, section 3.4.1.
        if primal > 10 * change:
            penalty *= 2
        elif change > 10 * primal:
            penalty /= 2
    return P


def _permitted(P: Array, same: NDArray[np.bool_], of_view: list[NDArray[np.intp]]) -> Array:
    """The projection onto matrices with 1 for oneself, 0 for others of the view, and rows of at most 1 a view.

    By alternating projections (Dykstra would be exact): the error is gone by the next step of ADMM.
    """
    P = (P + P.T) / 2
    P = np.where(same, 0.0, np.clip(P, 0.0, 1.0))
    for _ in range(5):
        for columns in of_view:
            P[:, columns] = _at_most_one(P[:, columns])
        P = (P + P.T) / 2
    np.fill_diagonal(P, 1.0)
    return P


def _at_most_one(rows: Array) -> Array:
    """Each row (S, K) projected onto what is not negative and adds up to 1 at most."""
    over = np.maximum(rows, 0.0).sum(axis=1) > 1.0
    result = np.maximum(rows, 0.0)
    if not over.any():
        return result
    # Onto the simplex: Held et al. 1974, by sorting.
    sorted_ = -np.sort(-rows[over], axis=1)
    excess = (np.cumsum(sorted_, axis=1) - 1.0) / np.arange(1, rows.shape[1] + 1)
    last = np.maximum((sorted_ > excess).sum(axis=1) - 1, 0)
    result[over] = np.maximum(rows[over] - excess[np.arange(len(last)), last][:, None], 0.0)
    return result


def people_of(matches: Array, view: NDArray[np.intp], least: float) -> list[NDArray[np.intp]]:
    """The 2D people (M,) who are one person, for everybody in two views or more.

    Pairs in falling order of their match, down to `least`; a pair joins its two groups unless both have a member
    in one view.
    """
    group = np.arange(len(matches))
    first, second = np.nonzero(np.triu(matches > least, 1))
    for a, b in np.column_stack([first, second])[np.argsort(-matches[first, second], kind="stable")].tolist():
        one, other = group == group[a], group == group[b]
        if group[a] != group[b] and not np.isin(view[one], view[other]).any():
            group[other] = group[a]
    found = [np.flatnonzero(group == number) for number in np.unique(group)]
    return [members for members in found if len(members) >= 2]
