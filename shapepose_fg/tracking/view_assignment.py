"""Which detections are whose when it is known where people's joints should be: one-to-one in every view."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.bounds import Metres, Repeats, Settings, Share
from shapepose_fg.core.camera import Rig
from shapepose_fg.core.detections import Detections
from shapepose_fg.core.skeleton import Skeleton
from shapepose_fg.proposal.association import (
    match_views,
    mean_affinity,
    owned,
    projected_distances,
    share_overlaps,
)


@dataclass(frozen=True)
class AssignmentConfig(Settings):
    """When a detection is taken for a joint whose place is predicted."""

    near_m: Metres = 0.06
    """How closeness to the predicted joint falls off where the prediction is exact: sigma of a Gaussian, as a
    length at the joint's depth. A detector is 2 cm off on a visible joint and several on a hidden one."""
    far_m: Metres = 0.12
    """No detection farther than this, and twice the prediction's sigma, is taken."""
    farthest_m: Metres = 0.5
    """No detection farther than this is taken, however uncertain the prediction."""
    least_affinity: Share = 0.3
    """Mean affinity to the person's other detections that takes a detection for a joint whose place is lost; half
    of the least score of all others. Unrelated pairs are mostly 0, true ones above 0.4."""
    reach_m: Metres = 0.8
    """A lost joint is sought this far around its neighbour on the skeleton."""
    overlap_m: Metres = 0.025
    """Two people's predicted joints closer than this overlap, as a length at their depth: the one detection there
    serves both. A detector is 2 to 3 cm off."""
    passes: Repeats = 2
    """How often the choice is made again with the affinities to what the last one chose."""


_ODDS = 5.0
"""What a score's point adds to the logarithm of the odds that a detection is somebody's."""
_EVEN = 0.45
"""The score at which a detection that only one person can have is as likely theirs as nobody's.

Both from simulated crowds of eight (seeds 4711, 777, 90211; three and four cameras, 198,000 choices of which 2.2 %
are wrong): of choices of probability 0.62 / 0.75 / 0.86 / 0.93 / 0.97 / 0.985 / 0.997 0.63 / 0.75 / 0.83 / 0.91 /
0.97 / 0.990 / 0.998 are right."""
_MESSAGES = 6
"""Rounds of messages between people and detections: changes are under 0.01 from then on."""


def assign(
    places: NDArray[np.float64],
    sigma_m: NDArray[np.float64],
    lost: NDArray[np.bool_],
    detections: Detections,
    rig: Rig,
    skeleton: Skeleton,
    config: AssignmentConfig,
    world: NDArray[np.intp] | None = None,
) -> NDArray[np.intp]:
    """The detection (A, J, V) of each person's joint in each view, -1 where there is none.

    `places` (A, J, 3) are predictions known to `sigma_m` (A, J). A detection's score is its nearness and its mean
    affinity to what the same person has at the limbs' other ends; the best score is taken first, each detection
    once. A joint that is `lost` (A, J) is found by affinity alone; its place is that of its neighbour. People of
    different worlds (A,) do not compete for detections.
    """
    return _assigned(places, sigma_m, lost, detections, rig, skeleton, config, world)[0]


def assign_with_probability(
    places: NDArray[np.float64],
    sigma_m: NDArray[np.float64],
    lost: NDArray[np.bool_],
    detections: Detections,
    rig: Rig,
    skeleton: Skeleton,
    config: AssignmentConfig,
) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """What `assign` gives, and how probably (A, J, V) each of these detections is the person's; 0 where none is.

    A detection that serves two people, because it lies on the joints of both, is in the right place for either if
    it is anybody's.
    """
    chosen, score, possible = _assigned(places, sigma_m, lost, detections, rig, skeleton, config)
    if possible.size == 0:
        return chosen, np.zeros(chosen.shape)
    probable = probabilities(score, possible, detections, len(rig))
    serves = np.bincount(chosen[chosen >= 0], minlength=len(detections)) > 1
    # Marginals of competitors that form a cycle are not exact: their sum may be over 1 by a little.
    probable = np.where(serves, np.minimum(probable.sum(axis=0), 1.0), probable)
    whose = np.arange(len(chosen))[:, None, None]
    return chosen, np.where(chosen >= 0, probable[whose, chosen], 0.0)


def probabilities(
    score: NDArray[np.float64], possible: NDArray[np.bool_], detections: Detections, views: int
) -> NDArray[np.float64]:
    """(A, D) how probably each detection is each person's, of those that are `possible` (A, D), by their `score`.

    A person has at most one detection of a joint in a view, and a detection is one person's or nobody's: the
    marginals of all ways to give them out, by belief propagation (Williams and Lau, 2014), which is exact where
    who competes for what has no cycle.
    """
    order = np.argsort(detections.joint * views + detections.view, kind="stable")
    slot = (detections.joint * views + detections.view)[order]
    first = np.flatnonzero(np.diff(slot, prepend=-1))
    which = np.repeat(np.arange(len(first)), np.diff(first, append=len(slot)))
    weight = np.where(possible, np.exp(_ODDS * (score - _EVEN)), 0.0)[:, order]
    unclaimed = np.ones_like(weight)
    for _ in range(_MESSAGES):
        open_weight = weight * unclaimed
        others = np.add.reduceat(open_weight, first, axis=1)[:, which] - open_weight
        claim = weight / (1 + np.maximum(others, 0.0))
        unclaimed = 1 / (1 + claim.sum(axis=0) - claim)
    open_weight = weight * unclaimed
    probable = np.empty_like(weight)
    probable[:, order] = open_weight / (1 + np.add.reduceat(open_weight, first, axis=1)[:, which])
    return probable


def _assigned(
    places: NDArray[np.float64],
    sigma_m: NDArray[np.float64],
    lost: NDArray[np.bool_],
    detections: Detections,
    rig: Rig,
    skeleton: Skeleton,
    config: AssignmentConfig,
    world: NDArray[np.intp] | None = None,
) -> tuple[NDArray[np.intp], NDArray[np.float64], NDArray[np.bool_]]:
    """The detections (A, J, V), every one's score (A, D) for each person, and whether it can be theirs (A, D)."""
    people, count = len(places), len(detections)
    shape = (people, len(skeleton), len(rig))
    if people == 0 or count == 0:
        empty = np.zeros((people, count))
        return np.full(shape, -1, dtype=np.intp), empty, empty > 0
    distance_m = projected_distances(rig.project(places), detections.joint, detections, rig)
    sigma, astray = sigma_m[:, detections.joint], lost[:, detections.joint]
    nearness = np.exp(-0.5 * distance_m**2 / (config.near_m**2 + sigma**2))
    gate_m = np.minimum(config.far_m + 2 * sigma, config.farthest_m)
    inside = (distance_m < gate_m) & ~astray
    reachable = (distance_m < config.reach_m) & astray
    owns = np.zeros((people, count), dtype=bool)
    chosen = np.full(shape, -1, dtype=np.intp)
    affinity, score, possible = np.zeros((people, count)), np.zeros((people, count)), inside
    for _ in range(1 + config.passes):
        affinity, neighbours = mean_affinity(owns, detections, skeleton, len(rig))
        # Where no neighbour is seen, the affinities say nothing: neither for nor against.
        spoken = np.where(neighbours > 0, affinity, config.least_affinity)
        score = nearness + spoken
        likely = inside & (score >= 2 * config.least_affinity)
        likely |= reachable & (neighbours > 0) & (affinity >= config.least_affinity)
        possible = inside | likely
        chosen = match_views(likely, score, detections, shape, world)
        owns = owned(chosen, count)
    overlap = (distance_m < config.overlap_m) & (affinity >= config.least_affinity)
    share_overlaps(chosen, overlap, distance_m, detections)
    return chosen, score, possible
