"""Who was there, by evidence: what only a person explains, against what should have been seen of that person."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from shapepose_fg.core.arrays import Array, Index, Mask, Real, Whole
from shapepose_fg.core.camera import Rig, beside_segment
from shapepose_fg.core.detections import Detections
from shapepose_fg.core.skeleton import Skeleton
from shapepose_fg.proposal.claims import mean_affinity, owned

_PRICE = 0.4
"""What a place costs where a joint should be seen and is not, in places that are seen: the price of being there is
the mean over a person's places, in seconds in which every joint is seen by every view."""
_PRICE_HIDDEN = 0.05
"""The same behind somebody else, and of a joint whose place is not known. With these a person is believed in of
whom a fourth of what nobody hides has detections of their own. In simulated crowds of eight before three cameras
(seeds 6101, 6104) joints that nobody hides have a detection in 76 of 100 places, those behind a limb in 20."""
_LIMB_M = 0.12
"""A joint is hidden whose ray passes somebody's limb, or spine, this near."""
_IN_FRONT_M = 0.15
"""And is this much farther from the camera: nearer, which of them is in front is not known."""
_SURE_AFFINITY = 0.6
"""Mean affinity to the person's other detections from which on a detection counts wholly."""
_ALONE = 0.5
"""What a detection counts whose neighbours on the skeleton nobody saw: affinities say nothing of it."""
_APPEARS_S = 0.125
"""What it costs to appear or vanish while others are watched, as much as not being seen in plain view for 0.3
seconds: people are where they were, and nobody comes out of nothing."""
_WORLDS = 8
"""How many worlds are tried as those that come first, the most promising ones."""
_LEAST_S = 0.1
"""Least evidence of a person, seconds; of less than 0.4 seconds of frames a quarter of their time."""
_ON_TRIAL = 0.25
"""Share of `_APPEARS_S` and `_LEAST_S` that is enough for people who are followed again: who is with them in one
world may leave them more."""
_SCALE, _PRIOR = 13.7, -0.6
"""Evidence to log-odds, and those of a person without any: logistic fit to 482 people, of whom 11 were nobody or
somebody once more, in simulated crowds, crossings and pairs before two to four cameras. How long somebody is there
says nothing more. Of 364 others, said to be 0.74 / 0.87 / 0.96 / 0.996, 8 of 11, 19 of 20, 70 of 70 and 263 of 263
were there."""


@dataclass(frozen=True)
class Chosen:
    """K people and from when to when they are there, in the order in which they were chosen, best first."""

    hypothesis: Index
    """(K,) which hypothesis."""
    start: Index
    """(K,) index of the first frame."""
    stop: Index
    """(K,) the one after the last."""
    evidence_s: Array
    """(K,) evidence, in seconds in which all of a person is seen by all views; what being there costs taken
    off."""

    def __len__(self) -> int:
        return len(self.hypothesis)

    def during(self, frame: int) -> Mask:
        """(K,) who is there in a frame."""
        return (self.start <= frame) & (frame < self.stop)


def weighed(
    candidate: Index, places: Array, detections: Detections, rig: Rig, skeleton: Skeleton, world: Index
) -> tuple[Array, Array]:
    """What each detection of A people counts (A, J, V), and what being there costs (A,), both as shares of the
    places where they should be seen.

    `candidate` (A, J, V) are detections of one frame, -1 for none, `places` (A, J, 3) the joints, metres, NaN
    where unknown; people of the same `world` (A,) hide each other. A detection counts by its affinity to the same
    person's others, and pays for its place. A place is a joint in the picture of a view; joints whose place is
    unknown are thought to be where the others are in the mean.
    """
    known = np.asarray(np.isfinite(places).all(axis=-1))[..., None]
    centre = np.where(known, places, 0.0).sum(axis=1) / np.maximum(known.sum(axis=1), 1)
    xy, depth = rig.project(np.where(known, places, centre[:, None]))
    inside = ((xy >= 0) & (xy < rig.image_sizes[:, None, None])).all(axis=-1) & (depth > 0)
    expected = np.maximum(inside.sum(axis=(0, 2)), 1)
    hidden = ~known[..., 0] | _behind_others(xy, depth, known[..., 0], rig, skeleton, world)
    price = np.where(inside, np.where(hidden, _PRICE_HIDDEN, _PRICE), 0.0)
    weight = np.zeros(candidate.shape)
    seen = candidate >= 0
    if seen.any():
        affinity, neighbours = mean_affinity(owned(candidate, len(detections)), detections, skeleton, len(rig))
        counts = np.where(neighbours > 0, np.clip(affinity / _SURE_AFFINITY, 0.0, 1.0), _ALONE)
        weight[seen] = counts[np.nonzero(seen)[0], candidate[seen]]
    weight *= 1 + np.moveaxis(price, 0, 2)
    return weight / expected[:, None, None], price.sum(axis=(0, 2)) / expected


def _behind_others(xy: Array, depth: Array, known: Mask, rig: Rig, skeleton: Skeleton, world: Index) -> Mask:
    """(V, A, J) joints, at pixels (V, A, J, 2) and depths, behind a limb of somebody else of the same world.

    Limbs hide whose both ends are `known` (A, J).
    """
    core = set(skeleton.core)
    ends = np.array([(skeleton.parents[j], j) for j in skeleton.core if skeleton.parents[j] in core]).T
    away = np.where(known, depth, np.nan)
    least_m, most_m = np.fmin.reduce(away, axis=2), np.fmax.reduce(away, axis=2)
    focal_px, flat = rig.focal_px.astype(np.float32), np.where(known[..., None], xy, np.nan)
    margin = (_LIMB_M * focal_px[:, None] / np.maximum(least_m, _LIMB_M))[..., None]
    low, high = np.fmin.reduce(flat, axis=2) - margin, np.fmax.reduce(flat, axis=2) + margin
    other = (world[:, None] == world) & ~np.eye(len(world), dtype=bool)
    other = other & (low[:, :, None] < high[:, None]).all(axis=-1) & (low[:, None] < high[:, :, None]).all(axis=-1)
    view, whose, who = np.nonzero(other & (least_m[:, None] < most_m[:, :, None] - _IN_FRONT_M))
    # Everything in arrays (pairs, joints, limbs), a coordinate each: sums over an axis of two are slow.
    x, y, z = (of.astype(np.float32) for of in (flat[..., 0], flat[..., 1], away))
    first, second = ([of[view, who][:, None, end] for of in (x, y, z)] for end in ends)
    place, deep = xy[view, whose, :, None].astype(np.float32), depth[view, whose, :, None]
    squared, at = beside_segment(place[..., 0], place[..., 1], first, second)
    hides = squared * at * at < ((_LIMB_M * focal_px[view]) ** 2)[:, None, None]
    hides &= at < deep.astype(np.float32) - _IN_FRONT_M
    hidden = np.zeros(depth.shape, dtype=bool)
    pair, joint = np.nonzero(hides.any(axis=2))
    hidden[view[pair], whose[pair], joint] = True
    return hidden


def own_evidence(candidate: Whole, weight: Real, price: Real) -> Array:
    """(A,) evidence of A people in a frame, for each second that it stands for: 1 where all of a person is seen.

    Of their detections `candidate` (A, J, V), with `weight` (A, J, V) and `price` (A,) of `weighed`; a detection
    that several have is nobody's own.
    """
    owners = np.bincount(candidate[candidate >= 0], minlength=1)
    own = (candidate >= 0) & (owners[np.maximum(candidate, 0)] == 1)
    return np.where(own, weight, 0.0).sum(axis=(1, 2)) - price


def probability(evidence: float) -> float:
    """How probable somebody of so much evidence is (mean of `own_evidence` over the frames) to be there.

    That is, to be nearest to one and the same real person in more than half of the frames.
    """
    return float(1 / (1 + np.exp(-(_SCALE * evidence + _PRIOR))))


@dataclass(frozen=True)
class Account:
    """H hypotheses as detections with weights, in T frames: who of them is there is chosen from this."""

    place: Index
    """(H, T, J V) each detection's place among those of all frames; one more stands for none."""
    weight: NDArray[np.float32]
    """(H, T, J V) what it counts."""
    price: Real
    """(H, T) what being there costs."""
    there: Mask
    """(H, T) where there is something to say."""
    lasts_s: Array
    """(T,) what each frame stands for, seconds."""
    detections: int
    """How many there are."""
    begins: int
    """The first frame in which anything is seen."""
    ends: int
    """And the last."""
    least_s: float
    """Least evidence of a person, seconds."""
    appears_s: float = _APPEARS_S
    """What it costs to appear or vanish while others are watched, seconds."""

    @classmethod
    def of(
        cls, candidate: Whole, weight: Real, price: Real, there: Mask, counts: Index, lasts_s: Array
    ) -> "Account":
        """Of detections `candidate` (H, T, J, V), of `counts` (T,) in each frame, with `weight` (H, T, J, V) and
        `price` (H, T) of `weighed`.
        """
        shape = (*there.shape, candidate[0, 0].size if there.size > 0 else 0)
        first, count = np.cumsum(counts) - counts, int(counts.sum())
        place = np.where(candidate >= 0, candidate + first[:, None, None], count).reshape(shape)
        weights = np.where(candidate >= 0, weight, 0.0).reshape(shape).astype(np.float32)
        seen = np.append(np.flatnonzero(counts), 0)
        span, least_s = (int(seen[0]), int(seen.max())), min(_LEAST_S, 0.25 * float(lasts_s.sum()))
        return cls(place, weights, price, there, lasts_s, count, *span, least_s)

    def choose(self, world: Index) -> Chosen:
        """The first of `ways`."""
        return self.ways(world)[0]

    def ways(self, world: Index, *, on_trial: bool = False) -> list[Chosen]:
        """Ways to choose hypotheses, and from when to when, so that each detection is evidence of one person only.

        What explains most is the first. `world` (H,) are people who were followed together; `on_trial` takes
        those, too, who lack a little to be chosen. The best segment of the best hypothesis comes first; its
        detections are evidence of nobody else then. In other ways the people of one world come first: a hypothesis
        that goes over from one person to another, always to who is seen better, is better than either of them, and
        leaves the others with too little.
        """
        account, first = self, np.zeros(len(world), dtype=bool)
        if on_trial:
            account = replace(self, appears_s=_ON_TRIAL * self.appears_s, least_s=_ON_TRIAL * self.least_s)
        if len(world) == 0:
            return [account.in_turn(first)]
        bound = np.bincount(world, np.maximum(account.best_segments(account.alone)[0], 0.0))
        tried = np.argsort(-bound, kind="stable")[:_WORLDS]
        found = [account.in_turn(first), *(account.in_turn(world == each) for each in tried)]
        return sorted(found, key=lambda each: -float(each.evidence_s.sum()))

    def agreement(self, one: Chosen, other: Chosen) -> float:
        """The share of the detections of `one` and `other` that are evidence of the same people in both."""
        owners = np.full((2, self.detections + 1), -1)
        for owner, chosen in zip(owners, (one, other), strict=True):
            for n, (h, start, stop) in enumerate(zip(chosen.hypothesis, chosen.start, chosen.stop, strict=True)):
                owner[self.place[h, start:stop]] = n
        owners = owners[:, :-1][:, (owners[:, :-1] >= 0).any(axis=0)]
        shared = np.zeros((len(one.start) + 1, len(other.start) + 1))
        np.add.at(shared, tuple(owners), 1.0)  # the last row and column are nobody's
        same = linear_sum_assignment(shared[:-1, :-1], maximize=True)
        return float(shared[same].sum() / owners.shape[1]) if owners.shape[1] > 0 else 1.0

    def left_over(self, chosen: Chosen) -> Chosen:
        """Who would be there besides those whom `choose` has `chosen`, if appearing cost nothing."""
        return replace(self, appears_s=0.0).in_turn(np.zeros(len(self.there), dtype=bool), chosen)

    @property
    def free(self) -> NDArray[np.float32]:
        """(D + 1,) 1 for every detection, as long as nobody has any; 0 for none."""
        return np.append(np.ones(self.detections, dtype=np.float32), np.float32(0))

    @cached_property
    def alone(self) -> Array:
        """(H, T) evidence of each hypothesis, seconds, as if there were no other."""
        return self.gains(self.free, slice(0, len(self.lasts_s)))

    def gains(self, free: NDArray[np.float32], span: slice) -> Array:
        """(H, S) evidence of each hypothesis in the frames of `span`, seconds, of detections that are `free`."""
        share = np.einsum("htk,htk->ht", self.weight[:, span], free[self.place[:, span]])
        return np.where(self.there[:, span], (share - self.price[:, span]) * self.lasts_s[span], -np.inf)

    def in_turn(self, first: Mask, before: Chosen | None = None) -> Chosen:
        """People one after the other, the best of those `first` (H,) before all others, besides those `before`."""
        free, gains, chosen = self.free, self.alone.copy(), list[tuple[int, int, int, float]]()
        taken, least = np.zeros(self.there.shape, dtype=bool), self.least_s
        if before is not None:
            for h, start, stop in zip(before.hypothesis, before.start, before.stop, strict=True):
                free[self.place[h, start:stop]] = 0.0
                taken[h, start:stop] = True
            gains = np.where(taken, -np.inf, self.gains(free, slice(0, len(self.lasts_s))))
        while len(gains) > 0:
            value, start, stop = self.best_segments(gains)
            if first.any() and value[first].max() < least:
                first = np.zeros_like(first)
            best = int(np.where(first | ~first.any(), value, -np.inf).argmax())
            if value[best] < least:
                break
            span = slice(int(start[best]), int(stop[best]))
            chosen.append((best, span.start, span.stop, float(value[best])))
            free[self.place[best, span]] = 0.0
            taken[best, span] = True
            gains[:, span] = np.where(taken[:, span], -np.inf, self.gains(free, span))
        columns = np.array(chosen, dtype=np.float64).reshape(-1, 4).T
        hypothesis, start, stop = columns[:3].astype(np.intp)
        return Chosen(hypothesis, start, stop, columns[3])

    def best_segments(self, gains: Array) -> tuple[Array, Index, Index]:
        """The segment with the greatest sum of each row of `gains` (H, T): value (H,), start (H,), stop (H,).

        Where a segment begins after the first frame in which anything is seen, or stops before the last, it costs
        `appears_s` each. No part of it costs more than to vanish and to appear again.
        """
        H, T = gains.shape
        running, peak, since = np.full(H, -np.inf), np.full(H, -np.inf), np.zeros(H, dtype=np.intp)
        value, start, stop = np.full(H, -np.inf), np.zeros(H, dtype=np.intp), np.zeros(H, dtype=np.intp)
        for t in range(T):
            afresh = -self.appears_s if t > self.begins else 0.0
            begins = running < np.maximum(afresh, peak - 2 * self.appears_s)
            since = np.where(begins, t, since)
            running = np.where(begins, afresh, running) + gains[:, t]
            peak = np.where(begins, running, np.maximum(peak, running))
            ends = running - (self.appears_s if t < self.ends else 0.0)
            better = ends > value
            value, start, stop = (
                np.where(better, ends, value),
                np.where(better, since, start),
                np.where(better, t + 1, stop),
            )
        return value, start, stop
