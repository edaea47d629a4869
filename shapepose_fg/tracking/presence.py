"""Who was there, by evidence: what only a person explains, against what should have been seen of that person."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from shapepose_fg.core.arrays import Array, Index, Mask, Real, Whole
from shapepose_fg.core.camera import Rig
from shapepose_fg.core.compiled import kernel
from shapepose_fg.core.detections import Detections
from shapepose_fg.core.skeleton import Skeleton
from shapepose_fg.tracking.view_assignment import own_affinity

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
    affinity, neighbours = own_affinity(candidate, detections, skeleton)
    counts = np.where(neighbours > 0, np.clip(affinity / _SURE_AFFINITY, 0.0, 1.0), _ALONE)
    weight, price = np.where(candidate >= 0, counts, 0.0), np.zeros(len(candidate))
    core = set(skeleton.core)
    limbs = np.array([(skeleton.parents[j], j) for j in skeleton.core if skeleton.parents[j] in core])
    _weigh(places, world, rig.K @ rig.cTw, rig.focal_px, rig.image_sizes, limbs, weight, price)
    return weight, price


@kernel
def _weigh(places, world, P, focal, sizes, limbs, weight, price):
    """Make what detections count, `weight` (A, J, V), a share of the places; fill in `price` (A,)."""
    people, joints, views = weight.shape
    x, y, depth = np.empty((people, joints)), np.empty((people, joints)), np.empty((people, joints))
    known, hidden = np.empty((people, joints), dtype=np.bool_), np.empty((people, joints), dtype=np.bool_)
    expected, box = np.zeros(people), np.empty((people, 6))
    for v in range(views):
        for a in range(people):
            _pictured(places[a], P[v], x[a], y[a], depth[a], known[a])
            hidden[a] = ~known[a]
            _enclose(x[a], y[a], depth[a], known[a], focal[v], box[a])
        for a in range(people):
            for b in range(people):
                if a != b and world[a] == world[b]:
                    _hide(x, y, depth, known, box, a, b, focal[v], limbs, hidden[a])
            for j in range(joints):
                if depth[a, j] > 0 and 0 <= x[a, j] < sizes[v, 0] and 0 <= y[a, j] < sizes[v, 1]:
                    cost = _PRICE_HIDDEN if hidden[a, j] else _PRICE
                    weight[a, j, v] *= 1 + cost
                    price[a] += cost
                    expected[a] += 1.0
    for a in range(people):
        price[a] /= max(expected[a], 1.0)
        weight[a] /= max(expected[a], 1.0)


@kernel
def _pictured(places, P, x, y, depth, known):
    """Pixels and depths of joints in a view, NaN pixels behind it; unknown joints are amidst the others."""
    centre, count = np.zeros(3), 0
    for j in range(len(places)):
        known[j] = np.isfinite(places[j, 0] + places[j, 1] + places[j, 2])
        if known[j]:
            centre += places[j]
            count += 1
    centre /= max(count, 1)
    for j in range(len(places)):
        at = places[j] if known[j] else centre
        depth[j] = P[2, 0] * at[0] + P[2, 1] * at[1] + P[2, 2] * at[2] + P[2, 3]
        over = 1.0 / depth[j] if depth[j] > 0 else np.nan
        x[j] = (P[0, 0] * at[0] + P[0, 1] * at[1] + P[0, 2] * at[2] + P[0, 3]) * over
        y[j] = (P[1, 0] * at[0] + P[1, 1] * at[1] + P[1, 2] * at[2] + P[1, 3]) * over


@kernel
def _enclose(x, y, depth, known, focal, box):
    """What known joints are between: left and right, top and bottom, with a limb's width, then near and far."""
    box[0] = box[2] = box[4] = np.inf
    box[1] = box[3] = box[5] = -np.inf
    for j in range(len(x)):
        if known[j]:
            box[4], box[5] = min(box[4], depth[j]), max(box[5], depth[j])
            if depth[j] > 0:
                box[0], box[1] = min(box[0], x[j]), max(box[1], x[j])
                box[2], box[3] = min(box[2], y[j]), max(box[3], y[j])
    margin = _LIMB_M * focal / max(box[4], _LIMB_M)
    for low in (0, 2):
        box[low] -= margin
        box[low + 1] += margin


@kernel
def _hide(x, y, depth, known, box, a, b, focal, limbs, hidden):
    """Mark the joints of `a` that are behind a limb of `b` in a view; limbs hide whose both ends are known."""
    near, far = box[b], box[a]
    if not (near[0] < far[1] and far[0] < near[1] and near[2] < far[3] and far[2] < near[3]):
        return
    for j in range(len(hidden)):
        behind = depth[a, j] - _IN_FRONT_M
        if hidden[j] or not (near[4] < behind and near[0] < x[a, j] < near[1] and near[2] < y[a, j] < near[3]):
            continue
        for limb in limbs:
            one, two = limb[0], limb[1]
            if not (known[b, one] and known[b, two]):
                continue
            to_x, to_y = x[a, j] - x[b, one], y[a, j] - y[b, one]
            dx, dy = x[b, two] - x[b, one], y[b, two] - y[b, one]
            along = min(max((to_x * dx + to_y * dy) / max(dx * dx + dy * dy, 1e-6), 0.0), 1.0)
            to_x, to_y = to_x - along * dx, to_y - along * dy
            at = depth[b, one] + along * (depth[b, two] - depth[b, one])
            if (to_x * to_x + to_y * to_y) * at * at < (_LIMB_M * focal) ** 2 and at < behind:
                hidden[j] = True
                break


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
    price: Array
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
        return cls(place, weights, np.asarray(price, dtype=np.float64), there, lasts_s, count, *span, least_s)

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
        first, asked = np.zeros(len(world), dtype=bool), _ON_TRIAL if on_trial else 1.0
        if len(world) == 0:
            return [self.in_turn(first)]
        best_s = np.array([_best_segment(gains, *self._borders(asked))[0] for gains in self.alone])
        bound = np.bincount(world, np.maximum(best_s, 0.0))
        tried = np.argsort(-bound, kind="stable")[:_WORLDS]
        found = [self.in_turn(each, asked) for each in (first, *(world == each for each in tried))]
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
        return self.in_turn(np.zeros(len(self.there), dtype=bool), besides=chosen)

    def _borders(self, asked: float) -> tuple[float, int, int]:
        """What it costs to appear or vanish, if a share of that is `asked` for, and between which frames."""
        return asked * _APPEARS_S, self.begins, self.ends

    @cached_property
    def alone(self) -> Array:
        """(H, T) evidence of each hypothesis, seconds, as if there were no other."""
        share = self.weight.sum(axis=2, dtype=np.float64)
        return np.where(self.there, (share - self.price) * self.lasts_s, -np.inf)

    @cached_property
    def holders(self) -> tuple[Index, Index, Array]:
        """Where those who have each detection begin, (D + 1,), who they are, and what it counts for them, one
        detection after the other.
        """
        return _holders(self.place, self.weight, self.detections)

    def in_turn(self, first: Mask, asked: float = 1.0, besides: Chosen | None = None) -> Chosen:
        """People one after the other, the best of those `first` (H,) before all others: so many as have the least
        evidence, or the share of it that is `asked` for.

        Those `besides` come before all, and are not returned; for who comes besides them appearing costs nothing.
        """
        none = np.zeros(0, dtype=np.intp)
        before = (none, none, none) if besides is None else (besides.hypothesis, besides.start, besides.stop)
        borders, least_s = self._borders(asked if besides is None else 0.0), asked * self.least_s
        given = self.alone.copy(), self.place, *self.holders, self.lasts_s, first
        return Chosen(*_in_turn(*given, *before, *borders, least_s))


@kernel
def _holders(place, weight, detections):
    """`Account.holders` of places and weights (H, T, K)."""
    begin, each = np.zeros(detections + 2, dtype=np.intp), place.shape[1] * place.shape[2]
    flat, counts = place.reshape(-1), weight.reshape(-1)
    for d in flat:
        if d < detections:
            begin[d + 2] += 1
    for d in range(detections):
        begin[d + 2] += begin[d + 1]
    who, what = np.empty(begin[-1], dtype=np.intp), np.empty(begin[-1])
    for n in range(len(flat)):
        if flat[n] < detections:
            at = begin[flat[n] + 1]
            who[at], what[at] = n // each, counts[n]
            begin[flat[n] + 1] += 1
    return begin[:-1], who, what


@kernel
def _in_turn(
    gains, place, begin, who, what, lasts, first, besides, besides_from, besides_to, appears, begins, ends, least
):  # fmt: skip
    """Hypothesis, start, stop and evidence of those whom `Account.in_turn` chooses."""
    people, frames = gains.shape
    free, changed = np.ones(len(begin) - 1, dtype=np.bool_), np.ones(people, dtype=np.bool_)
    start, stop, value = np.zeros(people, dtype=np.intp), np.zeros(people, dtype=np.intp), np.zeros(people)
    chosen, count, evidence = np.empty((3, people * frames), dtype=np.intp), 0, np.empty(people * frames)
    for n in range(len(besides)):
        _take(besides[n], besides_from[n], besides_to[n], gains, place, begin, who, what, lasts, free, changed)
    while people > 0:
        before_all, best = False, -1
        for h in range(people):
            if changed[h]:
                value[h], start[h], stop[h] = _best_segment(gains[h], appears, begins, ends)
                changed[h] = False
            before_all = before_all or (first[h] and value[h] >= least)
        for h in range(people):
            if (first[h] or not before_all) and (best < 0 or value[h] > value[best]):
                best = h
        if value[best] < least:
            break
        chosen[0, count], chosen[1, count], chosen[2, count] = best, start[best], stop[best]
        evidence[count] = value[best]
        count += 1
        _take(best, start[best], stop[best], gains, place, begin, who, what, lasts, free, changed)
    return chosen[0, :count].copy(), chosen[1, :count].copy(), chosen[2, :count].copy(), evidence[:count].copy()


@kernel
def _take(person, start, stop, gains, place, begin, who, what, lasts, free, changed):
    """Somebody is there for some frames: their detections are evidence of nobody else."""
    changed[person] = True
    for t in range(start, stop):
        gains[person, t] = -np.inf
        for d in place[person, t]:
            if d < len(free) and free[d]:
                free[d] = False
                for n in range(begin[d], begin[d + 1]):
                    gains[who[n], t] -= what[n] * lasts[t]
                    changed[who[n]] = True


@kernel
def _best_segment(gains, appears, begins, ends):
    """The segment with the greatest sum of `gains` (T,): value, start, stop.

    Where it begins after the frame `begins`, or stops before the frame `ends`, it costs `appears` each. No part of
    it costs more than to vanish and to appear again.
    """
    running, peak, since, value, start, stop = -np.inf, -np.inf, 0, -np.inf, 0, 0
    for t in range(len(gains)):
        afresh = -appears if t > begins else 0.0
        if running < max(afresh, peak - 2 * appears):
            since, running, peak = t, afresh, -np.inf
        running += gains[t]
        peak = max(peak, running)
        closed = running - (appears if t < ends else 0.0)
        if closed > value:
            value, start, stop = closed, since, t + 1
    return value, start, stop
