"""People grown from the hip along part affinities that link 3D candidates.

Stage I (e) of the paper (section 3.1): affinities decide to which person a candidate belongs.
"""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from annotated_types import Interval

from shapepose_fg.core.arrays import Array, Index
from shapepose_fg.core.bounds import Metres, MetresOrNone, RepeatsOrNone, Settings, Share
from shapepose_fg.core.detections import Detections
from shapepose_fg.core.greedy_matching import match_best_first
from shapepose_fg.core.skeleton import Skeleton
from shapepose_fg.proposal.candidates import Candidates


@dataclass(frozen=True)
class GrowthConfig(Settings):
    """Settings for links between candidates and for growing people."""

    doubt: Share = 0.2
    """Affinity below which a view contradicts a limb: unrelated pairs are mostly 0, true ones above
    0.4."""
    view_weight: Annotated[float, Interval(ge=0, le=1000000.0)] = 0.5
    """Weight of each supporting view, times its confidence, relative to the affinities of limbs. If
    these leave a choice, a point that five views agree on is preferred to a crossing of two
    rays."""
    max_limb_m: Metres = 0.75
    """Maximum length of a limb, m: the trunk of a tall adult, hip to neck, is about 0.65 m."""
    sweeps: RepeatsOrNone = 2
    """Number of further passes over all joints, once their neighbours are known."""
    bridge_m: MetresOrNone = 0.55
    """Maximum distance per bone, m, over which a joint beyond an unseen one is searched for from
    the last known joint: hip to ankle of a tall adult is 0.9 m. 0: no search, as in the paper."""


@dataclass(frozen=True)
class Links:
    """Limbs between 3D candidates, scored by the part affinities of all views."""

    ends: Index
    """(L, 2) two candidates, linked by a limb of the skeleton, in the order of the
    limb's joints."""
    score: Array
    """(L,) sum of (affinity - doubt) over the views that see both; positive if the views agree."""


def link(candidates: Candidates, detections: Detections, config: GrowthConfig) -> Links:
    """Link candidates: sum the part affinities between their supporting detections over
    all views.
    """
    owner, detection = candidates.support.T
    by_detection = np.argsort(detection, kind="stable")
    owners, counts = owner[by_detection], np.bincount(detection, minlength=len(detections))
    start = np.cumsum(counts) - counts
    head, tail = detections.pairs.T
    # Each affinity counts for every pair of candidates that its two detections support.
    repeat = counts[head] * counts[tail]
    which = np.repeat(np.arange(len(head)), repeat)
    step = np.arange(len(which)) - np.repeat(np.cumsum(repeat) - repeat, repeat)
    first = owners[start[head][which] + step // np.maximum(counts[tail][which], 1)]
    second = owners[start[tail][which] + step % np.maximum(counts[tail][which], 1)]
    key, inverse = np.unique(first * len(candidates) + second, return_inverse=True)
    ends = np.stack(np.divmod(key, max(len(candidates), 1)), axis=1)
    total = np.bincount(inverse, detections.affinity[which], len(key))
    sees = np.zeros((len(candidates), int(detections.view.max(initial=0)) + 1), dtype=bool)
    sees[owner, detections.view[detection]] = True
    shared = (sees[ends[:, 0]] & sees[ends[:, 1]]).sum(axis=1)
    length = np.linalg.norm(candidates.xyz[ends[:, 0]] - candidates.xyz[ends[:, 1]], axis=1)
    plausible = length < config.max_limb_m
    return Links(ends[plausible], (total - config.doubt * shared)[plausible])


def grow(
    anchors: Index, candidates: Candidates, links: Links, skeleton: Skeleton, config: GrowthConfig
) -> Index:
    """Choose a candidate per person and joint: (P, J), -1 where none is linked to the person.

    Joints are chosen outwards from the hip, level by level of the skeleton's tree; then `sweeps`
    times all at once, by the sum of links to all chosen neighbours; last come joints beyond unseen
    ones.
    """
    people, joints = len(anchors), len(skeleton)
    chosen = np.full((people, joints), -1, dtype=np.intp)
    chosen[:, skeleton.root] = anchors
    supported = candidates.support[:, 0]
    evidence = np.asarray(
        config.view_weight * np.bincount(supported, candidates.score[supported], len(candidates)),
        dtype=np.float64,
    )
    both_ways = np.concatenate([links.ends, links.ends[:, ::-1]])
    score = np.concatenate([links.score, links.score])
    parent = np.array(skeleton.parents)
    downward = parent[candidates.joint[both_ways[:, 1]]] == candidates.joint[both_ways[:, 0]]
    down, down_score = both_ways[downward], score[downward]
    depth = np.zeros(joints, dtype=int)
    for level, members in enumerate(skeleton.tree_levels):
        depth[members] = level
    for level in range(1, len(skeleton.tree_levels)):
        at_level = depth[candidates.joint[down[:, 1]]] == level
        support = _support(chosen, down[at_level], down_score[at_level], len(candidates))
        _choose(chosen, support, evidence, candidates, np.flatnonzero(depth == level))
    others = np.setdiff1d(np.arange(joints), [skeleton.root])
    for _ in range(config.sweeps):
        support = _support(chosen, both_ways, score, len(candidates))
        _choose(chosen, support, evidence, candidates, others)
    for _ in skeleton.tree_levels:
        support = _support(chosen, both_ways, score, len(candidates))
        if not _bridge(chosen, support, evidence, candidates, skeleton, config):
            break
    return chosen


def _bridge(
    chosen: Index,
    support: Array,
    evidence: Array,
    candidates: Candidates,
    skeleton: Skeleton,
    config: GrowthConfig,
) -> bool:
    """Fill empty joints of `chosen` with linked candidates, and strong ones beyond a gap; returns
    whether any was found.

    A joint seen by fewer than two views has no candidate, so its children have no link to the
    person. A strong candidate without any link is assigned to the nearest person who lacks it.
    """
    empty = (chosen < 0)[:, candidates.joint]
    free = candidates.joint >= 0
    free[chosen[chosen >= 0]] = False
    loose = free & candidates.strong & ~(support > 0).any(axis=0)
    score = np.where(empty & free & (support > 0), support + evidence, 0.0)
    if config.bridge_m > 0 and (empty & loose).any():
        ancestor, bones = _nearest_known(chosen, skeleton)
        start = candidates.xyz[np.take_along_axis(chosen, ancestor, axis=1)]
        distance = np.linalg.norm(start[:, candidates.joint] - candidates.xyz, axis=-1)
        gap = bones[:, candidates.joint]
        nearness = 1.0 - distance / (config.bridge_m * gap)
        # Without a gap, the affinities have already rejected the candidate.
        score = np.where(empty & loose & (gap > 1) & (nearness > 0), nearness + evidence, score)
    person, candidate = np.nonzero(score > 0)
    slot = person * chosen.shape[1] + candidates.joint[candidate]
    picked = match_best_first(slot, candidate, score[person, candidate])
    chosen.reshape(-1)[slot[picked]] = candidate[picked]
    return len(picked) > 0


def _nearest_known(chosen: Index, skeleton: Skeleton) -> tuple[Index, Index]:
    """Nearest ancestor joint (P, J) that each person has, and the number of bones (P, J) to it."""
    ancestor = np.full(chosen.shape, skeleton.root)
    bones = np.ones(chosen.shape, dtype=np.intp)
    parent = np.array(skeleton.parents)
    for members in skeleton.tree_levels[1:]:
        up = parent[members]
        known = chosen[:, up] >= 0
        ancestor[:, members] = np.where(known, up, ancestor[:, up])
        bones[:, members] = np.where(known, 1, bones[:, up] + 1)
    return ancestor, bones


def _support(chosen: Index, ends: Index, score: Array, count: int) -> Array:
    """(P, C) sum of the links from each person's chosen candidates to every candidate."""
    has = np.zeros((len(chosen), count + 1), dtype=bool)
    np.put_along_axis(has, chosen, True, axis=1)  # -1 sets the spare last column
    person, edge = np.nonzero(has[:, ends[:, 0]])
    key = person * count + ends[edge, 1]
    return (
        np.bincount(key, score[edge], len(chosen) * count).reshape(len(chosen), count).astype(float)
    )


def _choose(
    chosen: Index, support: Array, evidence: Array, candidates: Candidates, joints: Index
) -> None:
    """Set `chosen` for these joints to the best supported candidates, each for one person."""
    person, candidate = np.nonzero(support > 0)
    of_these = np.isin(candidates.joint[candidate], joints)
    person, candidate = person[of_these], candidate[of_these]
    score = support[person, candidate] + evidence[candidate]
    slot = person * chosen.shape[1] + candidates.joint[candidate]
    picked = match_best_first(slot, candidate, score)
    chosen[:, joints] = -1
    chosen.reshape(-1)[slot[picked]] = candidate[picked]
