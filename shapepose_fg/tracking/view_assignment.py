"""Which detections are whose when it is known where people's joints should be: one-to-one in every view."""

from dataclasses import dataclass

import numpy as np

from shapepose_fg.core.arrays import Array, Index, Mask
from shapepose_fg.core.camera import Rig
from shapepose_fg.core.detections import Detections
from shapepose_fg.core.skeleton import Skeleton
from shapepose_fg.proposal.claims import LEAST_AFFINITY, Claims, owned, projected_distances

_NEAR_M = 0.06
"""How closeness to the predicted joint falls off where the prediction is exact: sigma of a Gaussian, as a length
at the joint's depth."""
_FAR_M = 0.12
"""No detection farther than this, and twice the prediction's sigma, is taken."""
FARTHEST_M = 0.5
"""No detection farther than this is taken, however uncertain the prediction."""
_REACH_M = 0.8
"""A lost joint is sought this far around its neighbour on the skeleton."""
_PASSES = 2
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


@dataclass(frozen=True)
class Predicted:
    """Where the joints of A people should be."""

    places: Array
    """(A, J, 3) metres."""
    sigma_m: Array
    """(A, J) how surely."""
    lost: Mask
    """(A, J) joints that are found by affinity alone; their place is that of their neighbour."""
    world: Index | None = None
    """(A,) people of different worlds do not compete for detections."""


def assign(predicted: Predicted, detections: Detections, rig: Rig, skeleton: Skeleton) -> Index:
    """The detection (A, J, V) of each person's joint in each view, -1 where there is none: the best score first
    (`Claims`), each detection once, but for those on which several people's joints lie.
    """
    return _assigned(predicted, detections, rig, skeleton)[0]


def assign_with_probability(
    predicted: Predicted, detections: Detections, rig: Rig, skeleton: Skeleton
) -> tuple[Index, Array]:
    """What `assign` gives, and how probably (A, J, V) each of these detections is the person's; 0 where none is.

    A detection that serves two people, because it lies on the joints of both, is in the right place for either if
    it is anybody's.
    """
    chosen, score, possible = _assigned(predicted, detections, rig, skeleton)
    if possible.size == 0:
        return chosen, np.zeros(chosen.shape)
    probable = probabilities(score, possible, detections, len(rig))
    serves = np.bincount(chosen[chosen >= 0], minlength=len(detections)) > 1
    # Marginals of competitors that form a cycle are not exact: their sum may be over 1 by a little.
    probable = np.where(serves, np.minimum(probable.sum(axis=0), 1.0), probable)
    whose = np.arange(len(chosen))[:, None, None]
    return chosen, np.where(chosen >= 0, probable[whose, chosen], 0.0)


def probabilities(score: Array, possible: Mask, detections: Detections, views: int) -> Array:
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
    predicted: Predicted, detections: Detections, rig: Rig, skeleton: Skeleton
) -> tuple[Index, Array, Mask]:
    """The detections (A, J, V), every one's score (A, D) for each person, and whether it can be theirs (A, D)."""
    distance_m = projected_distances(rig.project(predicted.places), detections.joint, detections, rig)
    sigma, astray = predicted.sigma_m[:, detections.joint], predicted.lost[:, detections.joint]
    inside = (distance_m < np.minimum(_FAR_M + 2 * sigma, FARTHEST_M)) & ~astray
    reachable = (distance_m < _REACH_M) & astray
    variance = _NEAR_M**2 + sigma**2
    claims = Claims(detections, skeleton, len(rig), distance_m, variance, inside, reachable, LEAST_AFFINITY)
    scored = claims.scored(np.zeros(distance_m.shape, dtype=bool))
    for _ in range(_PASSES):
        scored = claims.scored(owned(claims.matched(scored, predicted.world), len(detections)))
    chosen = claims.matched(scored, predicted.world)
    claims.share(chosen, scored.affinity)
    return chosen, scored.score, inside | scored.likely
