"""People from hip candidates, grown along the skeleton by part affinities.

Stage I (d) and the first half of (e) of the paper (section 3.1, "Human Proposal Generation").
"""

from collections import Counter
from dataclasses import dataclass, field, replace

import numpy as np

from shapepose_fg.core.arrays import Array, Index, Mask
from shapepose_fg.core.bounds import Count, Metres, Settings, Share
from shapepose_fg.core.detections import Detections
from shapepose_fg.core.skeleton import Skeleton
from shapepose_fg.proposal.candidates import Candidates
from shapepose_fg.proposal.growth import GrowthConfig, Links, grow, link

_HIP_WIDTH_M = 0.4
"""Maximum distance of two hips of a person, m; their midpoint is a root if fewer than two views saw
one."""
_OWN_DETECTIONS = 2
"""Minimum number of a candidate's detections that no found person uses."""


@dataclass(frozen=True)
class ProposalConfig(Settings):
    """Settings for people from hip candidates, and for their joints."""

    evidence: bool = True
    """Whether people are hypotheses from pairs of 2D people, scored by evidence (`selection.py`).
    In the paper, hips of three votes anchor people; the settings below are for that."""
    min_probability: Share = 0.3
    """Minimum existence probability of a new person; later frames, or a body, decide."""

    box_horizontal_m: Metres = 1.0
    """Half the width of the box around the hip, m: stretched arms and legs reach 1 m from it."""
    box_vertical_m: Metres = 1.2
    """Half the height of the box, m: a raised hand is 1.2 m above the hip."""
    min_parts: Share = 0.6
    """Minimum fraction of the core joints (trunk, arms, legs) with a candidate in the box. The
    paper requires 90 %, and so loses people with an unseen forearm (17 of 840 on Shelf, in plain
    sight of five views). The false positives that it means to reject fail `min_grown_parts` here,
    or lose their detections in the reassignment. 0.6 is an upper body."""
    min_confidence: Share = 0.2
    """Minimum mean confidence of the box's best candidates; rejects clutter of low confidence."""
    separation_m: Metres = 0.2
    """Non-maximum suppression: of two anchors closer than this, m, the better one stays. A pelvis
    is about 20 cm deep and 30 cm wide: its centre is not closer to another's even in a hug."""
    min_grown_parts: Share = 0.4
    """Minimum fraction of the core joints with a strong candidate linked to the hip; a person with
    only the upper body visible has 0.6. Among simulated people in close interaction real ones have
    over 0.47, and most false positives, with joints of others, less than 0.4. The paper requires
    none."""
    min_observed_parts: Share = 0.35
    """Minimum fraction of the core joints that two views must see when each detection is assigned
    to one person: 6 of 15. A person with only the upper body visible has 9. The paper requires
    none."""
    weak_anchors: bool = True
    """Whether weak hips, and midpoints between two hips, also anchor people where strong joints
    remain unassigned. In the paper only hips of three votes do."""

    most_people: Count = 64
    """Maximum number of people in a frame, and limit on pairs of hips for midpoints; the best come
    first."""
    growth: GrowthConfig = field(default_factory=GrowthConfig)
    """Settings for growing people from the hip."""

    @classmethod
    def paper(cls) -> "ProposalConfig":
        """The settings of section 3.1: hips of three votes with 90 % of the parts in the box.

        Only non-maximum suppression rejects false positives: 60 cm is the best of 20 to 80 on
        `tune`.
        """
        return cls(
            evidence=False,
            separation_m=0.6,
            min_parts=0.9,
            min_grown_parts=0.0,
            min_observed_parts=0.0,
            weak_anchors=False,
            growth=GrowthConfig(bridge_m=0.0),
        )


@dataclass(frozen=True)
class Proposals:
    """People found in one frame, each with at most one candidate per joint."""

    candidate: Index
    """(P, J) index of the 3D candidate of each joint, -1 where there is none."""
    places: Array
    """(P, J, 3) positions of the joints, metres: the candidates, and the midpoint of the hips as
    the root of a person without a root candidate; NaN elsewhere."""
    score: Array
    """(P,) mean confidence of the box's best candidates."""
    dropped: dict[str, int]
    """Number of dropped anchors by reason."""

    def __len__(self) -> int:
        return len(self.candidate)


def propose(
    candidates: Candidates,
    detections: Detections,
    skeleton: Skeleton,
    up: Array,
    config: ProposalConfig,
) -> Proposals:
    """Find the people of a frame: anchors at root candidates, checked by their boxes, then grown.

    Strong root candidates come first (the paper's hips). Among what remains, people with a hardly
    visible root are anchored by weak root candidates, and last by midpoints between two hips. `up`
    is the (3,) unit vector upwards. Two people do not share a candidate.
    """
    search = Search(
        candidates,
        link(candidates, detections, config.growth),
        detections,
        skeleton,
        up,
        config,
        Counter(),
    )
    roots = candidates.joint == skeleton.root
    anchors = search.anchors(np.flatnonzero(roots & candidates.strong), np.zeros(0, dtype=np.intp))
    anchors, chosen = search.linked(anchors)
    for last_resort in (False, True) if config.weak_anchors else ():
        free = search.unclaimed(chosen)
        if free is None:
            break
        if last_resort:
            search = search.with_middles(free)
            free = np.append(free, np.ones(len(search.candidates) - len(free), dtype=bool))
        more = search.among(free).people(anchors)
        if len(more) > 0:
            anchors, chosen = search.linked(np.concatenate([anchors, more]))
    places = np.full((*chosen.shape, 3), np.nan)
    places[chosen >= 0] = search.candidates.xyz[chosen[chosen >= 0]]
    score = search.boxes(anchors)[1]
    return Proposals(
        np.where(chosen < len(candidates), chosen, -1), places, score, dict(search.dropped)
    )


@dataclass(frozen=True)
class Search:
    """State of the search for people in one frame."""

    candidates: Candidates
    links: Links
    detections: Detections
    skeleton: Skeleton
    up: Array
    config: ProposalConfig
    dropped: Counter[str]

    def anchors(self, roots: Index, taken: Index) -> Index:
        """Candidates among `roots` with enough confident parts in their box, after suppression,
        best first.
        """
        parts, score = self.boxes(roots)
        enough = parts >= self.config.min_parts
        confident = score >= self.config.min_confidence
        anchors = roots[enough & confident]
        kept = standing_apart(anchors, taken, self.candidates, self.detections, self.config)
        self.dropped["hip seen as a better one's"] += len(anchors) - len(kept)
        self.dropped["more people than are looked for"] += max(
            0, len(kept) - self.config.most_people
        )
        kept = kept[: self.config.most_people]
        self.dropped["too few parts in the box"] += int((~enough).sum())
        self.dropped["low confidence"] += int((enough & ~confident).sum())
        return kept

    def boxes(self, roots: Index) -> tuple[Array, Array]:
        """Fraction (H,) of the core parts in the box around each root, and mean confidence (H,) of
        the best ones.
        """
        candidates, config = self.candidates, self.config
        offset = candidates.xyz[None] - candidates.xyz[roots, None]
        height = offset @ self.up
        horizontal = np.linalg.norm(offset - height[..., None] * self.up, axis=-1)
        in_box = (horizontal < config.box_horizontal_m) & (np.abs(height) < config.box_vertical_m)
        in_box &= candidates.joint >= 0  # not hidden by `among`
        best = np.zeros((len(roots), len(self.skeleton)))
        root, candidate = np.nonzero(in_box)
        np.maximum.at(best, (root, candidates.joint[candidate]), candidates.score[candidate])
        core = best[:, self.skeleton.core]
        return (core > 0).mean(axis=1), core.sum(axis=1) / np.maximum((core > 0).sum(axis=1), 1)

    def linked(self, anchors: Index) -> tuple[Index, Index]:
        """The anchors with enough strong joints linked to them, and the candidates (P, J) of each
        anchor.
        """
        chosen = grow(anchors, self.candidates, self.links, self.skeleton, self.config.growth)
        core = chosen[:, self.skeleton.core]
        strong = (core >= 0) & self.candidates.strong[core]
        linked = strong.mean(axis=1) >= self.config.min_grown_parts
        if linked.all():
            return anchors, chosen
        self.dropped["too few joints linked to the hip"] += int((~linked).sum())
        # Candidates of dropped anchors become available to others.
        kept = anchors[linked]
        return kept, grow(kept, self.candidates, self.links, self.skeleton, self.config.growth)

    def unclaimed(self, chosen: Index) -> Mask | None:
        """(C,) mask of the candidates that no person uses; None if too few of them are strong for a
        person.

        A candidate needs `_OWN_DETECTIONS` unused detections.
        """
        owner, detection = self.candidates.support.T
        used = np.zeros(len(self.detections), dtype=bool)
        used[detection[np.isin(owner, chosen[chosen >= 0])]] = True
        free = np.bincount(owner, ~used[detection], len(self.candidates)) >= _OWN_DETECTIONS
        strong = free & self.candidates.strong & np.isin(self.candidates.joint, self.skeleton.core)
        enough = len(np.unique(self.candidates.joint[strong])) >= self.config.min_grown_parts * len(
            self.skeleton.core
        )
        return free if enough else None

    def among(self, free: Mask) -> "Search":
        """Return the search restricted to the candidates `free`; what it drops is not counted."""
        both = free[self.links.ends].all(axis=1)
        links = Links(self.links.ends[both], self.links.score[both])
        hidden = replace(self.candidates, joint=np.where(free, self.candidates.joint, -1))
        return replace(self, candidates=hidden, links=links, dropped=Counter())

    def people(self, taken: Index) -> Index:
        """Anchors, strong or weak, of further people, given those `taken`."""
        roots = np.flatnonzero(self.candidates.joint == self.skeleton.root)
        return self.linked(self.anchors(roots, taken))[0]

    def with_middles(self, free: Mask) -> "Search":
        """Add root candidates at midpoints of two free hips, linked to both."""
        candidates, count = self.candidates, len(self.candidates)
        right, left = self.skeleton.hips
        first, second = (np.flatnonzero(free & (candidates.joint == hip)) for hip in (right, left))
        first, second = (index.ravel() for index in np.meshgrid(first, second, indexing="ij"))
        width = np.linalg.norm(candidates.xyz[first] - candidates.xyz[second], axis=1)
        fits = (width < _HIP_WIDTH_M) & (candidates.strong[first] | candidates.strong[second])
        first, second = first[fits], second[fits]
        best = np.argsort(-(candidates.score[first] + candidates.score[second]), kind="stable")
        best = np.sort(best[: 4 * self.config.most_people])
        first, second = first[best], second[best]
        middle = count + np.arange(len(first))
        owner, detection = candidates.support.T
        from_first = [
            np.stack([np.full((owner == f).sum(), m), detection[owner == f]], axis=1)
            for m, f in zip(middle.tolist(), first.tolist(), strict=True)
        ]
        more = Candidates(
            np.concatenate([candidates.xyz, (candidates.xyz[first] + candidates.xyz[second]) / 2]),
            np.append(candidates.joint, np.full(len(first), self.skeleton.root)),
            np.append(candidates.score, (candidates.score[first] + candidates.score[second]) / 2),
            np.append(
                candidates.votes, np.minimum(candidates.votes[first], candidates.votes[second])
            ),
            np.append(candidates.strong, np.zeros(len(first), dtype=bool)),
            np.concatenate([candidates.support, *from_first]),
        )
        ends = np.stack([np.tile(middle, 2), np.concatenate([first, second])], axis=1)
        links = Links(
            np.concatenate([self.links.ends, ends]), np.append(self.links.score, np.ones(len(ends)))
        )
        return replace(self, candidates=more, links=links)


def standing_apart(
    anchors: Index,
    taken: Index,
    candidates: Candidates,
    detections: Detections,
    config: ProposalConfig,
) -> Index:
    """Non-maximum suppression: `anchors` apart from better ones and from `taken`, best first.

    A detection counts for one anchor only: an anchor's score excludes the detections of better
    ones.
    """
    both = np.concatenate([taken, anchors])
    views = int(detections.view.max(initial=0)) + 1
    made_of = np.full((len(candidates), views), -1, dtype=np.intp)
    made_of[candidates.support[:, 0], detections.view[candidates.support[:, 1]]] = (
        candidates.support[:, 1]
    )
    made_of = made_of[both]
    weight = np.where(
        made_of >= 0, detections.confidence[made_of] if len(detections) > 0 else 0.0, 0.0
    )
    distance = np.linalg.norm(candidates.xyz[both, None] - candidates.xyz[both][None], axis=-1)
    open_ = np.ones(len(both), dtype=bool)
    kept = []
    while open_.any():  # a few iterations
        waiting = np.flatnonzero(open_[: len(taken)])
        best = (
            waiting[0] if len(waiting) > 0 else np.where(open_, weight.sum(axis=1), -1.0).argmax()
        )
        kept.append(best)
        weight[made_of == made_of[best]] = 0.0
        open_ &= distance[best] >= config.separation_m
        open_[best] = False
    return both[np.array(kept[len(taken) :], dtype=np.intp)]
