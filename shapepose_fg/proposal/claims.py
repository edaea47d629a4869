"""Whose a detection is: by how near it is to a person's joint, and by its affinities to what the person has.

One rule for the proposals of a frame, for hypotheses of who may be there, and for people who are followed. They
differ in how near is near, and in what is sought of joints whose place is not known.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from shapepose_fg.core.arrays import Array, Index, Mask
from shapepose_fg.core.camera import Rig
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

    @cached_property
    def nearness(self) -> Array:
        """(P, D) 1 on the projected joint, 0 far from it."""
        return np.exp(-0.5 * self.distance_m**2 / self.variance)

    def of(self, people: Mask) -> "Claims":
        """The claims of some of the people, where `variance` is one for all."""
        arrays = {name: getattr(self, name)[people] for name in ("distance_m", "inside", "reachable")}
        return replace(self, **arrays)

    def scored(self, owns: Mask) -> Scored:
        """The rule, for people who are thought to have the detections `owns` (P, D)."""
        affinity, neighbours = mean_affinity(owns, self.detections, self.skeleton, self.views)
        # Where no neighbour is seen, the affinities say nothing: neither for nor against.
        score = self.nearness + np.where(neighbours > 0, affinity, LEAST_AFFINITY)
        likely = self.inside & (score >= 2 * LEAST_AFFINITY)
        likely |= self.reachable & (neighbours > 0) & (affinity >= self.sure_affinity)
        return Scored(score, likely, affinity)

    def matched(self, scored: Scored, world: Index | None = None) -> Index:
        """(P, J, V) the detections matched to people, joints and views, best score first, each serving one; -1
        for none. People of different worlds (P,) do not compete.
        """
        shape, found = (len(scored.likely), len(self.skeleton), self.views), self.detections
        person, detection = np.nonzero(scored.likely)
        slot = np.ravel_multi_index((person, found.joint[detection], found.view[detection]), shape)
        once = detection if world is None else detection + len(found) * world[person]
        picked = match_best_first(slot, once, _without_ties(scored.score, found)[person, detection])
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
    xy, depth = projected
    at = (detections.view, slice(None), joint)
    distance_px = np.hypot(*np.moveaxis(xy[at] - detections.xy[:, None], -1, 0)).T
    distance_m = distance_px * depth[at].T / rig.focal_px[detections.view]
    return np.where(np.isnan(distance_px), np.inf, distance_m)


def owned(chosen: Index, count: int) -> Mask:
    """(P, D) whether a detection is chosen for a person."""
    owns = np.zeros((len(chosen), count), dtype=bool)
    person, _, _ = np.nonzero(chosen >= 0)
    owns[person, chosen[chosen >= 0]] = True
    return owns


def mean_affinity(owns: Mask, detections: Detections, skeleton: Skeleton, views: int) -> tuple[Array, Index]:
    """(P, D) mean affinity of each detection to what the person owns at its limbs' other ends, and the number."""
    people, count = owns.shape
    head, tail = detections.pairs.T
    total = np.zeros((people, count))
    for end, other in ((head, tail), (tail, head)):
        person, edge = np.nonzero(owns[:, other])
        key = person * count + end[edge]
        total += np.bincount(key, detections.affinity[edge], people * count).reshape(people, count)
    sees = np.zeros((people, views, len(skeleton)), dtype=bool)
    person, detection = np.nonzero(owns)
    sees[person, detections.view[detection], detections.joint[detection]] = True
    neighbours = (sees @ skeleton.adjacency)[:, detections.view, detections.joint]
    return total / np.maximum(neighbours, 1), neighbours


def _without_ties(score: Array, detections: Detections) -> Array:
    """`score` (P, D) with equal scores of two detections told apart by what these are, not by their order.

    People whom the detector has grouped have affinities of exactly 1.
    """
    order = np.lexsort((*detections.xy.T, detections.confidence))
    rank = np.empty(len(order))
    rank[order] = np.arange(len(order))
    return np.round(score, 9) + 1e-10 * rank / max(len(order), 1)
