"""Which 2D detections are whose: proposals projected back into the views, filtered by part affinities.

Stage I (e) of the paper (section 3.1): gives each person *their* 2D observation of every joint in every view.
"""

import numpy as np

from shapepose_fg.core.arrays import Array, Index, Mask
from shapepose_fg.core.camera import Rig
from shapepose_fg.core.detections import Detections
from shapepose_fg.core.observations import Observations
from shapepose_fg.core.skeleton import Skeleton
from shapepose_fg.proposal.candidates import Candidates
from shapepose_fg.proposal.nearby import LEAST_AFFINITY, Sight, nearby
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

    A detection on which two people's joints lie serves both. Proposals that are left with hardly any
    joint seen by two views are dropped, and what they took is reassigned; the second value is their number.
    """
    own, places = by_support(proposals, candidates, detections, len(rig)), proposals.places
    real = np.ones(len(proposals), dtype=bool)
    rounds = 1 + _PASSES
    while rounds > 0:
        own = _claimed(places, own, detections, rig, skeleton)
        keep = seen_twice(own >= 0, skeleton).mean(axis=1) >= config.min_observed_parts
        real[np.flatnonzero(real)[~keep]] = False
        places, own = places[keep], own[keep]
        # What the dropped had is reassigned.
        rounds = rounds - 1 if keep.all() else _PASSES
    return Observations.of(own, detections, places), int((~real).sum())


def _claimed(places: Array, own: Index, detections: Detections, rig: Rig, skeleton: Skeleton) -> Index:
    """(P, J, V) what people with joints at `places` (P, J, 3) get, who are thought to have `own` (P, J, V)."""
    world, unplaced = np.zeros(len(own), dtype=np.intp), np.isnan(places[..., 0])
    sight = Sight.of(detections, rig, skeleton)
    near = nearby(places, np.full(unplaced.shape, _FAR_M), world, sight)
    if unplaced.any():
        near = near.with_tied(own, unplaced, sight)
    lost, reachable = np.isinf(near.distance_m), np.ones(len(near.person), dtype=bool)
    (xy, depth), of = rig.project(places), near.detection[lost]
    beside, view = skeleton.tree_neighbours[detections.joint[of]], detections.view[of]
    at = view[:, None], near.person[lost][:, None], beside
    away_m = np.linalg.norm(xy[at] - detections.xy[of][:, None], axis=-1) * depth[at] / rig.focal_px[view][:, None]
    reachable[lost] = ((beside >= 0) & (away_m < _REACH_M)).any(axis=1)
    nearness = np.where(reachable, np.exp(-0.5 * near.distance_m**2 / _NEAR_M**2), -np.inf)
    rule = nearness, lost & reachable, LEAST_AFFINITY
    chosen, claims = near.claimed(*rule, own, world, sight)
    near.share(claims.tied, chosen)
    return chosen


def seen_twice(seen: Mask, skeleton: Skeleton) -> Mask:
    """(P, K) which of each person's core joints two views see, of `seen` (P, J, V)."""
    return (seen.sum(axis=2) >= 2)[:, list(skeleton.core)]


def by_support(proposals: Proposals, candidates: Candidates, detections: Detections, views: int) -> Index:
    """(P, J, V) the detections that support each person's candidates, -1 for none."""
    of = np.full(len(candidates) + 1, -1, dtype=np.intp)
    own = np.full((*proposals.candidate.shape, views), -1, dtype=np.intp)
    for person, chosen in enumerate(proposals.candidate):
        of[chosen] = person
    of[-1] = -1  # -1 marked the spare last one
    candidate, detection = candidates.support.T
    whose = of[candidate]
    has, detection = whose >= 0, detection[whose >= 0]
    own[whose[has], detections.joint[detection], detections.view[detection]] = detection
    return own
