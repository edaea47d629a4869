"""Which 2D detections are whose: proposals projected back into the views, filtered by part affinities.

Stage I (e) of the paper (section 3.1): gives each person *their* 2D observation of every joint in every view.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.bounds import Settings, Share
from shapepose_fg.core.camera import Rig
from shapepose_fg.core.detections import Detections
from shapepose_fg.core.observations import Observations
from shapepose_fg.core.skeleton import Skeleton
from shapepose_fg.proposal.assignment import match_best_first
from shapepose_fg.proposal.candidates import Candidates
from shapepose_fg.proposal.proposals import Proposals

_NEAR_M = 0.08
"""How closeness to the projected joint falls off: sigma of a Gaussian, as a length at the joint's depth. A
detector is 2 cm off on a visible joint and several on a hidden one."""
_FAR_M = 0.25
"""No detection farther than this from the projection of a joint whose place is known is taken."""
_REACH_M = 0.6
"""A joint whose place is not known yet is sought this far around its neighbours on the skeleton: no limb
from a joint to the next is longer, the trunk aside."""
_LEAST_AFFINITY = 0.3
"""A joint whose place is not known is only taken by an affinity of at least this to an observed neighbour."""
_OVERLAP_M = 0.025
"""Two people's projected joints closer than this overlap, as a length at their depth: the one detection there
serves both. A detector is 2 to 3 cm off."""
_PASSES = 2
"""How often the choice is made again with the neighbours that the last one chose."""


@dataclass(frozen=True)
class AssociationConfig(Settings):
    """When a 2D detection is an observation of a proposal's joint."""

    min_observed_parts: Share = 0.35
    """Least fraction of the core joints (trunk, arms, legs) that two views must see: 6 of 15. Of one whose upper
    body alone shows there are 9. The paper asks for none."""

    @classmethod
    def paper(cls) -> "AssociationConfig":
        """As written: whoever was proposed stays."""
        return cls(min_observed_parts=0.0)


def associate(
    proposals: Proposals,
    candidates: Candidates,
    detections: Detections,
    rig: Rig,
    skeleton: Skeleton,
    config: AssociationConfig,
) -> tuple[Observations, int]:
    """Give every person at most one detection per joint and view, and every detection to one person.

    A pair is scored by how near the detection is to the projected joint and by its affinities to the detections
    already chosen for the joint's neighbours in that view. A detection on which two people's joints lie serves
    both. Proposals that are left with hardly any joint seen by two views are dropped, and what they took is given
    out anew; the second value is their number.
    """
    nearness = _nearness(proposals.places, detections, rig, skeleton)
    owns = _by_support(proposals, candidates, len(detections))
    real = np.ones(len(proposals), dtype=bool)
    chosen = np.full((*proposals.candidate.shape, len(rig)), -1, dtype=np.intp)
    rounds = 1 + _PASSES
    while rounds > 0:
        chosen = _choose(nearness, owns, detections, skeleton)
        keep = seen_twice(chosen >= 0, skeleton).mean(axis=1) >= config.min_observed_parts
        real[np.flatnonzero(real)[~keep]] = False
        nearness, chosen = nearness.of(keep), chosen[keep]
        owns = owned(chosen, len(detections))
        # What the dropped had is given out anew.
        rounds = rounds - 1 if keep.all() else _PASSES
    return Observations.of(chosen, detections, proposals.places[real]), int((~real).sum())


@dataclass(frozen=True)
class _Nearness:
    """How near D detections are to the projections of P people's joints; it does not change between passes."""

    views: int
    placed: NDArray[np.bool_]
    """(P, D) whether it is known where the person's joint of the detection's kind is."""
    distance_m: NDArray[np.float64]
    """(P, D) distance from the projection of that joint, as a length at its depth; infinite if not placed."""
    reachable: NDArray[np.bool_]
    """(P, D) not placed, but within a limb's length of a neighbour on the skeleton that is."""

    def of(self, people: NDArray[np.bool_]) -> "_Nearness":
        """The nearness for some of the people."""
        return _Nearness(
            self.views,
            self.placed[people],
            self.distance_m[people],
            self.reachable[people],
        )


def _nearness(
    places: NDArray[np.float64],
    detections: Detections,
    rig: Rig,
    skeleton: Skeleton,
) -> _Nearness:
    """Compare all detections with the projections of all joints at `places` (P, J, 3)."""
    projected = rig.project(places)
    own_m = projected_distances(projected, detections.joint, detections, rig)
    placed = np.isfinite(places[:, detections.joint, 0])
    reachable = np.zeros(placed.shape, dtype=bool)
    if not placed.all():
        for neighbour in skeleton.tree_neighbours.T:  # a joint has few
            of_each = neighbour[detections.joint]
            reachable |= (of_each >= 0) & (projected_distances(projected, of_each, detections, rig) < _REACH_M)
    return _Nearness(len(rig), placed, own_m, reachable & ~placed)


def projected_distances(
    projected: tuple[NDArray[np.float64], NDArray[np.float64]],
    joint: NDArray[np.intp],
    detections: Detections,
    rig: Rig,
) -> NDArray[np.float64]:
    """Distance (P, D) of each detection to the projection of a `joint` (D,), metres at its depth.

    `projected` is what `rig.project` gives of people's joints; infinite where a joint is not known.
    """
    xy, depth = projected
    at = (detections.view, slice(None), joint)
    distance_px = np.hypot(*np.moveaxis(xy[at] - detections.xy[:, None], -1, 0)).T
    distance_m = distance_px * depth[at].T / rig.focal_px[detections.view]
    return np.where(np.isnan(distance_px), np.inf, distance_m)


def seen_twice(seen: NDArray[np.bool_], skeleton: Skeleton) -> NDArray[np.bool_]:
    """(P, K) which of each person's core joints two views see, of `seen` (P, J, V)."""
    return (seen.sum(axis=2) >= 2)[:, list(skeleton.core)]


def _choose(
    nearness: _Nearness,
    owns: NDArray[np.bool_],
    detections: Detections,
    skeleton: Skeleton,
) -> NDArray[np.intp]:
    """(P, J, V) detections for the people who are thought to own `owns` (P, D)."""
    affinity, neighbours = mean_affinity(owns, detections, skeleton, nearness.views)
    # Where no neighbour is seen, the affinities say nothing: neither for nor against.
    spoken = np.where(neighbours > 0, affinity, _LEAST_AFFINITY)
    score = np.exp(-0.5 * (nearness.distance_m / _NEAR_M) ** 2) + spoken
    likely = (nearness.distance_m < _FAR_M) & (score >= 2 * _LEAST_AFFINITY)
    likely |= nearness.reachable & (affinity >= _LEAST_AFFINITY)
    chosen = match_views(likely, score, detections, (len(owns), len(skeleton), nearness.views))
    overlap = (nearness.distance_m < _OVERLAP_M) & (affinity >= _LEAST_AFFINITY)
    share_overlaps(chosen, overlap, nearness.distance_m, detections)
    return chosen


def owned(chosen: NDArray[np.intp], count: int) -> NDArray[np.bool_]:
    """(P, D) whether a detection is chosen for a person."""
    owns = np.zeros((len(chosen), count), dtype=bool)
    person, _, _ = np.nonzero(chosen >= 0)
    owns[person, chosen[chosen >= 0]] = True
    return owns


def _by_support(proposals: Proposals, candidates: Candidates, count: int) -> NDArray[np.bool_]:
    """(P, D) whether a detection supports one of the person's candidates."""
    has = np.zeros((len(proposals), len(candidates) + 1), dtype=bool)
    np.put_along_axis(has, proposals.candidate, True, axis=1)  # -1 marks the spare last column
    person, row = np.nonzero(has[:, candidates.support[:, 0]])
    owns = np.zeros((len(proposals), count), dtype=bool)
    owns[person, candidates.support[row, 1]] = True
    return owns


def mean_affinity(
    owns: NDArray[np.bool_], detections: Detections, skeleton: Skeleton, views: int
) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
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


def match_views(
    likely: NDArray[np.bool_],
    score: NDArray[np.float64],
    detections: Detections,
    shape: tuple[int, ...],
    world: NDArray[np.intp] | None = None,
) -> NDArray[np.intp]:
    """(P, J, V) the detections matched to people, joints and views, best score first, each serving one.

    People of different worlds (P,) do not compete.
    """
    person, detection = np.nonzero(likely)
    slot = np.ravel_multi_index((person, detections.joint[detection], detections.view[detection]), shape)
    once = detection if world is None else detection + len(detections) * world[person]
    picked = match_best_first(slot, once, without_ties(score, detections)[person, detection])
    chosen = np.full(shape, -1, dtype=np.intp)
    chosen.reshape(-1)[slot[picked]] = detection[picked]
    return chosen


def without_ties(score: NDArray[np.float64], detections: Detections) -> NDArray[np.float64]:
    """`score` (P, D) with equal scores of two detections told apart by what these are, not by their order.

    People whom the detector has grouped have affinities of exactly 1.
    """
    order = np.lexsort((*detections.xy.T, detections.confidence))
    rank = np.empty(len(order))
    rank[order] = np.arange(len(order))
    return np.round(score, 9) + 1e-10 * rank / max(len(order), 1)


def share_overlaps(
    chosen: NDArray[np.intp],
    overlap: NDArray[np.bool_],
    distance_m: NDArray[np.float64],
    detections: Detections,
) -> None:
    """Let the detection that lies on a joint serve that joint too where the joint has none of its own."""
    person, detection = np.nonzero(overlap)
    joint, view = detections.joint[detection], detections.view[detection]
    order = np.argsort(-distance_m[person, detection], kind="stable")  # the nearest is written last
    empty = order[chosen[person, joint, view][order] < 0]
    chosen[person[empty], joint[empty], view[empty]] = detection[empty]
