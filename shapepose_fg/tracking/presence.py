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
    weight, price, seen = np.zeros(candidate.shape), np.zeros(len(candidate)), np.nonzero(candidate >= 0)
    whose = np.ascontiguousarray(seen[0])
    affinity, neighbours = own_affinity(whose, candidate[seen], candidate, detections, skeleton)
    weight[seen] = np.where(neighbours > 0, np.clip(affinity / _SURE_AFFINITY, 0.0, 1.0), _ALONE)
    core = set(skeleton.core)
    limbs = np.array([(skeleton.parents[j], j) for j in skeleton.core if skeleton.parents[j] in core])
    _weigh(places, world, rig.K @ rig.cTw, rig.focal_px, rig.image_sizes, limbs, weight, price)
    return weight, price


@kernel
def _weigh(places, world, P, focal, sizes, limbs, weight, price):
    """Make what detections count, `weight` (A, J, V), a share of the places; fill in `price` (A,)."""
    people, joints, views = weight.shape
    x, y, depth = np.empty((people, joints)), np.empty((people, joints)), np.empty((people, joints))
    expected, box, hidden = np.zeros(people), np.empty((people, 6)), np.zeros((people, joints))
    for v in range(views):
        for a in range(people):
            _pictured(places[a], P[v], focal[v], x[a], y[a], depth[a], hidden[a], box[a])
        for a in range(people):
            for b in range(people):
                if a != b and world[a] == world[b]:
                    _hide(x, y, depth, box, a, b, focal[v], limbs, places[b], hidden[a])
            for j in range(joints):
                if depth[a, j] > 0 and 0 <= x[a, j] < sizes[v, 0] and 0 <= y[a, j] < sizes[v, 1]:
                    cost = _PRICE_HIDDEN if hidden[a, j] > 0 else _PRICE
                    weight[a, j, v] *= 1 + cost
                    price[a] += cost
                    expected[a] += 1.0
    for a in range(people):
        over = 1.0 / expected[a] if expected[a] > 0 else 1.0
        price[a] *= over
        for j in range(joints):
            for v in range(views):
                weight[a, j, v] *= over


@kernel
def _pictured(places, P, focal, x, y, depth, hidden, box):
    """Pixels and depths of joints in a view, NaN pixels behind it; unknown joints are amidst others, and hidden.

    `box` (6,): what known joints are between, left and right, top and bottom, with a limb's width, near and far.
    """
    cx, cy, cz, count = 0.0, 0.0, 0.0, 0.0
    for side in range(0, 6, 2):
        box[side], box[side + 1] = np.inf, -np.inf
    for j in range(len(places)):
        hidden[j] = 0.0 if np.isfinite(places[j, 0] + places[j, 1] + places[j, 2]) else 1.0
        if hidden[j] == 0:
            cx, cy, cz, count = cx + places[j, 0], cy + places[j, 1], cz + places[j, 2], count + 1
    over = 1.0 / count if count > 0 else 0.0
    for j in range(len(places)):
        X, Y, Z = cx * over, cy * over, cz * over
        if hidden[j] == 0:
            X, Y, Z = places[j, 0], places[j, 1], places[j, 2]
        depth[j] = P[2, 0] * X + P[2, 1] * Y + P[2, 2] * Z + P[2, 3]
        nearer = 1.0 / depth[j] if depth[j] > 0 else np.nan
        x[j] = (P[0, 0] * X + P[0, 1] * Y + P[0, 2] * Z + P[0, 3]) * nearer
        y[j] = (P[1, 0] * X + P[1, 1] * Y + P[1, 2] * Z + P[1, 3]) * nearer
        if hidden[j] == 0:
            _widen(box, 0, x[j])
            _widen(box, 2, y[j])
            _widen(box, 4, depth[j])
    margin = _LIMB_M * focal / (box[4] if box[4] > _LIMB_M else _LIMB_M)
    for low in (0, 2):
        box[low] -= margin
        box[low + 1] += margin


@kernel
def _widen(box, side, value):
    """Make a box reach a value, which may be NaN."""
    if value < box[side]:
        box[side] = value
    if value > box[side + 1]:
        box[side + 1] = value


@kernel
def _hide(x, y, depth, box, a, b, focal, limbs, places, hidden):
    """Mark the joints of `a` that are behind a limb of `b`, both of whose ends are in `places`, in a view."""
    near, far = box[b], box[a]
    if not (near[0] < far[1] and far[0] < near[1] and near[2] < far[3] and far[2] < near[3]):
        return
    for j in range(len(hidden)):
        behind = depth[a, j] - _IN_FRONT_M
        if hidden[j] > 0 or not (near[4] < behind and near[0] < x[a, j] < near[1] and near[2] < y[a, j] < near[3]):
            continue
        for n in range(len(limbs)):
            one, two = limbs[n, 0], limbs[n, 1]
            if not np.isfinite(places[one, 0] + places[two, 0]):
                continue
            to_x, to_y = x[a, j] - x[b, one], y[a, j] - y[b, one]
            dx, dy = x[b, two] - x[b, one], y[b, two] - y[b, one]
            length, along = dx * dx + dy * dy, to_x * dx + to_y * dy
            along = 0.0 if along <= 0 else 1.0 if along >= length else along / length
            to_x, to_y = to_x - along * dx, to_y - along * dy
            at = depth[b, one] + along * (depth[b, two] - depth[b, one])
            if (to_x * to_x + to_y * to_y) * at * at < (_LIMB_M * focal) ** 2 and at < behind:
                hidden[j] = 1.0
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
        segment, costs = np.zeros(3, dtype=np.intp), (asked * _APPEARS_S, self.begins, self.ends)
        best_s = np.array([_best_segment(gains, *costs, 0, segment) for gains in self.alone])
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
        counts = np.bincount(self.place.ravel(), minlength=self.detections + 1)[:-1]
        begin = np.cumsum(np.concatenate([[0, 0], counts]))
        who, what = np.empty(begin[-1], dtype=np.intp), np.empty(begin[-1])
        _holders(self.place, self.weight, begin, who, what)
        return begin[:-1], who, what

    def in_turn(self, first: Mask, asked: float = 1.0, besides: Chosen | None = None) -> Chosen:
        """People one after the other, the best of those `first` (H,) before all others: so many as have the least
        evidence, or the share of it that is `asked` for.

        Those `besides` come before all, and are not returned; for who comes besides them appearing costs nothing.
        """
        before = np.zeros((0, 3), dtype=np.intp)
        if besides is not None:
            before = np.column_stack([besides.hypothesis, besides.start, besides.stop])
        appears_s = asked * _APPEARS_S if besides is None else 0.0
        given = self.alone.copy(), self.place, *self.holders, self.lasts_s, first, before
        costs, (H, T) = (appears_s, self.begins, self.ends, asked * self.least_s), self.there.shape
        free, changed = np.ones(self.detections, dtype=bool), np.ones(H, dtype=bool)
        room = np.empty((H, 3), dtype=np.intp), np.empty(H)
        chosen, evidence = np.empty((H * T, 3), dtype=np.intp), np.empty(H * T)
        count = _in_turn(*given, *costs, free, changed, *room, chosen, evidence)
        return Chosen(*chosen[:count].T.copy(), evidence[:count])


@kernel
def _holders(place, weight, begin, who, what):
    """Fill in `Account.holders` of places and weights (H, T, K); `begin` (D + 2,) has its first entry twice."""
    people, frames, places = place.shape
    for h in range(people):
        for t in range(frames):
            for k in range(places):
                d = place[h, t, k]
                if d + 2 < len(begin):
                    at = begin[d + 1]
                    who[at], what[at] = h, weight[h, t, k]
                    begin[d + 1] += 1


@kernel
def _in_turn(
    gains, place, begin, who, what, lasts, first, besides, appears, begins, ends, least, free, changed, segment,
    value, chosen, evidence,
):  # fmt: skip
    """Fill in hypothesis, start and stop, `chosen` (N, 3), and `evidence` (N,) of those whom `Account.in_turn`
    chooses; returns how many there are.
    """
    people, count = len(gains), 0
    for n in range(len(besides)):
        _take(besides[n], gains, place, begin, who, what, lasts, free, changed)
    while people > 0:
        before_all, best = False, -1
        for h in range(people):
            if changed[h]:
                value[h] = _best_segment(gains[h], appears, begins, ends, h, segment[h])
                changed[h] = False
            before_all = before_all or (first[h] and value[h] >= least)
        for h in range(people):
            if (first[h] or not before_all) and (best < 0 or value[h] > value[best]):
                best = h
        if value[best] < least:
            break
        evidence[count] = value[best]
        for n in range(3):
            chosen[count, n] = segment[best, n]
        _take(chosen[count], gains, place, begin, who, what, lasts, free, changed)
        count += 1
    return count


@kernel
def _take(chosen, gains, place, begin, who, what, lasts, free, changed):
    """Somebody is there for some frames: their detections are evidence of nobody else."""
    person = chosen[0]
    changed[person] = True
    for t in range(chosen[1], chosen[2]):
        gains[person, t] = -np.inf
        for k in range(place.shape[2]):
            d = place[person, t, k]
            if d < len(free) and free[d]:
                free[d] = False
                for n in range(begin[d], begin[d + 1]):
                    gains[who[n], t] -= what[n] * lasts[t]
                    changed[who[n]] = True


@kernel
def _best_segment(gains, appears, begins, ends, person, segment):
    """The segment of `gains` (T,) with the greatest sum, which is returned; `segment` (3,) is who, start and stop.

    Where it begins after the frame `begins`, or stops before the frame `ends`, it costs `appears` each. No part of
    it costs more than to vanish and to appear again.
    """
    running, peak, since, best = -np.inf, -np.inf, 0, -np.inf
    segment[0], segment[1], segment[2] = person, 0, 0
    for t in range(len(gains)):
        afresh = -appears if t > begins else 0.0
        if running < afresh or running < peak - 2 * appears:
            since, running, peak = t, afresh, -np.inf
        running += gains[t]
        peak = running if running > peak else peak
        closed = running - (appears if t < ends else 0.0)
        if closed > best:
            best, segment[1], segment[2] = closed, since, t + 1
    return best
