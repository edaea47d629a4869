"""Track selection by evidence: detections that only one person explains, against those expected and
missing.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.arrays import Array, Index, Mask, Real, Whole
from shapepose_fg.core.assignment import least_cost_pairs
from shapepose_fg.core.compiled import kernel, part
from shapepose_fg.core.kernel_geometry import project
from shapepose_fg.core.rows import Rows
from shapepose_fg.core.skeleton import Skeleton
from shapepose_fg.proposal.nearby import LEAST_AFFINITY, FrameArrays, limbs_of, tie

_COST = 0.4
"""Cost of an expected but missing detection, relative to a present one. The cost of a person's
presence is the mean over all expected detections, in seconds in which every view sees every
joint."""
_COST_HIDDEN = 0.05
"""Cost where the joint is occluded by another person, or its position unknown. With these costs a
person is accepted if a quarter of the unoccluded joints have detections of their own. In simulated
crowds of eight with three cameras (seeds 6101, 6104), 76 % of unoccluded joints have a detection,
and 20 % of those behind a limb."""
_LIMB_M = 0.12
"""Distance from a limb or spine of another person, m, within which a joint's ray is occluded."""
_IN_FRONT_M = 0.15
"""Minimum depth gap for an occlusion, metres; below it the order of two people is ambiguous."""
_SURE_AFFINITY = 0.6
"""Mean affinity to the person's other detections at which a detection gets its full weight; without
detected neighbours on the skeleton it is `LEAST_AFFINITY`."""
APPEARS_S = 0.125
"""Cost of a track birth or death within the observed time, s of evidence; as much as 0.3 s of
missed detections in plain view. People rarely appear or disappear in the middle of the scene."""
_MOST_HYPOTHESES = 8
"""Maximum number of global hypotheses whose people are given priority, each in one alternative
selection; the most promising are tried."""
LEAST_S = 0.1
"""Minimum evidence of a person, in seconds during which all views see the whole person; less in
short recordings (`_EVEN`)."""
_ON_TRIAL = 0.25
"""Factor of `APPEARS_S` and `LEAST_S` for people who are tracked again: in a global hypothesis with
the others they may gain evidence."""
_SCALE, _PRIOR = 13.7, -0.6
"""Scale and offset of the log-odds of a person's existence by evidence: logistic fit to 482 people,
11 of them false positives or duplicates, in simulated crowds, crossings and pairs with two to
four cameras. A track's duration adds nothing. On 364 others, predicted probabilities 0.74 / 0.87 /
0.96 / 0.996 were correct for 8 of 11, 19 of 20, 70 of 70 and 263 of 263."""
_EVEN = -_PRIOR / _SCALE
"""Evidence per second at which existence has probability 0.5. An occluded person seen by one view
at a time has hardly more, and a recording of half a second is too short to gather `LEAST_S`."""


@dataclass(frozen=True)
class SelectedTracks(Rows):
    """K selected tracks and the frames in which they are present, in order of selection, best
    first.
    """

    hypothesis: Index
    """(K,) index of the track hypothesis."""
    start: Index
    """(K,) index of the first frame."""
    stop: Index
    """(K,) index after the last frame."""
    evidence_s: Array
    """(K,) evidence less the cost of presence, in seconds in which all views see all
    of a person."""

    def during(self, frame: int) -> Mask:
        """(K,) whether each selected track is present in a frame."""
        return (self.start <= frame) & (frame < self.stop)


def weighed(
    candidate: Index,
    places: Array,
    arrays: FrameArrays,
    skeleton: Skeleton,
    hypothesis: Index,
) -> tuple[Array, Array]:
    """Weight of each detection of A people (A, J, V), and cost of their presence (A,), as shares
    of expected detections.

    `candidate` (A, J, V) are detections of one frame, -1 for none, `places` (A, J, 3) the joints,
    metres, NaN where unknown; people of the same global `hypothesis` (A,) occlude each other. A
    detection is weighted by its affinity to the same person's others, and pays the cost of its
    place. A detection is expected for each joint within a view's image; a joint of unknown position
    is assumed at the mean of the others.
    """
    (A, J), known = candidate.shape[:2], np.asarray(np.isfinite(places).all(axis=-1))
    weight, cost, limbs = np.zeros(candidate.shape), np.zeros(A), limbs_of(skeleton)
    lists, tied = np.empty((3, candidate.size), dtype=np.intp), np.empty(candidate.size)
    room = np.empty((A, J, 3)), np.empty((3, A, J)), np.empty((A, 3)), np.zeros(A)
    _weigh(
        candidate,
        places,
        known,
        hypothesis,
        arrays,
        limbs,
        lists,
        tied,
        *room,
        weight,
        cost,
    )
    return weight, cost


@kernel("i3 f3 b2 i1", FrameArrays, "i2 i2 f1 f3 f3 f2 f1 f3 f1")
def _weigh(
    candidate, places, known, hypothesis, arrays, limbs, lists, tied, at, seen, box, expected,
    weight, cost
):  # fmt: skip
    """Fill in the results of `weighed`, zero before; `expected` (A,) counts the expected
    detections.

    Per view: `seen` (3, A, J) has x, y and depth of all joints, `box` (A, 3) the left and right
    limits and the smallest depth. `at` (A, J, 3) are the joints, unknown ones at the mean of the
    others.
    """
    people, joints, views = weight.shape
    cameras, count, owners, used, neighbours = arrays.cameras, 0, lists[0], lists[1], lists[2]
    for a in range(people):
        for j in range(joints):
            for v in range(views):
                if candidate[a, j, v] >= 0:
                    owners[count], used[count] = a, candidate[a, j, v]
                    count += 1
    tie(owners[:count], used[:count], candidate, arrays, tied, neighbours)
    of_joint, of_view = arrays.of_joint, arrays.of_view
    for n in range(count):
        affinity, d = tied[n] if neighbours[n] > 0 else LEAST_AFFINITY, used[n]
        weight[owners[n], of_joint[d], of_view[d]] = min(max(affinity / _SURE_AFFINITY, 0.0), 1.0)
    for a in range(people):
        _fill(places[a], known[a], at[a])
    for v in range(views):
        width, height, focal = arrays.sizes[v, 0], arrays.sizes[v, 1], arrays.focal[v]
        for a in range(people):
            _picture(at[a], known[a], cameras[v], focal, a, seen, box[a])
        for a in range(people):
            for j in range(joints):
                x, y, depth = seen[0, a, j], seen[1, a, j], seen[2, a, j]
                if not (depth > 0 and 0 <= x < width and 0 <= y < height):
                    continue
                place = a, x, y, depth - _IN_FRONT_M
                hidden = not known[a, j] or _behind(
                    place, known, hypothesis, limbs, seen, box, focal
                )
                missing = _COST_HIDDEN if hidden else _COST
                weight[a, j, v] *= 1 + missing
                cost[a] += missing
                expected[a] += 1
    for a in range(people):
        cost[a] /= max(expected[a], 1.0)
        for j in range(joints):
            for v in range(views):
                weight[a, j, v] /= max(expected[a], 1.0)


@part
def _fill(places, known, at):
    """Copy a person's joints (J, 3) to `at`, with unknown ones at the mean of the known."""
    for x in range(3):
        total, count = 0.0, 0
        for j in range(len(places)):
            total += places[j, x] if known[j] else 0.0
            count += known[j]
        for j in range(len(places)):
            at[j, x] = places[j, x] if known[j] else total / max(count, 1)


@part
def _picture(places, known, camera, focal, a, seen, box):
    """Project a person's joints into `seen`, and their extent into `box`, widened by a limb on both
    sides.
    """
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
def _behind(place, known, hypothesis, limbs, seen, box, focal):
    """Whether the `place` (person, x, y, depth) is occluded by a limb, both ends known, of another
    person of the same global hypothesis.
    """
    a, x, y, depth = place
    for b in range(len(hypothesis)):
        if (
            a == b
            or hypothesis[a] != hypothesis[b]
            or not (box[b, 0] < x < box[b, 1] and box[b, 2] < depth)
        ):
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


def own_evidence(candidate: Whole, weight: Real, cost: Real) -> Array:
    """(A,) evidence of A people in a frame, per second; 1 if all of a person is seen.

    Computed from detections `candidate` (A, J, V) with `weight` (A, J, V) and `cost` (A,) of
    `weighed`; detections that several people share are not evidence.
    """
    owners = np.bincount(candidate[candidate >= 0], minlength=1)
    own = (candidate >= 0) & (owners[np.maximum(candidate, 0)] == 1)
    return np.where(own, weight, 0.0).sum(axis=(1, 2)) - cost


def probability(evidence: float) -> float:
    """Probability that a person exists, by mean evidence over the frames (`own_evidence`).

    A person exists if the track is nearest to one and the same real person in more than half of the
    frames.
    """
    return float(1 / (1 + np.exp(-(_SCALE * evidence + _PRIOR))))


@dataclass(frozen=True)
class EvidenceTable:
    """H track hypotheses in T frames as weighted detections, from which tracks are selected."""

    place: NDArray[np.int32]
    """(H, T, J V) index of each detection among those of all frames; one past the last for none."""
    weight: NDArray[np.float32]
    """(H, T, J V) weight of each detection."""
    cost: Array
    """(H, T) cost of presence."""
    tracked: Mask
    """(H, T) frames in which the hypothesis is followed."""
    lasts_s: Array
    """(T,) duration that each frame represents, s."""
    detections: int
    """Number of detections."""
    begins: int
    """First frame with a detection."""
    ends: int
    """Last frame with a detection."""
    least_s: float
    """Minimum evidence of a person, s."""

    @classmethod
    def of(
        cls,
        candidate: Whole,
        weight: Real,
        cost: Real,
        tracked: Mask,
        counts: Index,
        lasts_s: Array,
    ) -> "EvidenceTable":
        """Build the table from detections `candidate` (H, T, J, V), the number of detections per
        frame `counts` (T,), and `weight` (H, T, J, V) and `cost` (H, T) of `weighed`.
        """
        shape = (*tracked.shape, candidate[0, 0].size if tracked.size > 0 else 0)
        first, count = (np.cumsum(counts) - counts).astype(np.int32), int(counts.sum())
        place = np.where(candidate >= 0, candidate + first[:, None, None], np.int32(count)).reshape(
            shape
        )
        weights = np.where(candidate >= 0, weight, np.float32(0)).reshape(shape)
        place, weights = place.astype(np.int32, copy=False), weights.astype(np.float32, copy=False)
        seen = np.append(np.flatnonzero(counts), 0)
        span, least_s = (int(seen[0]), int(seen.max())), min(LEAST_S, _EVEN * float(lasts_s.sum()))
        return cls(
            place,
            weights,
            np.asarray(cost, dtype=np.float64),
            tracked,
            lasts_s,
            count,
            *span,
            least_s,
        )

    def choose(self, hypothesis: Index) -> SelectedTracks:
        """The best selection of `ways`."""
        return self.ways(hypothesis)[0]

    def ways(self, hypothesis: Index, *, on_trial: bool = False) -> list[SelectedTracks]:
        """Selections of hypotheses and their time spans, such that each detection is evidence of
        one person only; best first.

        Tracks with the same global `hypothesis` (H,) were tracked together; `on_trial` also accepts
        tracks with slightly too little evidence. Selection is greedy: the best segment of the best
        hypothesis comes first, and its detections are evidence of no other. Alternative selections
        give priority to the people of one global hypothesis: a hypothesis that switches from one
        person to another, always to the better visible one, beats either of the two, and leaves too
        little for the others.
        """
        first, factor = np.zeros(len(hypothesis), dtype=bool), _ON_TRIAL if on_trial else 1.0
        if len(hypothesis) == 0:
            return [self.in_turn(first)]
        segment, costs = np.zeros(3, dtype=np.intp), (factor * APPEARS_S, self.begins, self.ends)
        best_s = np.array([_best_segment(gains, *costs, 0, segment) for gains in self.unshared_s])
        bound = np.bincount(hypothesis, np.maximum(best_s, 0.0))
        tried = np.argsort(-bound, kind="stable")[:_MOST_HYPOTHESES]
        found = [
            self.in_turn(each, factor) for each in (first, *(hypothesis == each for each in tried))
        ]
        return sorted(found, key=lambda each: -float(each.evidence_s.sum()))

    def agreement(self, one: SelectedTracks, other: SelectedTracks) -> float:
        """Share of the detections of `one` and `other` that are evidence of the same people in
        both.
        """
        owners = np.full((2, self.detections + 1), -1)
        for owner, chosen in zip(owners, (one, other), strict=True):
            for n, (h, start, stop) in enumerate(
                zip(chosen.hypothesis, chosen.start, chosen.stop, strict=True)
            ):
                owner[self.place[h, start:stop]] = n
        owners = owners[:, :-1][:, (owners[:, :-1] >= 0).any(axis=0)]
        shared = np.zeros((len(one.start) + 1, len(other.start) + 1))
        np.add.at(shared, tuple(owners), 1.0)  # the last row and column are unassigned
        same = least_cost_pairs(-shared[:-1, :-1])
        return float(shared[same].sum() / owners.shape[1]) if owners.shape[1] > 0 else 1.0

    def left_over(self, chosen: SelectedTracks) -> SelectedTracks:
        """Tracks that could be added to the `chosen` ones if births and deaths cost nothing."""
        return self.in_turn(np.zeros(len(self.tracked), dtype=bool), besides=chosen)

    @cached_property
    def unshared_s(self) -> Array:
        """(H, T) evidence of each hypothesis, seconds, as if there were no other."""
        share = self.weight.sum(axis=2, dtype=np.float64)
        return np.where(self.tracked, (share - self.cost) * self.lasts_s, -np.inf)

    @cached_property
    def holders(self) -> tuple[Index, NDArray[np.int32], NDArray[np.float32]]:
        """Hypotheses that use each detection: offsets (D + 1,), their indices, and the weight of
        the detection in each, sorted by detection.
        """
        counts = np.bincount(self.place.ravel(), minlength=self.detections + 1)[:-1]
        begin = np.cumsum(np.concatenate([[0, 0], counts]))
        hypotheses, weights = (
            np.empty(begin[-1], dtype=np.int32),
            np.empty(begin[-1], dtype=np.float32),
        )
        _holders(self.place, self.weight, begin, hypotheses, weights)
        return begin[:-1], hypotheses, weights

    def in_turn(
        self, first: Mask, factor: float = 1.0, besides: SelectedTracks | None = None
    ) -> SelectedTracks:
        """Select tracks greedily, those in `first` (H,) with priority, while they have the minimum
        evidence times `factor`.

        The tracks `besides` are selected before all and not returned; with them, births and deaths
        cost nothing.
        """
        before = np.zeros((0, 3), dtype=np.intp)
        if besides is not None:
            before = np.column_stack([besides.hypothesis, besides.start, besides.stop])
        appears_s = factor * APPEARS_S if besides is None else 0.0
        given = self.unshared_s.copy(), self.place, *self.holders, self.lasts_s, first, before
        costs, (H, T) = (
            (appears_s, self.begins, self.ends, factor * self.least_s),
            self.tracked.shape,
        )
        free, changed = np.ones(self.detections, dtype=bool), np.ones(H, dtype=bool)
        room = np.empty((H, 3), dtype=np.intp), np.empty(H)
        chosen, evidence = np.empty((H * T, 3), dtype=np.intp), np.empty(H * T)
        count = _in_turn(*given, *costs, free, changed, *room, chosen, evidence)
        hypothesis, start, stop = chosen[:count].T
        return SelectedTracks(hypothesis, start, stop, evidence[:count])


@kernel("w3 s3 i1 w1 s1")
def _holders(place, weight, begin, hypotheses, weights):
    """Fill in `EvidenceTable.holders` from indices and weights (H, T, K); `begin` (D + 2,) starts
    with two zeros.
    """
    people, frames, places = place.shape
    for h in range(people):
        for t in range(frames):
            for k in range(places):
                d = place[h, t, k]
                if d + 2 < len(begin):
                    at = begin[d + 1]
                    hypotheses[at], weights[at] = h, weight[h, t, k]
                    begin[d + 1] += 1


@kernel("f2 w3 i1 w1 s1 f1 b1 i2 f0 i0 i0 f0 b1 b1 i2 f1 i2 f1")
def _in_turn(
    gains, place, begin, hypotheses, weights, lasts, first, besides, appears, begins, ends, least,
    free, changed, segment, value, chosen, evidence,
):  # fmt: skip
    """Fill in hypothesis, start and stop, `chosen` (N, 3), and `evidence` (N,) of the tracks that
    `EvidenceTable.in_turn` selects; returns their number.
    """
    people, count = len(gains), 0
    for n in range(len(besides)):
        _take(besides[n], gains, place, begin, hypotheses, weights, lasts, free, changed)
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
        _take(chosen[count], gains, place, begin, hypotheses, weights, lasts, free, changed)
        count += 1
    return count


@part
def _take(chosen, gains, place, begin, hypotheses, weights, lasts, free, changed):
    """Select a segment: its detections are no longer evidence of any other hypothesis."""
    person = chosen[0]
    changed[person] = True
    for t in range(chosen[1], chosen[2]):
        gains[person, t] = -np.inf
        for k in range(place.shape[2]):
            d = place[person, t, k]
            if d < len(free) and free[d]:
                free[d] = False
                for n in range(begin[d], begin[d + 1]):
                    gains[hypotheses[n], t] -= weights[n] * lasts[t]
                    changed[hypotheses[n]] = True


@kernel("f1 f0 i0 i0 i0 i1")
def _best_segment(gains, appears, begins, ends, person, segment):
    """Return the maximum sum of a segment of `gains` (T,); `segment` (3,) is set to `person`, start
    and stop.

    A start after the frame `begins` and a stop before the frame `ends` cost `appears` each. A
    segment is split where a part of it costs more than a death and a birth.
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
