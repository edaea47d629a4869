"""Selection of people among hypotheses by evidence; each detection is explained once.

Evidence is what only this person explains, less what should be seen of the person and is not.
"""

from dataclasses import dataclass

import numpy as np

from shapepose_fg.core.arrays import Array, Index, Mask
from shapepose_fg.proposal.candidates import PairPoints
from shapepose_fg.proposal.nearby import LEAST_AFFINITY, own_affinity
from shapepose_fg.proposal.pairs_of_people import pooled
from shapepose_fg.proposal.possible_people import DETECTOR_M, Frame, PossiblePeople, settled

_SHARED = 0.2
"""Maximum share of its joints that a missing part may have in common with the person it
completes."""
_SCALE = 0.27
"""Scale from evidence to log-odds: logistic fit to 1561 hypotheses on simulated crowds (two to six
cameras); a fit to 1240 in the real operating room of MVOR gives 0.23."""
_PRIOR = -1.75
"""Log-odds of a hypothesis without evidence; the same fit (-1.2 in the operating room)."""
PRIOR_WITH_BODY = -0.3
"""Log-odds of a hypothesis without evidence, after a body fit and reassociation of detections."""
_SINGLE = 0.1
"""Weight of a detection of a joint that no other view sees, since its depth is unknown."""
_MISSED = 0.2
"""Cost of an expected but missing joint, in a view that sees other joints of the person."""
_HIDDEN = 0.07
"""Cost of a missing joint in a view that does not see the person at all, who may be occluded."""
_BROKEN = 0.5
"""Cost of a bone outside the range of human bones."""
_SHORT, _LONG = 0.4, 1.15
"""Range of human bones, as shares of the maximum length."""
_USUAL = 0.59
"""Mean length of bones, as a share of the maximum length: 0.53 to 0.64 for core bones of simulated
people."""
_SPREAD, _PHANTOMS_SPREAD = 0.08, 0.35
"""Standard deviation of the logarithm of a bone's length, for people and for false positives."""
_ASTRAY = 0.1
"""Share of people's bones distributed like those of false positives, because a joint is wrong. All
these are from 5779 hypotheses of simulated crowds with two to six cameras."""
_BONE = 0.15
"""Weight of a bone's log-likelihood ratio; bones are not independent. In crowds with three to six
cameras it finds 1 to 4 points more people with fewer false positives, while 0.3 and 0.6 give more
of these."""


@dataclass(frozen=True)
class Evidence:
    """Evidence for and against each of H hypotheses, before any detection is assigned to others."""

    chosen: Index
    """(H, J, V) the detections that each hypothesis explains, -1 for none."""
    weight: Array
    """(H, J, V) weight of each detection: confidence, affinity, and nearness of its ray."""
    expected: Mask
    """(H, J, V) whether the joint is expected in the image."""
    bones: Array
    """(H,) log-likelihood ratio of the bone lengths, weighted."""

    @classmethod
    def of(cls, people: PossiblePeople, frame: Frame) -> "Evidence":
        """Compute the evidence for hypotheses in a frame."""
        chosen, detections = people.chosen, frame.detections
        has, weight = chosen >= 0, np.zeros(chosen.shape)
        person, detection = np.ascontiguousarray(np.nonzero(has)[0]), chosen[has]
        affinity, neighbours = own_affinity(person, detection, chosen, frame.arrays)
        near = np.exp(-0.5 * (np.nan_to_num(people.gap_m[has], posinf=1.0) / DETECTOR_M) ** 2)
        weight[has] = (
            detections.confidence[detection]
            * np.where(neighbours > 0, affinity, LEAST_AFFINITY)
            * near
        )
        weight[has.sum(axis=2) < 2] *= _SINGLE
        xy, depth = frame.rig.project(people.places)
        size = frame.rig.image_sizes[:, None, None]
        inside = np.moveaxis((depth > 0) & ((xy >= 0) & (xy < size)).all(axis=-1), 0, 2)
        expected = inside & has.any(axis=2, keepdims=True)
        return cls(chosen, weight, expected, _bones(people, frame))

    def score(self, taken: Mask) -> Array:
        """(H,) score of each hypothesis if others explain the detections `taken` (D,)."""
        own = self.chosen >= 0
        own = own & ~taken[self.chosen] if len(taken) > 0 else own
        evidence = (self.weight * own).sum(axis=(1, 2))
        seen = (own & self.expected).sum(axis=1) / np.maximum(self.expected.sum(axis=1), 1)
        missed = (self.expected & ~own).sum(axis=1)
        cost = (missed * (_MISSED * seen + _HIDDEN * (1 - seen))).sum(axis=1)
        return np.asarray(evidence + self.bones - cost, dtype=np.float64)


def _bones(people: PossiblePeople, frame: Frame) -> Array:
    """(H,) weighted log-likelihood ratio of the lengths of bones between joints that
    two views see.
    """
    parents, root = list(frame.skeleton.parents), frame.skeleton.root
    share = np.linalg.norm(people.places - people.places[:, parents], axis=-1) / frame.longest_m
    share[:, root] = np.nan
    broken = ((share > _LONG) | (share < _SHORT)).sum(axis=1)
    twice = (people.chosen >= 0).sum(axis=2) >= 2
    core = [joint for joint in frame.skeleton.core if joint != root]
    known = (twice & twice[:, parents])[:, core]
    off = np.log(np.maximum(share[:, core], 1e-3) / _USUAL)
    sigma = np.hypot(_SPREAD, DETECTOR_M / (_USUAL * frame.longest_m[core]))
    of_people = np.exp(-0.5 * (off / sigma) ** 2) / sigma
    phantoms = np.exp(-0.5 * (off / _PHANTOMS_SPREAD) ** 2) / _PHANTOMS_SPREAD
    # Far from both distributions `of_people` vanishes, and `_ASTRAY` bounds the ratio.
    ratio = (1 - _ASTRAY) * of_people / np.maximum(phantoms, 1e-300) + _ASTRAY
    return np.asarray(
        _BONE * np.log(ratio).sum(axis=1, where=known) - _BROKEN * broken, dtype=np.float64
    )


def probability(score: Array, prior: float = _PRIOR) -> Array:
    """(H,) existence probability by score (H,)."""
    return 1 / (1 + np.exp(-(_SCALE * score + prior)))


def choose(points: PairPoints, frame: Frame, least: float) -> tuple[PossiblePeople, Array]:
    """Select the people of a frame with probability at least `least`; also returns their
    probabilities (P,).
    """
    people, probability = PossiblePeople.none(frame), np.zeros(0)
    # Maximum number of searches, each among what the people found so far leave unexplained.
    for _ in range(8):
        taken = np.zeros(len(frame.detections), dtype=bool)
        taken[people.chosen[people.chosen >= 0]] = True
        pool = pooled(points, ~taken, frame)
        more = _greedy(pool, people, taken, frame, least)
        if more is None:
            break
        people, probability = _assigned_once(more, frame, least)
    return people, probability


def _greedy(
    pool: PossiblePeople, people: PossiblePeople, taken: Mask, frame: Frame, least: float
) -> PossiblePeople | None:
    """Add hypotheses from the pool to `people`, who use the detections `taken` (D,), most probable
    first; None if there is none to add.

    A hypothesis that fits as a missing part of a person completes that person.
    """
    evidence, taken, before = Evidence.of(pool, frame), taken.copy(), people
    open_ = np.ones(len(pool), dtype=bool)
    while open_.any():  # one person or part per iteration
        score = np.where(open_, evidence.score(taken), -np.inf)
        best = np.array([score.argmax()])
        if probability(score[best])[0] < least:
            break
        open_[best] = False
        new = pool.rows(best)
        taken[new.chosen[new.chosen >= 0]] = True
        whole = _whole(new.places[0], people.places, frame)
        people = (
            PossiblePeople.concatenate([people, new])
            if whole is None
            else people.completed(whole, new)
        )
    return None if people is before else people


def _assigned_once(
    people: PossiblePeople, frame: Frame, least: float
) -> tuple[PossiblePeople, Array]:
    """Assign each detection to one of the people; drops people with too little evidence, the least
    probable first.
    """
    while True:
        # Number of reassignments of detections around the joints of selected people.
        people = settled(people.places, people.chosen, frame, 2, exclusive=True)
        probability = existence(people, frame)
        if len(people) == 0 or probability.min() >= least:
            return people, probability
        people = people.rows(np.arange(len(people)) != probability.argmin())


def existence(people: PossiblePeople, frame: Frame, prior: float = _PRIOR) -> Array:
    """(P,) existence probability of each person; shared detections are not evidence."""
    owners = np.bincount(people.chosen[people.chosen >= 0], minlength=len(frame.detections))
    return probability(Evidence.of(people, frame).score(owners > 1), prior)


def _whole(places: Array, people: Array, frame: Frame) -> int | None:
    """Index of the person among `people` (P, J, 3) that lacks the part `places` (J, 3), e.g. legs
    of a trunk; None for none.

    Part and person share few joints, and bones could connect them. For two real people this does
    not hold.
    """
    has, of = np.isfinite(places[:, 0]), np.isfinite(people[..., 0])
    pairs, most = frame.spans
    one, other = np.concatenate([pairs, pairs[:, ::-1]]).T
    reach = np.linalg.norm(places[one] - people[:, other], axis=-1) / np.tile(most, 2)
    nearest = np.nan_to_num(reach, nan=np.inf).min(axis=1, initial=np.inf)
    nearest[(of & has).sum(axis=1) > _SHARED * has.sum()] = np.inf
    return int(nearest.argmin()) if (nearest < 1).any() else None
