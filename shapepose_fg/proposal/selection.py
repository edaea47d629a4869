"""Who is there: hypotheses chosen by evidence, each detection explained once.

Evidence is what only this person explains, against what should be seen of that person and is not.
"""

from dataclasses import dataclass

import numpy as np

from shapepose_fg.core.arrays import Array, Index, Mask
from shapepose_fg.proposal.candidates import PairPoints
from shapepose_fg.proposal.nearby import LEAST_AFFINITY, own_affinity
from shapepose_fg.proposal.pairs_of_people import pooled
from shapepose_fg.proposal.possible_people import Frame, PossiblePeople, settled

_ROUNDS = 8
"""How often people are sought at most, among what those who were found leave: 2D people are put together anew."""
_PASSES = 2
"""How often detections are given out around the joints of those who were chosen."""
_SHARED = 0.2
"""Largest share of its joints that a missing part may have in common with the person that it completes."""
_SCALE = 0.27
"""Evidence to log-odds: logistic fit to 1561 hypotheses on simulated crowds (two to six cameras); 1240 on the real
operating room of MVOR gave 0.23."""
_PRIOR = -1.75
"""Log-odds of a hypothesis without evidence; the same fit (-1.2 in the operating room)."""
PRIOR_WITH_BODY = -0.3
"""Log-odds of a hypothesis without evidence, after a body was fitted to its joints and detections reassociated."""
_GAP_M = 0.03
"""How a detection's worth falls off with the gap between its ray and the joint: sigma of a Gaussian."""
_SINGLE = 0.1
"""What a detection counts whose joint no other view sees: the person may be anywhere along it."""
_BESIDE = 0.5
"""What one counts whose joint's other detections are somebody else's."""
_MISSED = 0.2
"""Price of a place where a joint should be seen and is not, in a view that sees the person else."""
_HIDDEN = 0.07
"""Price of such a place in a view that does not see the person at all: something may hide the person."""
_TAKEN = 0.07
"""Price of a detection that is better explained by somebody else."""
_BROKEN = 0.5
"""Price of a bone that is longer or shorter than people's."""
_SHORT, _LONG = 0.4, 1.15
"""Lengths of a bone that nobody has, as shares of its longest."""
_USUAL = 0.59
"""Length of people's bones, as a share of the longest: simulated people's core bones have 0.53 to 0.64."""
_SPREAD, _PHANTOMS_SPREAD = 0.08, 0.35
"""Sigma of its logarithm, in people and in phantoms."""
_PHANTOMS_SHIFT = 0.08
"""Phantoms' bones are longer by this, in the logarithm."""
_PLACED_M = 0.03
"""What two joints' errors add to a bone's sigma."""
_ASTRAY = 0.1
"""Share of people's bones that have phantoms' lengths: a joint is wrong. All these from 5779 hypotheses of
simulated crowds before two to six cameras."""
_BONE = 0.15
"""What a unit of a bone's log-likelihood counts: bones are not independent. In crowds before three to six
cameras 1 to 4 points more people are found than without, with fewer phantoms, which 0.3 and 0.6 make again."""


@dataclass(frozen=True)
class Evidence:
    """What speaks for and against each of H people, but for what others explain."""

    chosen: Index
    """(H, J, V) the detections that each explains, -1 for none."""
    worth: Array
    """(H, J, V) how much a detection speaks for the person: confidence, affinity, and how near its ray passes."""
    expected: Mask
    """(H, J, V) places in the pictures where a joint should be."""
    bones: Array
    """(H,) how much the lengths of the bones speak for a person."""

    @classmethod
    def of(cls, people: PossiblePeople, frame: Frame) -> "Evidence":
        """The evidence of a frame."""
        chosen, detections = people.chosen, frame.detections
        has, worth = chosen >= 0, np.zeros(chosen.shape)
        whose, which = np.ascontiguousarray(np.nonzero(has)[0]), chosen[has]
        affinity, neighbours = own_affinity(whose, which, chosen, frame.sight)
        near = np.exp(-0.5 * (np.nan_to_num(people.gap_m[has], posinf=1.0) / _GAP_M) ** 2)
        worth[has] = detections.confidence[which] * np.where(neighbours > 0, affinity, LEAST_AFFINITY) * near
        xy, depth = frame.rig.project(people.places)
        size = frame.rig.image_sizes[:, None, None]
        inside = np.moveaxis((depth > 0) & ((xy >= 0) & (xy < size)).all(axis=-1), 0, 2)
        expected = inside & has.any(axis=2, keepdims=True)
        return cls(chosen, worth, expected, _bones(people, frame))

    def score(self, taken: Mask) -> Array:
        """(H,) evidence for each person where others explain the detections `taken` (D,)."""
        has = self.chosen >= 0
        own = has & ~taken[self.chosen] if len(taken) > 0 else has
        views, owned_views = has.sum(axis=2, keepdims=True), own.sum(axis=2, keepdims=True)
        counts = np.where(views < 2, _SINGLE, np.where(owned_views < 2, _BESIDE, 1.0))
        evidence = (self.worth * own * counts).sum(axis=(1, 2))
        seen = (own & self.expected).sum(axis=1) / np.maximum(self.expected.sum(axis=1), 1)
        missed = (self.expected & ~own).sum(axis=1)
        price = (missed * (_MISSED * seen + _HIDDEN * (1 - seen))).sum(axis=1)
        price += _TAKEN * (has & ~own).sum(axis=(1, 2))
        return np.asarray(evidence + self.bones - price, dtype=np.float64)


def _bones(people: PossiblePeople, frame: Frame) -> Array:
    """(H,) how much the lengths of bones between joints that two views see speak for each person, or against."""
    parents, root = list(frame.skeleton.parents), frame.skeleton.root
    share = np.linalg.norm(people.places - people.places[:, parents], axis=-1) / frame.longest_m
    share[:, root] = np.nan
    broken = ((share > _LONG) | (share < _SHORT)).sum(axis=1)
    twice = (people.chosen >= 0).sum(axis=2) >= 2
    core = [joint for joint in frame.skeleton.core if joint != root]
    known = (twice & twice[:, parents])[:, core]
    off = np.log(np.maximum(share[:, core], 1e-3) / _USUAL)
    sigma = np.hypot(_SPREAD, _PLACED_M / (_USUAL * frame.longest_m[core]))
    mine = np.exp(-0.5 * (off / sigma) ** 2) / sigma
    phantoms = np.exp(-0.5 * ((off - _PHANTOMS_SHIFT) / _PHANTOMS_SPREAD) ** 2) / _PHANTOMS_SPREAD
    # Far from both, the first vanishes and what is astray decides.
    ratio = (1 - _ASTRAY) * mine / np.maximum(phantoms, 1e-300) + _ASTRAY
    return np.asarray(_BONE * np.log(ratio).sum(axis=1, where=known) - _BROKEN * broken, dtype=np.float64)


def probability(score: Array, prior: float = _PRIOR) -> Array:
    """How probable it is that people of so much evidence (H,) are there."""
    return 1 / (1 + np.exp(-(_SCALE * score + prior)))


def choose(points: PairPoints, frame: Frame, least: float) -> tuple[PossiblePeople, Array]:
    """The people of a frame who are there with a probability of at least `least`, and these probabilities (P,)."""
    people, sure = PossiblePeople.none(frame), np.zeros(0)
    for _ in range(_ROUNDS):
        taken = np.zeros(len(frame.detections), dtype=bool)
        taken[people.chosen[people.chosen >= 0]] = True
        pool = pooled(points, ~taken, frame)
        more = _greedy(pool, people, taken, frame, least)
        if more is None:
            break
        people, sure = _given_out(more, frame, least)
    return people, sure


def _greedy(
    pool: PossiblePeople, people: PossiblePeople, taken: Mask, frame: Frame, least: float
) -> PossiblePeople | None:
    """`people`, who have the detections `taken` (D,), and who else of the pool is there, the surest first.

    Who can be a missing part of somebody becomes that. None where nobody is there besides.
    """
    evidence, taken, before = Evidence.of(pool, frame), taken.copy(), people
    open_ = np.ones(len(pool), dtype=bool)
    while open_.any():  # once a person or part
        score = np.where(open_, evidence.score(taken), -np.inf)
        best = np.array([score.argmax()])
        if probability(score[best])[0] < least:
            break
        open_[best] = False
        new = pool.rows(best)
        taken[new.chosen[new.chosen >= 0]] = True
        whole = _whole(new.places[0], people.places, frame)
        people = PossiblePeople.concatenate([people, new]) if whole is None else people.completed(whole, new)
    return None if people is before else people


def _given_out(people: PossiblePeople, frame: Frame, least: float) -> tuple[PossiblePeople, Array]:
    """The people with each detection given to one of them; who has too little goes, the least sure first."""
    while True:
        people = settled(people.places, people.chosen, frame, _PASSES, exclusive=True)
        sure = existence(people, frame)
        if len(people) == 0 or sure.min() >= least:
            return people, sure
        people = people.rows(np.arange(len(people)) != sure.argmin())


def existence(people: PossiblePeople, frame: Frame, prior: float = _PRIOR) -> Array:
    """(P,) how probable each of the people is, where what two explain is nobody's own."""
    owners = np.bincount(people.chosen[people.chosen >= 0], minlength=len(frame.detections))
    return probability(Evidence.of(people, frame).score(owners > 1), prior)


def _whole(places: Array, people: Array, frame: Frame) -> int | None:
    """Which of `people` (P, J, 3) has `places` (J, 3) as a missing part, legs of a trunk, say; None for nobody.

    They have hardly a joint in common, and bones would connect them. Two real people have both.
    """
    has, of = np.isfinite(places[:, 0]), np.isfinite(people[..., 0])
    pairs, most = frame.spans
    one, other = np.concatenate([pairs, pairs[:, ::-1]]).T
    reach = np.linalg.norm(places[one] - people[:, other], axis=-1) / np.tile(most, 2)
    nearest = np.nan_to_num(reach, nan=np.inf).min(axis=1, initial=np.inf)
    nearest[(of & has).sum(axis=1) > _SHARED * has.sum()] = np.inf
    return int(nearest.argmin()) if (nearest < 1).any() else None
