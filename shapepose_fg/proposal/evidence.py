"""How probable it is that somebody is there: what only this person explains, against what should be seen."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.proposal.association import mean_affinity, owned
from shapepose_fg.proposal.hypotheses import Array, Frame, Hypotheses

_GAP_M = 0.03
"""How a detection's worth falls off with the gap between its ray and the joint: sigma of a Gaussian."""
_SINGLE = 0.1
"""What a detection counts whose joint no other view sees: the person may be anywhere along it."""
_BESIDE = 0.5
"""What one counts whose joint's other detections are somebody else's."""
_MISSED = 0.2
"""Price of a place where a joint should be seen and is not, in a view that sees the person else."""
_HIDDEN = 0.07
"""The same in a view that does not see the person at all: there may be something in between."""
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
_UNAFFILIATED = 0.3
"""Affinity of a detection none of whose neighbours is seen, which says nothing."""


@dataclass(frozen=True)
class Evidence:
    """What speaks for and against each of H people, but for what others explain."""

    chosen: NDArray[np.intp]
    """(H, J, V) the detections that each explains, -1 for none."""
    worth: Array
    """(H, J, V) how much a detection speaks for the person: confidence, affinity, and how near its ray passes."""
    expected: NDArray[np.bool_]
    """(H, J, V) places in the pictures where a joint should be."""
    bones: Array
    """(H,) how much the lengths of the bones speak for a person."""

    @classmethod
    def of(cls, people: Hypotheses, frame: Frame) -> "Evidence":
        """The evidence of a frame."""
        chosen, detections = people.chosen, frame.detections
        has, rows = chosen >= 0, np.arange(len(people))[:, None, None]
        affinity, neighbours = mean_affinity(
            owned(chosen, len(detections)), detections, frame.skeleton, len(frame.rig)
        )
        affinity = np.where(neighbours > 0, affinity, _UNAFFILIATED)
        near = np.exp(-0.5 * (np.nan_to_num(people.gap_m, posinf=1.0) / _GAP_M) ** 2)
        some = len(detections) > 0
        worth = detections.confidence[chosen] * affinity[rows, chosen] * near if some else np.zeros(has.shape)
        xy, depth = frame.rig.project(people.places)
        size = frame.rig.image_sizes[:, None, None]
        inside = np.moveaxis((depth > 0) & ((xy >= 0) & (xy < size)).all(axis=-1), 0, 2)
        expected = inside & has.any(axis=2, keepdims=True)
        return cls(chosen, np.where(has, worth, 0.0), expected, _bones(people, frame))

    def score(self, taken: NDArray[np.bool_]) -> Array:
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


def _bones(people: Hypotheses, frame: Frame) -> Array:
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
