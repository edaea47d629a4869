"""Whose a detection is: by how near it is to a person's joint, and by its affinities to what the person has.

One rule for the proposals of a frame, for hypotheses of who may be there, and for people who are followed. They
differ in how near is near, and in what is sought of joints whose place is not known.
"""

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from shapepose_fg.core.arrays import Array, Index, Mask
from shapepose_fg.core.camera import Rig
from shapepose_fg.core.compiled import kernel
from shapepose_fg.core.detections import Detections
from shapepose_fg.core.skeleton import Skeleton
from shapepose_fg.proposal.assignment import match_best_first

LEAST_AFFINITY = 0.3
"""What counts as affinity where no neighbour is seen, and half of the least score: unrelated pairs are mostly 0,
true ones above 0.4."""
OVERLAP_M = 0.025
"""Two people's projected joints closer than this overlap, as a length at their depth: the one detection there
serves both. A detector is 2 to 3 cm off."""


class Scored(NamedTuple):
    """What speaks for each of D detections being each of P people's."""

    score: Array
    """(P, D) nearness and affinity."""
    likely: Mask
    """(P, D) where these are enough."""
    affinity: Array
    """(P, D) mean affinity to what the person has of the joint's neighbours; 0 where that is nothing."""


@dataclass(frozen=True)
class Claims:
    """Which of D detections P people may claim, by where their joints are."""

    detections: Detections
    """All of a frame."""
    skeleton: Skeleton
    """The detector's joints."""
    views: int
    """V, the cameras."""
    distance_m: Array
    """(P, D) of each detection from the projection of the person's joint (`projected_distances`)."""
    variance: Array | float
    """(P, D) or one for all, m²: how closeness falls off, a Gaussian. A detector is 2 cm off on a visible joint
    and several on a hidden one."""
    inside: Mask
    """(P, D) near enough to a joint whose place is known."""
    reachable: Mask
    """(P, D) of a joint whose place is not known, where it may be: only affinity tells."""
    sure_affinity: float
    """And so much of it must be there."""

    def of(self, people: Mask) -> "Claims":
        """The claims of some of the people, where `variance` is one for all."""
        arrays = {name: getattr(self, name)[people] for name in ("distance_m", "inside", "reachable")}
        return replace(self, **arrays)

    def scored(self, owns: Mask) -> Scored:
        """The rule, for people who are thought to have the detections `owns` (P, D)."""
        affinity, neighbours = mean_affinity(owns, self.detections, self.skeleton, self.views)
        score, likely = np.zeros(affinity.shape), np.zeros(affinity.shape, dtype=bool)
        variance = np.require(np.broadcast_to(self.variance, affinity.shape), float, ["C", "W"])
        near = (self.distance_m, variance, self.inside, self.reachable)
        _score(*near, LEAST_AFFINITY, self.sure_affinity, affinity, neighbours, score, likely)
        return Scored(score, likely, affinity)

    def matched(self, scored: Scored, world: Index | None = None) -> Index:
        """(P, J, V) the detections matched to people, joints and views, best score first, each serving one; -1
        for none. People of different worlds (P,) do not compete.
        """
        shape, found = (len(scored.likely), len(self.skeleton), self.views), self.detections
        person, detection = np.nonzero(scored.likely)
        slot = (person * shape[1] + found.joint[detection]) * shape[2] + found.view[detection]
        once = detection if world is None else detection + len(found) * world[person]
        # People whom the detector has grouped have affinities of exactly 1: equal scores are told apart.
        score = np.round(scored.score[person, detection], 9) + 1e-10 * found.rank[detection]
        picked = match_best_first(slot, once, score)
        chosen = np.full(shape, -1, dtype=np.intp)
        chosen.reshape(-1)[slot[picked]] = detection[picked]
        return chosen

    def share(self, chosen: Index, affinity: Array) -> None:
        """Let a detection on a joint serve that joint too where it has none among those `chosen` (P, J, V)."""
        person, detection = np.nonzero((self.distance_m < OVERLAP_M) & (affinity >= LEAST_AFFINITY))
        joint, view = self.detections.joint[detection], self.detections.view[detection]
        order = np.argsort(-self.distance_m[person, detection], kind="stable")  # the nearest is written last
        empty = order[chosen[person, joint, view][order] < 0]
        chosen[person[empty], joint[empty], view[empty]] = detection[empty]


def projected_distances(projected: tuple[Array, Array], joint: Index, detections: Detections, rig: Rig) -> Array:
    """Distance (P, D) of each detection to the projection of a `joint` (D,), metres at its depth.

    `projected` is what `rig.project` gives of people's joints; infinite where a joint is not known.
    """
    places, depth = (np.require(each, float, ["C", "W"]) for each in projected)
    found = np.empty((depth.shape[1], len(detections)))
    view, _, xy, *_ = detections.columns
    _distances(places, depth, np.require(joint, np.intp, ["C", "W"]), view, xy, rig.focal_px, found)
    return found


def owned(chosen: Index, count: int) -> Mask:
    """(P, D) whether a detection is chosen for a person."""
    owns = np.zeros((len(chosen), count), dtype=bool)
    person, _, _ = np.nonzero(chosen >= 0)
    owns[person, chosen[chosen >= 0]] = True
    return owns


def mean_affinity(owns: Mask, detections: Detections, skeleton: Skeleton, views: int) -> tuple[Array, Index]:
    """(P, D) mean affinity of each detection to what the person owns at its limbs' other ends, and the number."""
    mean, neighbours = np.zeros(owns.shape), np.zeros(owns.shape, dtype=np.intp)
    view, joint, _, pairs, affinity = detections.columns
    sees = np.zeros((views, len(skeleton)), dtype=bool)
    _mean_affinity(owns, view, joint, pairs, affinity, skeleton.adjacency, sees, mean, neighbours)
    return mean, neighbours


@kernel
def _distances(
    places: Array, depth: Array, joint: Index, view: Index, xy: Array, focal_px: Array, distance_m: Array
) -> None:
    """`projected_distances` into `distance_m` (P, D), from `places` (V, P, J, 2) in pixels."""
    for p in range(len(distance_m)):
        for d in range(len(joint)):
            v, j = view[d], joint[d]
            x, y = places[v, p, j, 0] - xy[d, 0], places[v, p, j, 1] - xy[d, 1]
            distance = math.hypot(x, y) * depth[v, p, j] / focal_px[v]
            distance_m[p, d] = math.inf if math.isnan(distance) else distance


@kernel
def _mean_affinity(
    owns: Mask,
    view: Index,
    joint: Index,
    pairs: Index,
    affinity: Array,
    adjacency: Index,
    sees: Mask,
    mean: Array,
    neighbours: Index,
) -> None:
    """`mean_affinity` into `mean` and `neighbours` (P, D), which are zero; `sees` (V, J) is for work."""
    count = np.zeros(sees.shape, dtype=np.intp)
    for p in range(len(owns)):
        sees[:] = False
        count[:] = 0
        for d in range(len(view)):
            v, j = view[d], joint[d]
            if owns[p, d] and not sees[v, j]:
                sees[v, j] = True
                for other in range(len(adjacency)):
                    count[v, other] += adjacency[j, other]
        for e in range(len(pairs)):
            if owns[p, pairs[e, 1]]:
                mean[p, pairs[e, 0]] += affinity[e]
        for e in range(len(pairs)):
            if owns[p, pairs[e, 0]]:
                mean[p, pairs[e, 1]] += affinity[e]
        for d in range(len(view)):
            neighbours[p, d] = count[view[d], joint[d]]
            mean[p, d] /= max(neighbours[p, d], 1)


@kernel
def _score(
    distance_m: Array,
    variance: Array,
    inside: Mask,
    reachable: Mask,
    least_affinity: float,
    sure_affinity: float,
    affinity: Array,
    neighbours: Index,
    score: Array,
    likely: Mask,
) -> None:
    """`Claims.scored` into `score` and `likely` (P, D)."""
    for p in range(len(score)):
        for d in range(score.shape[1]):
            # Where no neighbour is seen, the affinities say nothing: neither for nor against.
            told = neighbours[p, d] > 0
            nearness = math.exp(-0.5 * distance_m[p, d] ** 2 / variance[p, d])
            score[p, d] = nearness + (affinity[p, d] if told else least_affinity)
            likely[p, d] = (inside[p, d] and score[p, d] >= 2 * least_affinity) or (
                reachable[p, d] and told and affinity[p, d] >= sure_affinity
            )
