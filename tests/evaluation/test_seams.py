"""What chunks change, on results that were changed by hand."""

from dataclasses import replace

import numpy as np
import pytest

from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.evaluation.seams import compare_seams


@pytest.fixture
def whole() -> Reconstruction:
    """Two people three metres apart in 20 frames; one joint of one is unknown."""
    frame, person = np.repeat(np.arange(20), 2), np.tile([3, 5], 20)
    joints = np.random.default_rng(0).normal(size=(40, 25, 3)) * 0.1 + 3.0 * np.tile([0, 1], 20)[:, None, None]
    joints[7, 4] = np.nan
    empty = Reconstruction.empty(BODY_25.joints)
    rows = {}
    for name in Reconstruction.ROWS:
        column = getattr(empty, name)
        rows[name] = np.zeros((40, *column.shape[1:]), dtype=column.dtype)
    return replace(
        empty, **(rows | {"frame": frame, "person": person, "joints": joints, "status": np.full(40, "ok")})
    )


def test_the_same_result_differs_nowhere(whole):
    same = compare_seams(whole, whole, [8, 14], 2)
    assert (same.seams, same.at_seams_mm, same.away_mm) == (2, 0.0, 0.0)
    assert (same.crossings, same.lost, same.unmatched) == (4, 0, 0)


def test_differences_count_where_they_are_and_rows_belong_together_by_place(whole):
    joints = whole.joints.copy()
    joints[2 * 9, 3] += [0.0, 0.003, 0.004]  # frame 9: one frame behind the seam at 8
    joints[2 * 10 + 1, 2, 0] += 0.002  # frame 10: two behind it
    order = np.arange(40).reshape(20, 2)[:, ::-1].ravel()  # the other person first
    cut = replace(whole, joints=joints[order], person=whole.person[order] + 10)
    found = compare_seams(whole, cut, [8], 2)
    assert found.at_seams_mm == pytest.approx(5.0) and found.away_mm == pytest.approx(2.0)
    assert found.lost == 0 and found.unmatched == 0


def test_identities_that_change_at_a_seam_are_lost_and_so_are_people_who_are_gone(whole):
    person = whole.person.copy()
    person[(whole.frame >= 8) & (person == 3)] = 7
    assert compare_seams(whole, replace(whole, person=person), [8, 14], 2).lost == 1
    keep = np.flatnonzero((whole.frame < 14) | (whole.person == 3))
    gone = replace(whole, **{name: getattr(whole, name)[keep] for name in Reconstruction.ROWS})
    found = compare_seams(whole, gone, [8, 14], 2)
    assert (found.crossings, found.lost, found.unmatched) == (4, 1, 6)
