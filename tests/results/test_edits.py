"""Who is who, corrected by hand: rows change hands, only who changed is solved anew, all can be
undone.
"""

from dataclasses import replace

import numpy as np
import pytest

from shapepose_fg.core.observation_table import ObservationTable
from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.results.edits import (
    Action,
    Edit,
    Edited,
    apply,
    free_number,
    replay,
    solve_anew,
    undo,
)


def result(tracks: dict[int, range]) -> Reconstruction:
    """People who are there in these frames; every joint of a row is at (first identity, frame,
    0).
    """
    frame = np.concatenate([np.array(frames) for frames in tracks.values()])
    person = np.repeat(list(tracks), [len(frames) for frames in tracks.values()])
    order = np.lexsort((person, frame))
    frame, person = frame[order], person[order]
    N = len(frame)
    joints = np.stack([person, frame, np.zeros(N)], axis=1)[:, None] * np.ones((1, 25, 1))
    table = replace(
        ObservationTable.empty(view_names=["left", "right"]),
        frame=frame,
        person=person,
        candidate=np.tile(np.arange(50).reshape(25, 2), (N, 1, 1)) + 100 * person[:, None, None],
        xy=np.zeros((N, 25, 2, 2)),
        confidence=np.ones((N, 25, 2)),
        residual_px=np.zeros((N, 25, 2, 2)),
        probability=np.ones((N, 25, 2)),
        gate=np.ones((N, 25, 2), dtype=int),
        lead_s=np.zeros((N, 2)),
    )
    return Reconstruction(
        frame=frame,
        person=person,
        joint_names=np.array(BODY_25.joints),
        joints=joints,
        covariance=np.tile(np.eye(3), (N, 25, 1, 1)),
        confidence=np.ones((N, 25)),
        betas=np.zeros((N, 10)),
        global_orient=np.zeros((N, 3)),
        body_pose=np.zeros((N, 23, 3)),
        transl=np.zeros((N, 3)),
        status=np.full(N, "ok"),
        run={"frames": [0, 20]},
        observations=table,
    )


@pytest.fixture
def people() -> Reconstruction:
    """1 and 2 all the time, 5 early and 7 late."""
    return result({1: range(20), 2: range(20), 5: range(3, 8), 7: range(10, 20)})


def frames_of(people: Reconstruction, person: int) -> list[int]:
    return people.frame[people.person == person].tolist()


def spans(edited: Edited) -> dict[int, range]:
    """The frames of each changed identity, first to last."""
    frames = {person: frames_of(edited.people, person) for person in sorted(edited.changed)}
    return {person: range(min(of), max(of) + 1) for person, of in frames.items()}


def names(people: Reconstruction) -> set[int]:
    return set(people.person.tolist())


def solve(rows: Reconstruction) -> Reconstruction:
    """Marks what it was given: z = 1 + how many people were solved together; fills gaps of one
    frame.
    """
    joints = rows.joints.copy()
    joints[..., 2] += len(names(rows))
    return replace(rows, joints=joints)


def test_merge(people):
    edited = apply(people, Edit(Action.MERGE, 5, 7))
    assert names(edited.people) == {1, 2, 5}
    assert frames_of(edited.people, 5) == [*range(3, 8), *range(10, 20)]
    assert spans(edited) == {5: range(3, 20)}
    # Rows keep what they hold, and stay sorted by frame and person, observations with them.
    own = edited.people.person == 5
    assert set(edited.people.joints[own, 0, 0]) == {5, 7}
    order = np.lexsort((edited.people.person, edited.people.frame))
    assert (order == np.arange(len(people))).all()
    np.testing.assert_array_equal(edited.people.observations.person, edited.people.person)
    np.testing.assert_array_equal(
        edited.people.observations.candidate[own, 0, 0], 100 * edited.people.joints[own, 0, 0]
    )


def test_split(people):
    edited = apply(people, Edit(Action.SPLIT, 1, 8, 12))
    assert frames_of(edited.people, 1) == list(range(12)) and frames_of(edited.people, 8) == list(
        range(12, 20)
    )
    assert spans(edited) == {1: range(12), 8: range(12, 20)}
    assert free_number(people.person) == 8 and free_number(Reconstruction.empty().person) == 0


def test_rename_changes_a_number_and_nothing_to_solve(people):
    edited = apply(people, Edit(Action.RENAME, 5, 0))
    assert names(edited.people) == {0, 1, 2, 7} and spans(edited) == {}
    assert frames_of(edited.people, 0) == list(range(3, 8))


def test_drop(people):
    edited = apply(people, Edit(Action.DROP, 2))
    assert names(edited.people) == {1, 5, 7} and spans(edited) == {}
    assert len(edited.people) == len(people) - 20


def test_swap_from_a_frame(people):
    edited = apply(people, Edit(Action.SWAP, 1, 2, 15))
    who = edited.people.joints[:, 0, 0]  # who it was
    for person, other in ((1, 2), (2, 1)):
        own = edited.people.person == person
        late = edited.people.frame >= 15
        assert set(who[own & ~late]) == {person} and set(who[own & late]) == {other}
    assert spans(edited) == {1: range(20), 2: range(20)}
    # From before both began it is two names that change places; from the middle of a gap, rows
    # still change hands.
    assert spans(apply(people, Edit(Action.SWAP, 5, 7, 0))) == {}
    assert spans(apply(people, Edit(Action.SWAP, 5, 7, 9))) == {5: range(3, 20)}


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (
            Edit(Action.MERGE, 1, 5),
            "1 and 5 are both present in 5 frames, first in 3, so they are two people; split",
        ),
        (Edit(Action.MERGE, 1, 1), "merge needs two people, got 1 twice"),
        (Edit(Action.MERGE, 1, 6), "there is no person 6; there are 1 2 5 7"),
        (
            Edit(Action.SPLIT, 5, 8, 3),
            "5 is present in frames 3 to 7 and cannot be split at 3; give a frame from 4 to 7",
        ),
        (Edit(Action.SPLIT, 5, 8, 8), "cannot be split at 8"),
        (
            Edit(Action.SPLIT, 5, 7, 5),
            "7 is the number of another person; give a free one such as 8, or merge 5 and 7",
        ),
        (Edit(Action.RENAME, 5, 7), "7 is the number of another person"),
        (Edit(Action.RENAME, 5, -1), "-1 is not a valid number of a person; give one from 0"),
        (
            Edit(Action.SWAP, 1, 2, 20),
            "neither 1 nor 2 is present from frame 20 on; give a frame up to 19",
        ),
        (Edit(Action.DROP, 3), "there is no person 3"),
    ],
)
def test_what_cannot_be_done(people, edit, message):
    with pytest.raises(ValueError, match=message):
        apply(people, edit)
    with pytest.raises(ValueError, match="5 is present in frame 4 only, so cannot be split"):
        apply(people.rows(people.frame == 4), Edit(Action.SPLIT, 5, 8, 4))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("merge", 1), "merge needs a second person"),
        (("drop", 1, 2), "drop needs no second person"),
        (("split", 1, 2), "split needs a frame"),
        (("hide", 1), "'hide' is not a valid Action"),
    ],
)
def test_corrections_that_are_none(arguments, message):
    with pytest.raises(ValueError, match=message):
        Edit(*arguments)


def test_several_corrections_name_who_is_to_be_solved_in_the_end(people):
    edits = [
        Edit(Action.MERGE, 5, 7),
        Edit(Action.RENAME, 5, 3),
        Edit(Action.SWAP, 1, 2, 10),
        Edit(Action.DROP, 2),
    ]
    edited = replay(people, edits)
    assert names(edited.people) == {1, 3}
    assert spans(edited) == {1: range(20), 3: range(3, 20)}
    assert replay(people, []).changed == frozenset()
    twice = replay(people, [Edit(Action.MERGE, 5, 7), Edit(Action.SPLIT, 5, 8, 5)])
    assert twice.changed == {5, 8}  # who changes again is still to be solved


def test_only_who_changed_is_solved_anew(people):
    edited = apply(people, Edit(Action.MERGE, 5, 7))
    solved = solve_anew(edited, solve)
    own = solved.person == 5
    np.testing.assert_array_equal(solved.joints[own, :, 2], 1.0)
    np.testing.assert_array_equal(solved.joints[~own], edited.people.joints[~own])
    np.testing.assert_array_equal(solved.frame, edited.people.frame)
    assert solved.run == people.run

    def must_not_run(rows: Reconstruction) -> Reconstruction:
        raise AssertionError("nothing is to be solved")

    assert solve_anew(apply(people, Edit(Action.DROP, 2)), must_not_run).run == people.run


def test_a_solver_may_fill_gaps_but_not_return_other_people(people):
    def fills(rows: Reconstruction) -> Reconstruction:
        between = rows.rows(np.flatnonzero(rows.frame == 7))
        table = replace(between.observations, frame=np.array([8]))
        return Reconstruction.concatenate(
            [rows, replace(between, frame=np.array([8]), observations=table)]
        )

    solved = solve_anew(apply(people, Edit(Action.MERGE, 5, 7)), fills)
    assert frames_of(solved, 5) == [*range(3, 9), *range(10, 20)]
    assert (np.diff(solved.frame) >= 0).all()
    for wrong in (lambda rows: people, lambda rows: replace(rows, observations=None)):
        with pytest.raises(ValueError, match="rows of the given people, with their observations"):
            solve_anew(apply(people, Edit(Action.MERGE, 5, 7)), wrong)
    with pytest.raises(ValueError, match="people without observations cannot be solved again"):
        solve_anew(apply(replace(people, observations=None), Edit(Action.MERGE, 5, 7)), solve)


def test_undo_solves_only_what_the_last_correction_touched(people):
    edits = [Edit(Action.MERGE, 5, 7), Edit(Action.SWAP, 1, 2, 10)]
    current = people
    for edit in edits:
        current = solve_anew(apply(current, edit), solve)
    before = undo(people, current, edits)
    # 1 and 2 are as they were found, and need no solving; 5 was solved when it was merged, and is
    # kept.
    assert before.changed == frozenset()
    expected = solve_anew(apply(people, edits[0]), solve)
    np.testing.assert_array_equal(before.people.person, expected.person)
    np.testing.assert_array_equal(before.people.joints, expected.joints)
    # Two corrections of the same person: the first's outcome is not there any more.
    edits = [Edit(Action.MERGE, 5, 7), Edit(Action.SPLIT, 5, 8, 15)]
    current = solve_anew(replay(people, edits), solve)
    before = undo(people, current, edits)
    assert spans(before) == {5: range(3, 20)}
    np.testing.assert_array_equal(solve_anew(before, solve).joints, expected.joints)


def test_undo_keeps_what_was_solved_of_somebody_who_changed_names_since(people):
    """Who was merged is called 1 by then; undoing what is done to somebody else leaves them
    solved.
    """
    edits = [Edit(Action.MERGE, 5, 7), Edit(Action.SWAP, 1, 5, 0), Edit(Action.DROP, 2)]
    assert spans(replay(people, edits[:2])) == {1: range(3, 20)}
    states = [people]
    for edit in edits:
        states.append(solve_anew(apply(states[-1], edit), solve))
    before = undo(people, states[3], edits)
    assert before.changed == frozenset()
    np.testing.assert_array_equal(before.people.person, states[2].person)
    np.testing.assert_array_equal(before.people.joints, states[2].joints)
    assert (before.people.joints[before.people.person == 1, :, 2] == 1.0).all(), "solved, once"


@pytest.mark.parametrize("seed", range(20))
def test_any_corrections_keep_every_row_once_and_undo_one_by_one(people, seed):
    """Random corrections: nobody is twice in a frame, no row is there twice, undoing leads back
    step by step.
    """
    rng = np.random.default_rng(seed)
    edits: list[Edit] = []
    states = [people]
    while len(edits) < 6:
        known = sorted(names(states[-1]))
        action = Action(rng.choice(list(Action)))
        person, other = (int(rng.choice(known)) for _ in range(2))
        if action in (Action.SPLIT, Action.RENAME):
            other = free_number(states[-1].person)
        edit = Edit(
            action,
            person,
            None if action is Action.DROP else other,
            int(rng.integers(20)) if action in (Action.SPLIT, Action.SWAP) else None,
        )
        if action is Action.DROP and len(known) <= 2:
            continue
        try:
            edited = apply(states[-1], edit)
        except ValueError:
            continue
        edits.append(edit)
        states.append(edited.people)
    for edited in states:
        pairs = np.stack([edited.frame, edited.person], axis=1)
        assert len(np.unique(pairs, axis=0)) == len(pairs)
        found = np.stack([edited.joints[:, 0, 0], edited.joints[:, 0, 1]], axis=1)
        assert len(np.unique(found, axis=0)) == len(found)
        np.testing.assert_array_equal(
            edited.observations.candidate[:, 0, 0], 100 * edited.joints[:, 0, 0]
        )
    np.testing.assert_array_equal(replay(people, edits).people.person, states[-1].person)
    for count in range(len(edits), 0, -1):
        before = undo(people, states[count], edits[:count])
        assert isinstance(before, Edited)
        np.testing.assert_array_equal(before.people.person, states[count - 1].person)
        np.testing.assert_array_equal(before.people.joints, states[count - 1].joints)
