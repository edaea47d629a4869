"""Which 2D detections are whose: proposals projected back into the views, filtered by part affinities.

Stage I (e) of the paper (section 3.1): gives each person *their* 2D observation of every joint in every view.
"""

import numpy as np

from shapepose_fg.core.arrays import Array, Mask
from shapepose_fg.core.camera import Rig
from shapepose_fg.core.detections import Detections
from shapepose_fg.core.observations import Observations
from shapepose_fg.core.skeleton import Skeleton
from shapepose_fg.proposal.candidates import Candidates
from shapepose_fg.proposal.claims import LEAST_AFFINITY, Claims, owned, projected_distances
from shapepose_fg.proposal.proposals import ProposalConfig, Proposals

_NEAR_M = 0.08
"""How closeness to the projected joint falls off: sigma of a Gaussian, as a length at the joint's depth."""
_FAR_M = 0.25
"""No detection farther than this from the projection of a joint whose place is known is taken."""
_REACH_M = 0.6
"""A joint whose place is not known yet is sought this far around its neighbours on the skeleton: no limb
from a joint to the next is longer, the trunk aside."""
_PASSES = 2
"""How often the choice is made again with the neighbours that the last one chose."""


def associate(
    proposals: Proposals,
    candidates: Candidates,
    detections: Detections,
    rig: Rig,
    skeleton: Skeleton,
    config: ProposalConfig,
) -> tuple[Observations, int]:
    """Give every person at most one detection per joint and view, and every detection to one person.

    A detection on which two people's joints lie serves both (`Claims`). Proposals that are left with hardly any
    joint seen by two views are dropped, and what they took is reassigned; the second value is their number.
    """
    claims = _claims(proposals.places, detections, rig, skeleton)
    owns = by_support(proposals, candidates, len(detections))
    real = np.ones(len(proposals), dtype=bool)
    chosen = np.full((*proposals.candidate.shape, len(rig)), -1, dtype=np.intp)
    rounds = 1 + _PASSES
    while rounds > 0:
        scored = claims.scored(owns)
        chosen = claims.matched(scored)
        claims.share(chosen, scored.affinity)
        keep = seen_twice(chosen >= 0, skeleton).mean(axis=1) >= config.min_observed_parts
        real[np.flatnonzero(real)[~keep]] = False
        claims, chosen = claims.of(keep), chosen[keep]
        owns = owned(chosen, len(detections))
        # What the dropped had is reassigned.
        rounds = rounds - 1 if keep.all() else _PASSES
    return Observations.of(chosen, detections, proposals.places[real]), int((~real).sum())


def _claims(places: Array, detections: Detections, rig: Rig, skeleton: Skeleton) -> Claims:
    """What people with joints at `places` (P, J, 3) may claim."""
    projected = rig.project(places)
    distance_m = projected_distances(projected, detections.joint, detections, rig)
    placed = np.isfinite(places[:, detections.joint, 0])
    reachable = np.zeros(placed.shape, dtype=bool)
    if not placed.all():
        for neighbour in skeleton.tree_neighbours.T:  # a joint has few
            of_each = neighbour[detections.joint]
            reachable |= (of_each >= 0) & (projected_distances(projected, of_each, detections, rig) < _REACH_M)
    inside, reachable = distance_m < _FAR_M, reachable & ~placed
    return Claims(detections, skeleton, len(rig), distance_m, _NEAR_M**2, inside, reachable, LEAST_AFFINITY)


def seen_twice(seen: Mask, skeleton: Skeleton) -> Mask:
    """(P, K) which of each person's core joints two views see, of `seen` (P, J, V)."""
    return (seen.sum(axis=2) >= 2)[:, list(skeleton.core)]


def by_support(proposals: Proposals, candidates: Candidates, count: int) -> Mask:
    """(P, D) whether a detection supports one of the person's candidates."""
    has = np.zeros((len(proposals), len(candidates) + 1), dtype=bool)
    np.put_along_axis(has, proposals.candidate, True, axis=1)  # -1 marks the spare last column
    person, row = np.nonzero(has[:, candidates.support[:, 0]])
    owns = np.zeros((len(proposals), count), dtype=bool)
    owns[person, candidates.support[row, 1]] = True
    return owns
