"""Detections of proposed people on a crowded frame, against what they are defined to be, one thing
at a time.
"""

import numpy as np
import pytest

from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.proposal.association import associate, by_support
from shapepose_fg.proposal.candidates import CandidateConfig, triangulate_pairs, vote
from shapepose_fg.proposal.proposals import ProposalConfig, Proposals, propose

CORE = list(BODY_25.core)
NEIGHBOURS = [
    {j for limb in BODY_25.limbs if joint in limb for j in limb if j != joint}
    for joint in range(25)
]
TREE = [
    {BODY_25.parents[joint], *(j for j in range(25) if BODY_25.parents[j] == joint)} - {-1}
    for joint in range(25)
]


def owned(chosen: np.ndarray, count: int) -> np.ndarray:
    """(P, D) whether a detection is one of a person's `chosen` (P, J, V)."""
    return np.array([np.isin(np.arange(count), each[each >= 0]) for each in chosen]).reshape(
        len(chosen), count
    )


@pytest.fixture(scope="module")
def proposed(crowded, five_cameras):
    """Stage I's people; of each some joints are taken away, so that they must be sought."""
    config = CandidateConfig()
    candidates = vote(triangulate_pairs(crowded, five_cameras, config), crowded, 5, config)
    proposals = propose(candidates, crowded, BODY_25, np.array([0.0, 0.0, 1.0]), ProposalConfig())
    assert len(proposals) >= 4
    candidate, places = proposals.candidate.copy(), proposals.places.copy()
    gone = np.random.default_rng(3).random(candidate.shape) < 0.25
    gone[:, BODY_25.root] = False
    candidate[gone], places[gone] = -1, np.nan
    return Proposals(candidate, places, proposals.score, proposals.dropped), candidates


def chosen_for(places, owns, crowded, rig) -> np.ndarray:
    """(P, J, V) by nearness to the projected joints and mean affinity to what each person owns."""
    xy, depth = rig.project(places)
    listed = {
        tuple(pair): value
        for pair, value in zip(crowded.pairs.tolist(), crowded.affinity, strict=True)
    }
    chosen = np.full((len(places), 25, len(rig)), -1)
    offers, shared = [], []
    for person, row in np.ndindex(len(places), len(crowded)):
        view, joint = int(crowded.view[row]), int(crowded.joint[row])
        others = [
            other
            for other in np.flatnonzero(owns[person] & (crowded.view == view)).tolist()
            if int(crowded.joint[other]) in NEIGHBOURS[joint]
        ]
        joints = {int(crowded.joint[other]) for other in others}
        total = sum(listed.get((row, other), listed.get((other, row), 0.0)) for other in others)
        affinity = total / max(len(joints), 1)

        def metres(kind: int, view=view, person=person, row=row) -> tuple[float, float]:
            px = float(np.linalg.norm(xy[view, person, kind] - crowded.xy[row]))
            return px, px * float(depth[view, person, kind]) / float(rig.focal_px[view])

        px, away = metres(joint)
        if np.isnan(px):
            within = [metres(kind)[1] < 0.6 for kind in TREE[joint]]
            if any(within) and affinity >= 0.3:
                offers.append(((affinity if joints else 0.3), person, row))
        else:
            score = np.exp(-0.5 * (away / 0.08) ** 2) + (affinity if joints else 0.3)
            if away < 0.25 and score >= 0.6:
                offers.append((score, person, row))
            if away < 0.025 and affinity >= 0.3:
                shared.append((away, person, row))
    used: set[int] = set()
    for _, person, row in sorted(offers, key=lambda offer: -offer[0]):
        slot = person, int(crowded.joint[row]), int(crowded.view[row])
        if chosen[slot] < 0 and row not in used:
            chosen[slot] = row
            used.add(row)
    empty = chosen < 0
    for _, person, row in sorted(shared, key=lambda each: -each[0]):
        slot = person, int(crowded.joint[row]), int(crowded.view[row])
        if empty[slot]:
            chosen[slot] = row
    return chosen


@pytest.mark.parametrize("least", [0.0, 0.35, 0.9])
def test_observations_are_chosen_again_until_nobody_more_is_dropped(
    least, proposed, crowded, five_cameras
):
    """First by what supports the candidates, then twice by what was chosen; what the dropped had is
    free.
    """
    proposals, candidates = proposed
    owns = np.zeros((len(proposals), len(crowded)), dtype=bool)
    for person, joints in enumerate(proposals.candidate.tolist()):
        for candidate, row in candidates.support.tolist():
            owns[person, row] |= candidate in joints
    np.testing.assert_array_equal(
        owned(by_support(proposals, candidates, crowded, 5), len(crowded)), owns
    )
    left, rounds, chosen = np.arange(len(proposals)), 3, np.zeros((0, 25, 5), dtype=int)
    while rounds > 0:
        chosen = chosen_for(proposals.places[left], owns, crowded, five_cameras)
        keep = ((chosen >= 0).sum(axis=2) >= 2)[:, CORE].mean(axis=1) >= least
        left, chosen = left[keep], chosen[keep]
        owns = owned(chosen, len(crowded))
        rounds = rounds - 1 if keep.all() else 2
    config = ProposalConfig(min_observed_parts=least)
    found, dropped = associate(proposals, candidates, crowded, five_cameras, BODY_25, config)
    np.testing.assert_array_equal(found.candidate, chosen)
    np.testing.assert_array_equal(found.initial, proposals.places[left])
    assert dropped == len(proposals) - len(left)
    assert dropped > 0 or least < 0.9
    if least == 0:
        unplaced = np.isnan(proposals.places[..., 0])
        assert (found.candidate[unplaced] >= 0).sum() > 10, (
            "joints without a place are found by their affinities"
        )
