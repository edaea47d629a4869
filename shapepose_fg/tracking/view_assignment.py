"""Which detections are whose when it is known where people's joints should be: one-to-one in every view."""

from dataclasses import dataclass

import numpy as np

from shapepose_fg.core.arrays import Array, Index, Mask
from shapepose_fg.core.camera import Rig
from shapepose_fg.core.compiled import kernel
from shapepose_fg.core.detections import Detections
from shapepose_fg.core.skeleton import Skeleton
from shapepose_fg.proposal.nearby import LEAST_AFFINITY, OVERLAP_M, Nearby, nearby

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


@dataclass(frozen=True)
class Scored:
    """What speaks for each of N detections being people's."""

    near: Nearby
    """Which, and whose."""
    score: Array
    """(N,) nearness, and affinity to what the person has at the other ends of the joint's limbs."""
    possible: Mask
    """(N,) near enough to a joint whose place is known, or likely by affinity."""


def assign(predicted: Predicted, detections: Detections, rig: Rig, skeleton: Skeleton) -> Index:
    """The detection (A, J, V) of each person's joint in each view, -1 where there is none: the best score first,
    each detection once, but for those on which several people's joints lie.
    """
    return _assigned(predicted, detections, rig, skeleton)[0]


def assign_with_probability(
    predicted: Predicted, detections: Detections, rig: Rig, skeleton: Skeleton
) -> tuple[Index, Array]:
    """What `assign` gives, and how probably (A, J, V) each of these detections is the person's; 0 where none is.

    A detection that serves two people, because it lies on the joints of both, is in the right place for either if
    it is anybody's.
    """
    chosen, scored = _assigned(predicted, detections, rig, skeleton)
    probable, near = probabilities(scored, len(detections)), scored.near
    of, count = near.detection, len(detections)
    serves = np.bincount(chosen[chosen >= 0], minlength=count)[of] > 1
    # Marginals of competitors that form a cycle are not exact: their sum may be over 1 by a little.
    together = np.minimum(np.bincount(of, probable, count)[of], 1.0)
    place = near.person, detections.joint[of], detections.view[of]
    taken, probability = chosen[place] == of, np.zeros(chosen.shape)
    probability[tuple(each[taken] for each in place)] = np.where(serves, together, probable)[taken]
    return chosen, probability


def probabilities(scored: Scored, detections: int) -> Array:
    """(N,) how probably each detection is the person's, of those that are possible, by their score.

    A person has at most one detection of a joint in a view, and a detection is one person's or nobody's: the
    marginals of all ways to give them out, by belief propagation (Williams and Lau, 2014), which is exact where
    who competes for what has no cycle.
    """
    weight, near = np.where(scored.possible, np.exp(_ODDS * (scored.score - _EVEN)), 0.0), scored.near
    probable = np.empty_like(weight)
    people = int(near.person.max(initial=-1)) + 1
    _marginals(near.first, near.person, near.detection, weight, people, detections, _MESSAGES, probable)
    return probable


def _assigned(predicted: Predicted, detections: Detections, rig: Rig, skeleton: Skeleton) -> tuple[Index, Scored]:
    """The detections (A, J, V), and what speaks for all that are near."""
    gate_m = np.where(predicted.lost, _REACH_M, np.minimum(_FAR_M + 2 * predicted.sigma_m, FARTHEST_M))
    world = np.zeros(len(gate_m), dtype=np.intp) if predicted.world is None else predicted.world
    near = nearby(predicted.places, np.maximum(gate_m, OVERLAP_M), world, rig, skeleton, detections)
    at = near.person, detections.joint[near.detection]
    within, lost, sigma_m = near.distance_m < gate_m[at], predicted.lost[at], predicted.sigma_m[at]
    nearness = np.where(within, np.exp(-0.5 * near.distance_m**2 / (_NEAR_M**2 + sigma_m**2)), -np.inf)
    rule = nearness, lost & within, LEAST_AFFINITY
    before = np.full((len(gate_m), len(skeleton), len(rig)), -1, dtype=np.intp)
    chosen, claims = near.claimed(*rule, before, world, detections, skeleton)
    for _ in range(_PASSES):
        if (chosen == before).all():
            break
        before = chosen
        chosen, claims = near.claimed(*rule, before, world, detections, skeleton)
    near.share(claims.tied, chosen, detections)
    return chosen, Scored(near, claims.score, (within & ~lost) | claims.likely)


@kernel
def _marginals(first, person, detection, weight, people, detections, rounds, probable):
    """Fill in `probable` (N,) from `weight` (N,), joint by joint and view by view."""
    of_person, of_detection, unclaimed = np.zeros(people), np.zeros(detections), np.ones(len(weight))
    for slot in range(len(first) - 1):
        span = range(first[slot], first[slot + 1])
        for _ in range(rounds):
            for e in span:
                of_person[person[e]] += weight[e] * unclaimed[e]
            for e in span:
                others = of_person[person[e]] - weight[e] * unclaimed[e]
                probable[e] = weight[e] / (1 + max(others, 0.0))
                of_detection[detection[e]] += probable[e]
            for e in span:
                unclaimed[e] = 1 / (1 + of_detection[detection[e]] - probable[e])
                of_person[person[e]] = 0.0
            for e in span:
                of_detection[detection[e]] = 0.0
        for e in span:
            of_person[person[e]] += weight[e] * unclaimed[e]
        for e in span:
            probable[e] = weight[e] * unclaimed[e] / (1 + of_person[person[e]])
        for e in span:
            of_person[person[e]] = 0.0
