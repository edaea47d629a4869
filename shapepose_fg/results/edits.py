"""Manual corrections of identities, and which identities must be solved again after each of them.

Every correction is a function from a result to a result; nothing is read or written here. A body
has one shape in all frames, so every identity with changed rows is solved again as a whole; the
others are not.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from shapepose_fg.core.arrays import Mask, Whole
from shapepose_fg.core.bounds import MOST_NUMBER
from shapepose_fg.core.reconstruction import Reconstruction

Solve = Callable[[Reconstruction], Reconstruction]
"""Solves rows of some people again from their `observations`; the same people, maybe in other
frames."""


class Action(StrEnum):
    """Kinds of correction."""

    MERGE = "merge"
    """All rows of `other` get the identity `person`."""
    SPLIT = "split"
    """The rows of `person` from `frame` on get the new identity `other`."""
    RENAME = "rename"
    """`person` gets the unused number `other`."""
    DROP = "drop"
    """All rows of `person` are removed."""
    SWAP = "swap"
    """`person` and `other` exchange their identities from `frame` on."""


_OTHER = frozenset({Action.MERGE, Action.SPLIT, Action.RENAME, Action.SWAP})
_FRAME = frozenset({Action.SPLIT, Action.SWAP})


@dataclass(frozen=True)
class Edit:
    """One correction of identities."""

    action: Action
    """Kind of correction."""
    person: int
    """The identity to correct."""
    other: int | None = None
    """The second identity, for all actions but `drop`."""
    frame: int | None = None
    """First frame of the correction, for `split` and `swap`."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "action", Action(self.action))
        for what, value, actions in (
            ("second person", self.other, _OTHER),
            ("frame", self.frame, _FRAME),
        ):
            if (value is not None) != (self.action in actions):
                raise ValueError(
                    f"{self.action} needs {'a' if self.action in actions else 'no'} {what}"
                )

    def __str__(self) -> str:
        """The correction as typed on the command line."""
        if self.action == Action.SPLIT:
            return f"{self.action} {self.person} {self.frame} --new {self.other}"
        parts = self.action, self.person, self.other, self.frame
        return " ".join(str(part) for part in parts if part is not None)


@dataclass(frozen=True)
class Edited:
    """A result after corrections."""

    people: Reconstruction
    """The rows with their new identities; joints and bodies are unchanged."""
    changed: frozenset[int] = frozenset()
    """Identities with rows from other solves; they must be solved again."""


def free_number(person: Whole) -> int:
    """The next unused identity, given the identities (N,) of all rows."""
    return int(person.max(initial=-1)) + 1


def apply(people: Reconstruction, edit: Edit) -> Edited:
    """Apply one correction; raises ValueError, with the cure, if it is impossible."""
    rows = _rows_of(people, edit.person)
    if edit.action == Action.DROP:
        return Edited(people.rows(~rows))
    if edit.action in (Action.MERGE, Action.SWAP):
        others = _rows_of(people, _other(edit))
        if edit.person == edit.other:
            raise ValueError(f"{edit.action} needs two people, got {edit.person} twice")
        return (_merge if edit.action == Action.MERGE else _swap)(people, edit, rows, others)
    _refuse_taken(people, edit)
    if edit.action == Action.SPLIT:
        return _split(people, edit, rows)
    return _relabelled(people, {edit.person: _other(edit)}, rows, changed=set())


def replay(people: Reconstruction, edits: Sequence[Edit]) -> Edited:
    """Apply corrections in order; `changed` lists what must be solved again after all of them."""
    edited = Edited(people)
    for edit in edits:
        earlier, edited = edited.changed, apply(edited.people, edit)
        if edit.action in (Action.RENAME, Action.SWAP) and not edited.changed:  # renames only
            names = {edit.person: _other(edit), _other(edit): edit.person}
            earlier = frozenset(names.get(each, each) for each in earlier)
        left = frozenset(edited.people.person.tolist())
        edited = replace(edited, changed=(earlier | edited.changed) & left)
    return edited


def undo(original: Reconstruction, current: Reconstruction, edits: Sequence[Edit]) -> Edited:
    """Undo the last of `edits`: returns `original` after all other edits.

    `current` is the result of all edits. Identities that the last correction did not touch keep the
    rows of `current`, which may be solved already.
    """
    before, last = replay(original, edits[:-1]), edits[-1]
    touched = {last.person, last.other} - {None}
    settled = np.array(sorted(before.changed - touched), dtype=np.int64)
    if len(settled) == 0:
        return before
    kept = before.people.rows(~np.isin(before.people.person, settled))
    since = replace(current.rows(np.isin(current.person, settled)), run=kept.run)
    return Edited(in_order(Reconstruction.concatenate([kept, since])), before.changed & touched)


def solve_anew(edited: Edited, solve: Solve) -> Reconstruction:
    """Solve the changed identities again by `solve`; all other rows stay as they are.

    Raises ValueError if the result has no observations, or if `solve` returns other people or no
    observations.
    """
    people, changed = edited.people, np.array(sorted(edited.changed), dtype=np.int64)
    if len(changed) == 0:
        return people
    if people.observations is None:
        raise ValueError(
            "people without observations cannot be solved again; reconstruct them again"
        )
    touched = np.isin(people.person, changed)
    solved = solve(people.rows(touched))
    if not np.isin(solved.person, changed).all() or solved.observations is None:
        raise ValueError("solve must return rows of the given people, with their observations")
    return in_order(
        Reconstruction.concatenate([people.rows(~touched), replace(solved, run=people.run)])
    )


def in_order(people: Reconstruction) -> Reconstruction:
    """The rows sorted by frame, then by person."""
    return people.rows(np.lexsort((people.person, people.frame)))


def _merge(people: Reconstruction, edit: Edit, rows: Mask, others: Mask) -> Edited:
    both = np.intersect1d(people.frame[rows], people.frame[others])
    if len(both) > 0:
        raise ValueError(
            f"{edit.person} and {edit.other} are both present in {len(both)} frames, first in "
            f"{both[0]}, so they are two people; split one of them there, or drop one"
        )
    return _relabelled(people, {_other(edit): edit.person}, others, changed={edit.person})


def _split(people: Reconstruction, edit: Edit, rows: Mask) -> Edited:
    assert edit.frame is not None
    later = rows & (people.frame >= edit.frame)
    if not later.any() or (later == rows).all():
        first, last = int(people.frame[rows].min()), int(people.frame[rows].max())
        if first == last:
            raise ValueError(f"{edit.person} is present in frame {first} only, so cannot be split")
        raise ValueError(
            f"{edit.person} is present in frames {first} to {last} and cannot be split at "
            f"{edit.frame}; give a frame from {first + 1} to {last}"
        )
    return _relabelled(
        people, {edit.person: _other(edit)}, later, changed={edit.person, _other(edit)}
    )


def _swap(people: Reconstruction, edit: Edit, rows: Mask, others: Mask) -> Edited:
    assert edit.frame is not None
    later = (rows | others) & (people.frame >= edit.frame)
    if not later.any():
        last = people.frame[rows | others].max()
        raise ValueError(
            f"neither {edit.person} nor {edit.other} is present from frame {edit.frame} on; give "
            f"a frame up to {last}"
        )
    names = {edit.person: _other(edit), _other(edit): edit.person}
    only_names = later.sum() == (rows | others).sum()  # both begin at or after `frame`
    return _relabelled(people, names, later, changed=set() if only_names else set(names))


def _relabelled(
    people: Reconstruction, names: dict[int, int], rows: Mask, changed: set[int]
) -> Edited:
    """Rename identities in `rows` (N,) of `people`; identities without any row left
    need no solve.
    """
    person = people.person.copy()
    for old, new in names.items():
        person[rows & (people.person == old)] = new
    return Edited(
        in_order(people.relabelled(person)), frozenset(changed) & frozenset(person.tolist())
    )


def _rows_of(people: Reconstruction, person: int) -> Mask:
    """(N,) mask of the rows of one identity; raises ValueError if there is none."""
    rows = people.person == person
    if not rows.any():
        known = np.unique(people.person).tolist()
        listed = " ".join(map(str, known[:20])) + (
            f" and {len(known) - 20} more" if len(known) > 20 else ""
        )
        raise ValueError(f"there is no person {person}; there are {listed or 'none'}")
    return rows


def _refuse_taken(people: Reconstruction, edit: Edit) -> None:
    """Raise ValueError if the new number is in use or out of range."""
    if not 0 <= _other(edit) <= MOST_NUMBER:
        raise ValueError(
            f"{edit.other} is not a valid number of a person; give one from 0 to {MOST_NUMBER}"
        )
    if (people.person == edit.other).any():
        raise ValueError(
            f"{edit.other} is the number of another person; give a free one such as"
            f" {free_number(people.person)}, or merge"
            f" {edit.person} and {edit.other}"
        )


def _other(edit: Edit) -> int:
    """The second identity of a correction, which must have one."""
    assert edit.other is not None
    return edit.other
