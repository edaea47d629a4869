"""Who was there, by evidence: what only a person explains, against what should have been seen of that person."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.arrays import Array, Index, Mask, Real, Whole
from shapepose_fg.core.assignment import least_cost_pairs
from shapepose_fg.core.compiled import kernel, part
from shapepose_fg.core.pieces import project
from shapepose_fg.core.rows import Rows
from shapepose_fg.core.skeleton import Skeleton
from shapepose_fg.proposal.nearby import Sight, limbs_of, tie

_PRICE = 0.4
"""What a place costs where a joint should be seen and is not, in places that are seen: the price of being there is
the mean over a person's places, in seconds in which every joint is seen by every view."""
_PRICE_HIDDEN = 0.05
"""Price of a place behind somebody else, or of a joint whose place is not known. With these a person is believed
in of whom a fourth of what nobody hides has detections of their own. In simulated crowds of eight before three
cameras (seeds 6101, 6104) joints that nobody hides have a detection in 76 of 100 places, those behind a limb in
20."""
_LIMB_M = 0.12
"""A joint is hidden whose ray passes somebody's limb, or spine, this near."""
_IN_FRONT_M = 0.15
"""Minimum depth gap for an occlusion, metres; below it the order of two people is ambiguous."""
_SURE_AFFINITY = 0.6
"""Mean affinity to the person's other detections from which on a detection counts wholly."""
_ALONE = 0.5
"""What a detection counts whose neighbours on the skeleton nobody saw: affinities say nothing of it."""
APPEARS_S = 0.125
"""What it costs to appear or vanish while others are watched, as much as not being seen in plain view for 0.3
seconds: people are where they were, and nobody comes out of nothing."""
_WORLDS = 8
"""How many worlds are tried as those that come first, the most promising ones."""
LEAST_S = 0.1
"""Minimum evidence of a person, seconds; less in short recordings (`_EVEN`)."""
_ON_TRIAL = 0.25
"""Share of `APPEARS_S` and `LEAST_S` that is enough for people who are followed again: who is with them in one
world may leave them more."""
_SCALE, _PRIOR = 13.7, -0.6
"""Evidence to log-odds, and those of a person without any: logistic fit to 482 people, of whom 11 were nobody or
somebody once more, in simulated crowds, crossings and pairs before two to four cameras. How long somebody is there
says nothing more. Of 364 others, said to be 0.74 / 0.87 / 0.96 / 0.996, 8 of 11, 19 of 20, 70 of 70 and 263 of 263
were there."""
_EVEN = -_PRIOR / _SCALE
"""Evidence a second at which a person is as probable as not: who is seen by one view at a time, behind others, has
hardly more, and a recording of half a second has no time to gather `LEAST_S` of it."""


@dataclass(frozen=True)
class Chosen(Rows):
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

    def during(self, frame: int) -> Mask:
        """(K,) who is there in a frame."""
        return (self.start <= frame) & (frame < self.stop)


def weighed(
    candidate: Index, places: Array, sight: Sight, skeleton: Skeleton, world: Index
) -> tuple[Array, Array]:
    """What each detection of A people counts (A, J, V), and what being there costs (A,), both as shares of the
    places where they should be seen.

    `candidate` (A, J, V) are detections of one frame, -1 for none, `places` (A, J, 3) the joints, metres, NaN
    where unknown; people of the same `world` (A,) hide each other. A detection counts by its affinity to the same
    person's others, and pays for its place. A place is a joint in the picture of a view; joints whose place is
    unknown are thought to be where the others are in the mean.
    """
    (A, J), known = candidate.shape[:2], np.asarray(np.isfinite(places).all(axis=-1))
    weight, price, limbs = np.zeros(candidate.shape), np.zeros(A), limbs_of(skeleton)
    lists, tied = np.empty((3, candidate.size), dtype=np.intp), np.empty(candidate.size)
    room = np.empty((A, J, 3)), np.empty((3, A, J)), np.empty((A, 3)), np.zeros(A)
    _weigh(candidate, places, known, world, sight, limbs, lists, tied, *room, weight, price)
    return weight, price


@kernel("i3 f3 b2 i1", Sight, "i2 i2 f1 f3 f3 f2 f1 f3 f1")
def _weigh(
    candidate, places, known, world, sight, limbs, lists, tied, at, seen, box, expected, weight, price
):  # fmt: skip
    """Fill in what `weighed` returns, zeros before; `expected` (A,) is how many places there are.

    For one view after the other: `seen` (3, A, J) x, y and depth of all joints, and between what they are, `box`
    (A, 3): left, right and the nearest. Joints are `at` (A, J, 3), or where the others are in the mean.
    """
    people, joints, views = weight.shape
    cameras, count, whose, which, neighbours = sight.cameras, 0, lists[0], lists[1], lists[2]
    for a in range(people):
        for j in range(joints):
            for v in range(views):
                if candidate[a, j, v] >= 0:
                    whose[count], which[count] = a, candidate[a, j, v]
                    count += 1
    tie(whose[:count], which[:count], candidate, sight, tied, neighbours)
    of_joint, of_view = sight.of_joint, sight.of_view
    for n in range(count):
        counts, d = min(max(tied[n] / _SURE_AFFINITY, 0.0), 1.0), which[n]
        weight[whose[n], of_joint[d], of_view[d]] = counts if neighbours[n] > 0 else _ALONE
    for a in range(people):
        _fill(places[a], known[a], at[a])
    for v in range(views):
        width, height, focal = sight.sizes[v, 0], sight.sizes[v, 1], sight.focal[v]
        for a in range(people):
            _picture(at[a], known[a], cameras[v], focal, a, seen, box[a])
        for a in range(people):
            for j in range(joints):
                x, y, depth = seen[0, a, j], seen[1, a, j], seen[2, a, j]
                if not (depth > 0 and 0 <= x < width and 0 <= y < height):
                    continue
                place = a, x, y, depth - _IN_FRONT_M
                hidden = not known[a, j] or _behind(place, known, world, limbs, seen, box, focal)
                cost = _PRICE_HIDDEN if hidden else _PRICE
                weight[a, j, v] *= 1 + cost
                price[a] += cost
                expected[a] += 1
    for a in range(people):
        price[a] /= max(expected[a], 1.0)
        for j in range(joints):
            for v in range(views):
                weight[a, j, v] /= max(expected[a], 1.0)


@part
def _fill(places, known, at):
    """A person's joints (J, 3), those that are not known where the others are in the mean."""
    for x in range(3):
        total, count = 0.0, 0
        for j in range(len(places)):
            total += places[j, x] if known[j] else 0.0
            count += known[j]
        for j in range(len(places)):
            at[j, x] = places[j, x] if known[j] else total / max(count, 1)


@part
def _picture(places, known, camera, focal, a, seen, box):
    """Put a person's joints in a view, in `seen` and in `box`, which has a limb's width more on both sides."""
    box[0], box[1], box[2] = np.inf, -np.inf, np.inf
    for j in range(len(places)):
        x, y, depth = project(camera, places[j])
        seen[0, a, j], seen[1, a, j], seen[2, a, j] = x, y, depth
        if known[j]:
            box[2] = min(box[2], depth)
            if depth > 0:
                box[0], box[1] = min(box[0], x), max(box[1], x)
    margin = _LIMB_M * focal / max(box[2], _LIMB_M)
    box[0] -= margin
    box[1] += margin


@part
def _behind(place, known, world, limbs, seen, box, focal):
    """Whether the `place` (whose, x, y, depth) is behind a limb of somebody else of the same world, both of whose
    ends are known.
    """
    a, x, y, depth = place
    for b in range(len(world)):
        if a == b or world[a] != world[b] or not (box[b, 0] < x < box[b, 1] and box[b, 2] < depth):
            continue
        for n in range(len(limbs)):
            one, two = limbs[n, 0], limbs[n, 1]
            if not (known[b, one] and known[b, two]):
                continue
            to_x, to_y = x - seen[0, b, one], y - seen[1, b, one]
            dx, dy = seen[0, b, two] - seen[0, b, one], seen[1, b, two] - seen[1, b, one]
            along = min(max((to_x * dx + to_y * dy) / max(dx * dx + dy * dy, 1e-6), 0.0), 1.0)
            to_x, to_y = to_x - along * dx, to_y - along * dy
            at = seen[2, b, one] + along * (seen[2, b, two] - seen[2, b, one])
            if (to_x * to_x + to_y * to_y) * at * at < (_LIMB_M * focal) ** 2 and at < depth:
                return True
    return False


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

    place: NDArray[np.int32]
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
    """The last frame in which anything is seen."""
    least_s: float
    """Least evidence of a person, seconds."""

    @classmethod
    def of(
        cls, candidate: Whole, weight: Real, price: Real, there: Mask, counts: Index, lasts_s: Array
    ) -> "Account":
        """Make the account of detections `candidate` (H, T, J, V), of `counts` (T,) in each frame, with `weight`
        (H, T, J, V) and `price` (H, T) of `weighed`.
        """
        shape = (*there.shape, candidate[0, 0].size if there.size > 0 else 0)
        first, count = (np.cumsum(counts) - counts).astype(np.int32), int(counts.sum())
        place = np.where(candidate >= 0, candidate + first[:, None, None], np.int32(count)).reshape(shape)
        weights = np.where(candidate >= 0, weight, np.float32(0)).reshape(shape)
        place, weights = place.astype(np.int32, copy=False), weights.astype(np.float32, copy=False)
        seen = np.append(np.flatnonzero(counts), 0)
        span, least_s = (int(seen[0]), int(seen.max())), min(LEAST_S, _EVEN * float(lasts_s.sum()))
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
        segment, costs = np.zeros(3, dtype=np.intp), (asked * APPEARS_S, self.begins, self.ends)
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
        same = least_cost_pairs(-shared[:-1, :-1])
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
    def holders(self) -> tuple[Index, NDArray[np.int32], NDArray[np.float32]]:
        """Where those who have each detection begin, (D + 1,), who they are, and what it counts for them, one
        detection after the other.
        """
        counts = np.bincount(self.place.ravel(), minlength=self.detections + 1)[:-1]
        begin = np.cumsum(np.concatenate([[0, 0], counts]))
        who, what = np.empty(begin[-1], dtype=np.int32), np.empty(begin[-1], dtype=np.float32)
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
        appears_s = asked * APPEARS_S if besides is None else 0.0
        given = self.alone.copy(), self.place, *self.holders, self.lasts_s, first, before
        costs, (H, T) = (appears_s, self.begins, self.ends, asked * self.least_s), self.there.shape
        free, changed = np.ones(self.detections, dtype=bool), np.ones(H, dtype=bool)
        room = np.empty((H, 3), dtype=np.intp), np.empty(H)
        chosen, evidence = np.empty((H * T, 3), dtype=np.intp), np.empty(H * T)
        count = _in_turn(*given, *costs, free, changed, *room, chosen, evidence)
        hypothesis, start, stop = chosen[:count].T
        return Chosen(hypothesis, start, stop, evidence[:count])


@kernel("w3 s3 i1 w1 s1")
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


@kernel("f2 w3 i1 w1 s1 f1 b1 i2 f0 i0 i0 f0 b1 b1 i2 f1 i2 f1")
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


@part
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


@kernel("f1 f0 i0 i0 i0 i1")
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
