"""Limits on the detections and candidates of a frame, so that its cost is bounded.

Every detection is paired with those of the same joint in all other views, and every candidate
compared with every person: cost grows with the square of both. Ordinary crowds (a dozen people
with thirty cameras) stay below all limits.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.arrays import Index, Mask
from shapepose_fg.core.camera import Rig
from shapepose_fg.core.detections import DerivedFrames, Detections
from shapepose_fg.proposal.candidates import CandidateConfig, Candidates, PairPoints
from shapepose_fg.proposal.view_faults import without_faults

_LEAST_IN_A_VIEW = 8
"""Minimum limit of detections per joint and view, with any number of views."""


@dataclass(frozen=True)
class ThinnedFrames(DerivedFrames):
    """A recording with thinned frames, whose detections are in a canonical order.

    They are sorted by position, so that results do not depend on the order of cameras, people and
    detections: ties are often broken by order.
    """

    rig: Rig
    """The V cameras of the recording."""
    config: CandidateConfig
    """Settings with the limits."""

    def __getitem__(self, frame: int, /) -> Detections:
        return thinned(self.frames[frame], self.rig, self.config)[0]

    def is_thinned(self, frame: int) -> bool:
        """Whether detections of a frame were removed by the limits."""
        return kept_detections(self.frames[frame], len(self.rig), self.config) is not None


def thinned(every: Detections, rig: Rig, config: CandidateConfig) -> tuple[Detections, bool]:
    """Sort a frame's detections, and leave out faulty ones (`view_faults`) and those above the
    limits.

    Returns the detections, and whether the limits removed any.
    """
    order = np.lexsort((every.confidence, every.joint, *every.xy.T))
    found = every.rows(order)
    kept = kept_detections(found, len(rig), config)
    found = without_faults(found if kept is None else found.only(kept), rig)
    order = np.lexsort(found.pairs.T)
    return replace(
        found, pairs=found.pairs[order], affinity=found.affinity[order]
    ), kept is not None


def kept_detections(detections: Detections, views: int, config: CandidateConfig) -> Mask | None:
    """(D,) mask of the detections to keep; None for all.

    Each view keeps its most confident detections of each joint, so that there are at most
    `config.most_pairs` pairs over all views.
    """
    joints = int(detections.joint.max(initial=0)) + 1
    group = detections.view * joints + detections.joint
    most = max(_LEAST_IN_A_VIEW, int(np.sqrt(2 * config.most_pairs / (views * (views - 1)))))
    if np.bincount(group, minlength=1).max() <= most:
        return None
    return _best(group, most, (-detections.confidence,))


def thinned_points(points: PairPoints, config: CandidateConfig) -> PairPoints:
    """The `config.most_points` most confident points of each joint."""
    if np.bincount(points.joint, minlength=1).max() <= config.most_points:
        return points
    keep = _best(points.joint, config.most_points, (-points.score,))
    return PairPoints(points.xyz[keep], points.joint[keep], points.pair[keep], points.score[keep])


def thinned_candidates(
    candidates: Candidates, detections: Detections, config: CandidateConfig
) -> Candidates:
    """At most `config.most_candidates` candidates per joint, fewer if there are too many links.

    Strong candidates (`Candidates.strong`) are kept first, then those with most votes, then those
    with the highest score.
    """
    most = config.most_candidates
    kept = _with_most(candidates, most)
    while most > _LEAST_IN_A_VIEW and _count_links(kept, detections) > _MOST_LINKS:
        most //= 2
        kept = _with_most(kept, most)
    return kept


_MOST_LINKS = 2_000_000
"""Maximum number of pairs of candidates with affinities: 12 people with 30 cameras
have 50,000."""


def _count_links(candidates: Candidates, detections: Detections) -> int:
    """Number of pairs of candidates linked by the affinities of a frame."""
    supports = np.bincount(candidates.support[:, 1], minlength=len(detections))
    return int(supports[detections.pairs].prod(axis=1).sum())


def _with_most(candidates: Candidates, most: int) -> Candidates:
    """The best candidates of each joint, at most `most`."""
    if np.bincount(candidates.joint, minlength=1).max() <= most:
        return candidates
    keep = _best(candidates.joint, most, (-candidates.score, -candidates.votes, ~candidates.strong))
    place = np.cumsum(keep) - 1
    support = candidates.support[keep[candidates.support[:, 0]]]
    columns = {
        name: getattr(candidates, name)[keep]
        for name in ("xyz", "joint", "score", "votes", "strong")
    }
    return replace(
        candidates, **columns, support=np.column_stack([place[support[:, 0]], support[:, 1]])
    )


def _best(group: Index, most: int, order: tuple[NDArray[Any], ...]) -> Mask:
    """(N,) mask of the first `most` of each group by `order` (last key first); ties keep their
    order.
    """
    ranked = np.lexsort((*order, group))
    sizes = np.bincount(group)
    place = np.arange(len(group)) - np.repeat(np.cumsum(sizes) - sizes, sizes)
    keep = np.zeros(len(group), dtype=bool)
    keep[ranked[place < most]] = True
    return keep
