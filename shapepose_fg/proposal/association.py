"""Association of 2D detections with people: proposals are projected into the views and filtered by
part affinities.

Stage I (e) of the paper (section 3.1): assigns each person *their* 2D observation of every joint in
every view.
"""

import numpy as np

from shapepose_fg.core.arrays import Array, Index, Mask
from shapepose_fg.core.camera import Rig
from shapepose_fg.core.detections import Detections
from shapepose_fg.core.observations import Observations
from shapepose_fg.core.skeleton import Skeleton
from shapepose_fg.proposal.candidates import Candidates
from shapepose_fg.proposal.nearby import LEAST_AFFINITY, PASSES, FrameArrays, nearby
from shapepose_fg.proposal.proposals import ProposalConfig, Proposals

_NEAR_M = 0.08
"""Standard deviation of the nearness score around a projected joint, as a length at its
depth, m."""
_FAR_M = 0.25
"""Maximum distance of a detection from the projection of a placed joint, m."""
_REACH_M = 0.6
"""Radius around the skeleton neighbours of a joint of unknown position within which it is searched
for, m: no limb from a joint to the next is longer, except the trunk."""


def associate(
    proposals: Proposals,
    candidates: Candidates,
    detections: Detections,
    rig: Rig,
    skeleton: Skeleton,
    config: ProposalConfig,
) -> tuple[Observations, int]:
    """Assign each person at most one detection per joint and view, and each detection to one
    person.

    A detection on which joints of two people coincide serves both. Proposals left with too few
    joints seen by two views are dropped, and their detections reassigned; the second value is the
    number of dropped ones.
    """
    own, places = by_support(proposals, candidates, detections, len(rig)), proposals.places
    real = np.ones(len(proposals), dtype=bool)
    rounds = 1 + PASSES
    while rounds > 0:
        own = _claimed(places, own, detections, rig, skeleton)
        keep = seen_twice(own >= 0, skeleton).mean(axis=1) >= config.min_observed_parts
        real[np.flatnonzero(real)[~keep]] = False
        places, own = places[keep], own[keep]
        # Detections of dropped proposals are reassigned.
        rounds = rounds - 1 if keep.all() else PASSES
    return Observations.of(own, detections, places), int((~real).sum())


def _claimed(
    places: Array, own: Index, detections: Detections, rig: Rig, skeleton: Skeleton
) -> Index:
    """Detections (P, J, V) assigned to people at `places` (P, J, 3), whose present ones are `own`
    (P, J, V).
    """
    hypothesis, unplaced = np.zeros(len(own), dtype=np.intp), np.isnan(places[..., 0])
    arrays = FrameArrays.of(detections, rig, skeleton)
    near = nearby(places, np.full(unplaced.shape, _FAR_M), hypothesis, arrays)
    if unplaced.any():
        near = near.with_tied(own, unplaced, arrays)
    lost, reachable = np.isinf(near.distance_m), np.ones(len(near.person), dtype=bool)
    (xy, depth), of = rig.project(places), near.detection[lost]
    beside, view = skeleton.tree_neighbours[detections.joint[of]], detections.view[of]
    at = view[:, None], near.person[lost][:, None], beside
    away_m = (
        np.linalg.norm(xy[at] - detections.xy[of][:, None], axis=-1)
        * depth[at]
        / rig.focal_px[view][:, None]
    )
    reachable[lost] = ((beside >= 0) & (away_m < _REACH_M)).any(axis=1)
    nearness = np.where(reachable, np.exp(-0.5 * near.distance_m**2 / _NEAR_M**2), -np.inf)
    rule = nearness, lost & reachable, LEAST_AFFINITY
    chosen, claims = near.claimed(*rule, own, hypothesis, arrays)
    near.share(claims.tied, chosen)
    return chosen


def seen_twice(seen: Mask, skeleton: Skeleton) -> Mask:
    """(P, K) whether two views see each of the K core joints, from `seen` (P, J, V)."""
    return (seen.sum(axis=2) >= 2)[:, list(skeleton.core)]


def by_support(
    proposals: Proposals, candidates: Candidates, detections: Detections, views: int
) -> Index:
    """(P, J, V) the detections that support each person's candidates, -1 for none."""
    of = np.full(len(candidates) + 1, -1, dtype=np.intp)
    own = np.full((*proposals.candidate.shape, views), -1, dtype=np.intp)
    for person, chosen in enumerate(proposals.candidate):
        of[chosen] = person
    of[-1] = -1  # restore the spare entry
    candidate, detection = candidates.support.T
    views_of = of[candidate]
    has, detection = views_of >= 0, detection[views_of >= 0]
    own[views_of[has], detections.joint[detection], detections.view[detection]] = detection
    return own
