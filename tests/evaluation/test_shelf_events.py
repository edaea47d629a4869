import numpy as np
import pytest

from shapepose_fg.evaluation.shelf import LIMB_NAMES, MatchedActors
from shapepose_fg.evaluation.shelf_events import (
    LostLimb,
    blocks_of,
    identity_switches,
    lost_limbs,
    pcp_interval,
)


def matched(frame, actor, wrong=(), row=None):
    """Actors with every limb right but those of `wrong`: (index of the annotation, limb)."""
    count = len(frame)
    right = np.ones((count, 10), dtype=bool)
    for index, limb in wrong:
        right[index, limb] = False
    row = np.arange(count) if row is None else np.array(row)
    return MatchedActors(np.array(frame), np.array(actor), row, np.zeros((count, 15)), right)


def test_consecutive_losses_are_one_event():
    """Limb 2 of actor 2 in frames 3, 4, 5 and 9; frame 6 is right, 7 and 8 are not annotated."""
    people = matched([3, 4, 5, 6, 9], [1] * 5, wrong=[(0, 2), (1, 2), (2, 2), (4, 2), (3, 8)])
    assert lost_limbs(people) == [
        LostLimb(2, LIMB_NAMES[2], 3, 5),
        LostLimb(2, LIMB_NAMES[2], 9, 9),
        LostLimb(2, LIMB_NAMES[8], 6, 6),
    ]
    assert str(lost_limbs(people)[0]) == "actor 2, left lower arm, frames 3-5"
    assert lost_limbs(matched([0, 1], [0, 0])) == []


def test_the_order_of_annotations_does_not_matter():
    people = matched([5, 3, 4], [0, 0, 0], wrong=[(0, 1), (1, 1), (2, 1)])
    assert lost_limbs(people) == [LostLimb(1, LIMB_NAMES[1], 3, 5)]


def test_blocks_end_at_gaps():
    assert blocks_of(np.array([0, 1, 2, 3, 4, 10, 11, 12, 13]), 3).tolist() == [0, 0, 0, 1, 1, 2, 2, 2, 3]
    assert blocks_of(np.array([11, 10, 0, 0]), 3).tolist() == [1, 1, 0, 0]


def test_the_interval_of_a_score_without_errors_is_a_point():
    assert pcp_interval(matched(range(40), [0] * 40)) == (100.0, 100.0)


def test_the_interval_is_that_of_the_binomial_over_blocks():
    """40 blocks of one actor, half of them all wrong: the mean of 40 draws has sigma 100 / (2 sqrt 40) = 7.9."""
    frame = np.arange(40) * 2  # every frame its own block
    people = matched(frame, [2] * 40, wrong=[(index, limb) for index in range(20) for limb in range(10)])
    low, high = pcp_interval(people, draws=4000)
    # Quantiles of 4,000 draws are good to 0.4, and the mean of 40 moves in steps of 2.5.
    assert low == pytest.approx(50 - 1.96 * 7.9, abs=2.6)
    assert high == pytest.approx(50 + 1.96 * 7.9, abs=2.6)


def test_errors_that_last_make_the_interval_wide():
    wrong = [(index, limb) for index in range(30) for limb in range(10)]
    people = matched(range(60), [0] * 60, wrong)
    wide, narrow = pcp_interval(people, block_frames=15), pcp_interval(people, block_frames=1)
    assert wide[1] - wide[0] > 2 * (narrow[1] - narrow[0])


def test_identity_switches():
    """Actor 1 is 7, 7, 8, 8; actor 2 is 3 and, after a frame in which nobody is near, 3 again."""
    people = matched([0, 1, 2, 3, 0, 1, 2], [0, 0, 0, 0, 1, 1, 1], row=[0, 1, 2, 3, 4, -1, 5])
    distance = people.distance.copy()
    distance[5] = np.nan
    people = MatchedActors(people.frame, people.actor, people.row, distance, people.limbs_right)
    assert identity_switches(people, np.array([7, 7, 8, 8, 3, 3])) == 1
