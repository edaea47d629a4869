"""The paper's search for people of one frame: hips anchor people, who grow along part affinities.

Stage I (c) to (e) of the paper (section 3.1), used with `method = "paper"` only.
"""

from dataclasses import dataclass

import numpy as np

from shapepose_fg.core.arrays import Array, Index
from shapepose_fg.core.compiled import kernel
from shapepose_fg.proposal.assignment import match_best_first
from shapepose_fg.proposal.candidates import PairPoints
from shapepose_fg.proposal.possible_people import Frame, PossiblePeople, claimed, gaps
from shapepose_fg.proposal.thinning import best_of

_RADIUS_M = 0.06
"""Radius rho of a cluster, m. The paper does not give it; 5 to 12 cm were tried on `tune`."""
_VOTES = 3
"""Minimum number of points of a candidate; fewer if there are fewer pairs of views."""
_MOST_CANDIDATES = 250
"""Maximum number of candidates per joint, those with most votes: it bounds the cost."""
_BOX_M = 1.0, 1.2
"""Half the width and half the height of the box around a hip, m: a raised hand is inside."""
_PARTS = 0.9
"""Minimum fraction of the core joints with a candidate in the box."""
_APART_M = 0.6
"""Non-maximum suppression: minimum distance of two hips, m; 20 to 80 cm were tried on `tune`."""
_DOUBT = 0.2
"""Affinity below which a view contradicts a limb: unrelated pairs are mostly 0, true ones above
0.4."""
_VIEW = 0.5
"""Weight of each supporting view's confidence, beside the affinities: if these leave a choice, a
point that five views agree on is preferred to a crossing of two rays."""
_LIMB_M = 0.75
"""Maximum length of a limb, m: the trunk of a tall adult, hip to neck, is about 0.65 m."""
_SWEEPS = 3
"""Number of passes over the joints; each uses the neighbours that the last one found."""


@dataclass(frozen=True)
class Candidates:
    """C 3D candidates of joints: clusters of points that are triangulated from two views."""

    xyz: Array
    """(C, 3) mean of the points, metres."""
    joint: Index
    """(C,) index of the joint in the skeleton."""
    score: Array
    """(C,) mean confidence of the supporting detections."""
    support: Index
    """(S, 2) rows (candidate, detection): the detections of the points, at most one per view."""


def people_by_hips(points: PairPoints, frame: Frame) -> PossiblePeople:
    """Find the people of a frame from the `points` of all pairs of views, best first."""
    candidates = vote(points, frame)
    chosen = grown(anchors(candidates, frame), candidates, frame)
    whose = np.full(len(candidates.joint), -1)
    person, joint = np.nonzero(chosen >= 0)
    whose[chosen[person, joint]] = person
    places = np.full((*chosen.shape, 3), np.nan)
    places[person, joint] = candidates.xyz[chosen[person, joint]]
    own = np.full((*chosen.shape, len(frame.rig)), -1)
    candidate, detection = candidates.support[whose[candidates.support[:, 0]] >= 0].T
    joint, view = frame.detections.joint[detection], frame.detections.view[detection]
    own[whose[candidate], joint, view] = detection
    own = claimed(places, own, frame, exclusive=True)
    return PossiblePeople(places, own, gaps(places, own, frame))


def vote(points: PairPoints, frame: Frame) -> Candidates:
    """Cluster the points of each joint around the most confident ones (the paper's set S_i): pick
    the most confident point and all within rho, remove them, and repeat.
    """
    found, views = frame.detections, len(frame.rig)
    seed = np.full(len(points.joint), -1)
    _cluster(np.lexsort((-points.score, points.joint)), points.xyz, points.joint, _RADIUS_M, seed)
    _, first, cluster, votes = np.unique(
        seed, return_index=True, return_inverse=True, return_counts=True
    )
    joint = points.joint[first]
    kept = votes >= min(_VOTES, views * (views - 1) // 2)
    kept &= best_of(joint, _MOST_CANDIDATES, (-votes,))
    number = np.where(kept, np.cumsum(kept) - 1, -1)[cluster]
    points_of = number >= 0
    number, pair, count = number[points_of], points.pair[points_of], int(kept.sum())
    total = [np.bincount(number, x, count) for x in points.xyz[points_of].T]
    # Of each view the detection with most points; on a tie the more confident one.
    key, uses = np.unique(np.repeat(number, 2) * len(found) + pair.ravel(), return_counts=True)
    owner, detection = np.divmod(key, max(len(found), 1))
    best = np.lexsort((-found.confidence[detection], -uses, found.view[detection], owner))
    owner, detection = owner[best], detection[best]
    _, one = np.unique(owner * views + found.view[detection], return_index=True)
    owner, detection = owner[one], detection[one]
    score = np.bincount(owner, found.confidence[detection], count) / np.bincount(
        owner, minlength=count
    )
    xyz = np.stack(total, axis=1) / votes[kept][:, None]
    return Candidates(xyz, joint[kept], score, np.column_stack([owner, detection]))


def anchors(candidates: Candidates, frame: Frame) -> Index:
    """Hip candidates with enough parts in their box, after non-maximum suppression, best first."""
    skeleton, up = frame.skeleton, frame.rig.up_vector
    hips = np.flatnonzero(candidates.joint == skeleton.root)
    offset = candidates.xyz - candidates.xyz[hips, None]
    height = offset @ up
    across = np.linalg.norm(offset - height[..., None] * up, axis=-1)
    hip, inside = np.nonzero((across < _BOX_M[0]) & (np.abs(height) < _BOX_M[1]))
    best = np.zeros((len(hips), len(skeleton)))
    np.maximum.at(best, (hip, candidates.joint[inside]), candidates.score[inside])
    core = best[:, list(skeleton.core)]
    enough = (core > 0).mean(axis=1) >= _PARTS
    kept = list[int]()
    for hip in hips[enough][np.argsort(-core[enough].sum(axis=1), kind="stable")].tolist():
        apart = np.linalg.norm(candidates.xyz[kept] - candidates.xyz[hip], axis=1)
        if (apart >= _APART_M).all():
            kept.append(hip)
    return np.array(kept, dtype=np.intp)


def grown(hips: Index, candidates: Candidates, frame: Frame) -> Index:
    """Candidate (P, J) of each person's joint, -1 for none: from the `hips` (P,) outwards, those
    that part affinities link to the joints beside them.
    """
    from scipy.sparse import csr_array  # imported here because it takes a sixth of a second

    found, skeleton = frame.detections, frame.skeleton
    size, (owner, detection) = len(candidates.joint), candidates.support.T
    supports = csr_array((np.ones(len(owner)), (owner, detection)), (size, len(found)))
    affinity = csr_array((found.affinity, found.pairs.T), (len(found), len(found)))
    sees = csr_array((np.ones(len(owner)), (owner, found.view[detection])), (size, len(frame.rig)))
    links = supports @ (affinity + affinity.T) @ supports.T
    # Views that see both ends but give no affinity contradict the limb, too.
    links = links - _DOUBT * (sees @ sees.T).multiply(links > 0)
    first, second = links.nonzero()
    apart = np.linalg.norm(candidates.xyz[first] - candidates.xyz[second], axis=1)
    links[first[apart > _LIMB_M], second[apart > _LIMB_M]] = 0.0
    views = _VIEW * np.bincount(owner, found.confidence[detection], size)
    chosen = np.full((len(hips), len(skeleton)), -1)
    chosen[:, skeleton.root] = hips
    for level in _SWEEPS * skeleton.tree_levels[1:]:
        chosen[:, level] = -1
        person, joint = np.nonzero(chosen >= 0)
        own = csr_array((np.ones(len(person)), (person, chosen[person, joint])), (len(hips), size))
        linked = np.where(np.isin(candidates.joint, level), (own @ links).toarray(), 0.0)
        person, which = np.nonzero(linked > 0)
        joint = candidates.joint[which]
        slot = person * len(skeleton) + joint
        picked = match_best_first(slot, which, linked[person, which] + views[which])
        chosen[person[picked], joint[picked]] = which[picked]
    return chosen


@kernel("i1 f2 i1 f0 i1")
def _cluster(order, xyz, joint, radius_m, seed):
    """Fill in `seed` (M,), the most confident point of each point's cluster, -1 before; `order`
    (M,) sorts the points by joint, then by falling confidence.
    """
    for n in range(len(order)):
        i = order[n]
        if seed[i] >= 0:
            continue
        for m in range(n, len(order)):
            j, squared = order[m], 0.0
            if joint[j] != joint[i]:
                break
            for x in range(3):
                squared += (xyz[i, x] - xyz[j, x]) ** 2
            if seed[j] < 0 and squared <= radius_m * radius_m:
                seed[j] = i
