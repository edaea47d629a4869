"""Shelf over time: intervals over blocks of frames, limbs that are lost for a while, identities that change."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.evaluation.shelf import ACTORS, LIMB_NAMES, MatchedActors

BLOCK_FRAMES = 15
"""Frames of a block: errors of one frame are nearly those of the next, so frames are no independent draws."""


@dataclass(frozen=True)
class LostLimb:
    """A limb of an actor that is wrong in consecutive annotated frames: one event, however long."""

    actor: int
    """1, 2 or 3."""
    limb: str
    """One of `LIMB_NAMES`."""
    first: int
    """Its first frame."""
    last: int
    """Its last frame."""

    def __str__(self) -> str:
        return f"actor {self.actor}, {self.limb}, frames {self.first}-{self.last}"


def lost_limbs(matched: MatchedActors) -> list[LostLimb]:
    """Every event, in the order of actors, limbs and frames. Frames without annotation end one."""
    events = []
    for actor in ACTORS:
        rows = np.flatnonzero(matched.actor == actor)
        rows = rows[np.argsort(matched.frame[rows])]
        frame = matched.frame[rows]
        for limb, name in enumerate(LIMB_NAMES):
            wrong = frame[~matched.limbs_right[rows, limb]]
            runs = np.split(wrong, np.flatnonzero(np.diff(wrong) > 1) + 1)
            events += [LostLimb(actor + 1, name, int(run[0]), int(run[-1])) for run in runs if len(run) > 0]
    return events


def pcp_interval(
    matched: MatchedActors, level: float = 0.95, *, draws: int = 2000, block_frames: int = BLOCK_FRAMES
) -> tuple[float, float]:
    """Ends of the interval that holds Avg PCP, per cent, in `level` of the draws of blocks, with replacement.

    As many are drawn as there are. A block is up to `block_frames` consecutive annotated
    frames (block bootstrap: Künsch, 1989); seed fixed.
    """
    block = blocks_of(matched.frame, block_frames)
    count = int(block.max()) + 1
    right, limbs = np.zeros((count, len(ACTORS))), np.zeros((count, len(ACTORS)))
    at = (block, np.searchsorted(ACTORS, matched.actor))
    np.add.at(right, at, matched.limbs_right.sum(axis=1))
    np.add.at(limbs, at, matched.limbs_right.shape[1])
    chosen = np.random.default_rng(0).integers(0, count, (draws, count))
    right, limbs = right[chosen].sum(axis=1), limbs[chosen].sum(axis=1)
    # An actor who is in no block of a draw takes no part in its mean.
    known = limbs > 0
    average = np.where(known, right / np.maximum(limbs, 1), 0.0).sum(axis=1) / known.sum(axis=1)
    low, high = np.quantile(100 * average, [(1 - level) / 2, (1 + level) / 2])
    return float(low), float(high)


def blocks_of(frame: NDArray[np.integer], block_frames: int = BLOCK_FRAMES) -> NDArray[np.intp]:
    """(G,) number of the block of each frame: runs of consecutive frames, cut every `block_frames`."""
    frames, place = np.unique(frame, return_inverse=True)
    if len(frames) == 0:
        return np.zeros(0, dtype=np.intp)
    starts = np.concatenate([[True], np.diff(frames) > 1])
    within = np.arange(len(frames)) - np.maximum.accumulate(np.where(starts, np.arange(len(frames)), 0))
    return (np.cumsum(within % block_frames == 0) - 1)[place]


def identity_switches(matched: MatchedActors, identity: NDArray[np.integer]) -> int:
    """How often an actor who is found has another `identity` (N,) than when he was found last."""
    switches = 0
    for actor in ACTORS:
        rows = np.flatnonzero((matched.actor == actor) & matched.found)
        rows = rows[np.argsort(matched.frame[rows])]
        switches += int((np.diff(identity[matched.row[rows]]) != 0).sum())
    return switches
