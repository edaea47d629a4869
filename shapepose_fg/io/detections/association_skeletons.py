"""The skeletons of 4D Association's detection text, and what is made of each in ours."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.skeleton import BODY_25, COCO_18, Skeleton
from shapepose_fg.io.detections.view_streams import ViewCandidates
from shapepose_fg.proposal.assignment import match_best_first

SKELETON_TYPES = ("SKEL19", "SKEL17", "SKEL15", "COCO18", "BODY25", "OPTITRACK21", "SHELF15", "MPIIHAND21")
"""What the format's skeleton numbers mean."""


@dataclass(frozen=True)
class TextSkeleton:
    """The joints and limbs of a file: those of the detector, where `skeleton` may have more."""

    number: int
    """What the file's first line calls it."""
    joints: tuple[str, ...]
    """The joints whose candidates are listed, in order; the first of `skeleton`'s."""
    limbs: tuple[tuple[int, int], ...]
    """The limbs whose affinities are listed, in order."""
    skeleton: Skeleton
    """What is read from it."""

    @property
    def limb_of(self) -> NDArray[np.intp]:
        """(J, J) the number of the limb from one joint to another, -1 where there is none."""
        table = np.full((len(self.joints), len(self.joints)), -1, dtype=np.intp)
        table[tuple(np.array(self.limbs).T)] = np.arange(len(self.limbs))
        return table


_COCO_LIMBS = "1-8 8-9 9-10 1-11 11-12 12-13 1-2 2-3 3-4 2-16 1-5 5-6 6-7 5-17 1-0 0-14 0-15 14-16 15-17"

TEXT_SKELETONS = {
    each.skeleton.name: each
    for each in (
        TextSkeleton(SKELETON_TYPES.index("BODY25"), BODY_25.joints, BODY_25.limbs, BODY_25),
        TextSkeleton(
            SKELETON_TYPES.index("COCO18"),
            COCO_18.joints[:18],
            tuple((int(a), int(b)) for a, b in (limb.split("-") for limb in _COCO_LIMBS.split())),
            COCO_18,
        ),
    )
}
"""The skeletons that are read and written, by the name of ours."""


def with_middles(view: ViewCandidates, kind: TextSkeleton) -> ViewCandidates:
    """`view` of a file's joints as candidates of the whole skeleton: its middle joints are made.

    A middle belongs to two candidates (hips) that share a neighbour (the neck) by affinity. Each candidate makes
    one middle at most: pairs are taken in falling order of the lesser of their two affinities to the neighbour.
    A middle is as sure as the less sure of its two, has affinity 1 to them, and to every neighbour that both are
    linked to the mean of their affinities. Pairs that no limb of the skeleton joins are left out.
    """
    for middle, first, second in kind.skeleton.middles:
        view = _with_middle(view, kind.skeleton, middle, first, second)
    limb = np.array(kind.skeleton.limbs)
    known = np.zeros((len(kind.skeleton), len(kind.skeleton)), dtype=bool)
    known[tuple(limb.T)] = True
    there = known[tuple(view.joint[view.pairs].T)]
    return _sorted(replace(view, pairs=view.pairs[there], affinity=view.affinity[there]))


def _with_middle(view: ViewCandidates, skeleton: Skeleton, middle: int, first: int, second: int) -> ViewCandidates:
    """`view` with candidates of the joint `middle` between `first` and `second` at its end."""
    one, other = view.joint[view.pairs].T
    to_first, to_second = (np.flatnonzero(np.asarray(other == end) & (one != middle)) for end in (first, second))
    # A neighbour's links to one end, times its links to the other.
    left, right = _equal_pairs(view.pairs[to_first, 0], view.pairs[to_second, 0])
    left, right = to_first[left], to_second[right]
    neighbour, a, b = view.pairs[left, 0], view.pairs[left, 1], view.pairs[right, 1]
    lesser = np.minimum(view.affinity[left], view.affinity[right])
    picked = match_best_first(a, b, lesser)
    picked = picked[np.argsort(a[picked], kind="stable")]
    a_made, b_made = a[picked], b[picked]
    made = len(view.frame) + np.arange(len(picked))
    # Who else is linked to both ends of a middle.
    width = len(view.frame) + 1
    key, made_key = a * width + b, a_made * width + b_made
    order = np.argsort(made_key)
    at = np.minimum(np.searchsorted(made_key[order], key), max(len(order) - 1, 0))
    linked = np.flatnonzero(made_key[order][at] == key) if len(order) > 0 else np.zeros(0, dtype=np.intp)
    to_middle = np.column_stack([neighbour[linked], made[order][at[linked]]]) if len(order) > 0 else None
    pairs = [view.pairs, np.column_stack([made, a_made]), np.column_stack([made, b_made])]
    affinity = [view.affinity, np.ones(len(made)), np.ones(len(made))]
    if to_middle is not None:
        pairs.append(to_middle)
        affinity.append((view.affinity[left] + view.affinity[right])[linked] / 2)
    return replace(
        view,
        frame=np.concatenate([view.frame, view.frame[a_made]]),
        joint=np.concatenate([view.joint, np.full(len(made), middle)]),
        xy=np.concatenate([view.xy, (view.xy[a_made] + view.xy[b_made]) / 2]),
        confidence=np.concatenate([view.confidence, np.minimum(view.confidence[a_made], view.confidence[b_made])]),
        pairs=np.concatenate(pairs),
        affinity=np.concatenate(affinity),
    )


def _equal_pairs(left: NDArray[np.intp], right: NDArray[np.intp]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """All places i in `left` and k in `right` with equal values, as two arrays."""
    order = np.argsort(right, kind="stable")
    low, high = (np.searchsorted(right[order], left, side=side) for side in ("left", "right"))
    count = high - low
    i = np.repeat(np.arange(len(left)), count)
    within = np.arange(len(i)) - (np.cumsum(count) - count)[i]
    return i, order[low[i] + within]


def _sorted(view: ViewCandidates) -> ViewCandidates:
    """`view` in the order of its frames and joints, pairs in that of their frames."""
    order = np.lexsort((view.joint, view.frame))
    place = np.empty_like(order)
    place[order] = np.arange(len(order))
    pairs = place[view.pairs]
    by_frame = np.argsort(pairs[:, 0], kind="stable")
    return replace(
        view,
        frame=view.frame[order],
        joint=view.joint[order],
        xy=view.xy[order],
        confidence=view.confidence[order],
        pairs=pairs[by_frame],
        affinity=view.affinity[by_frame],
    )
