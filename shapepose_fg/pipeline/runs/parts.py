"""Solved windows, kept one after the other: what a run has done so far, and from where it can go on."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.observation_table import ObservationTable
from shapepose_fg.core.reconstruction import Reconstruction, Status
from shapepose_fg.core.storage.kept_arrays import KeptArrays
from shapepose_fg.pipeline.runs.checkpoint import Checkpoint, checkpoint_arrays, checkpoint_of
from shapepose_fg.pipeline.runs.notes import Notes
from shapepose_fg.tracking.hypotheses import Input

_STATUS = np.array([*map(str, Status)])
"""A status is kept as its place in this list."""
OBSERVED = "observations."
"""What the names of observations' columns begin with, among those of a part."""


@dataclass(frozen=True)
class Part:
    """One window, solved."""

    rows: Reconstruction
    """Its rows; a person is a track there, or without time a number within the frame."""
    notes: Notes
    """What is to be said about it."""
    checkpoint: Checkpoint | None = None
    """From where following goes on after it, where that is known."""


class Parts:
    """The windows of a run, in order."""

    def __init__(self, kept: KeptArrays) -> None:
        """Those that are in `kept`, up to the last from which the run can go on."""
        self.kept = kept
        followed = kept.names("followed-")
        self._followed = followed[-1] if followed else None
        done = int(followed[-1].split("-")[1]) + 1 if followed else 0
        for name in followed[:-1]:
            kept.drop(name)
        self._counts = [len(kept.array(_name(n), "frame")) for n in range(done)]

    def __len__(self) -> int:
        return len(self._counts)

    @property
    def rows(self) -> int:
        """How many rows all of them have."""
        return sum(self._counts)

    def append(self, part: Part) -> None:
        """Keep the next window. When this returns, and it has a checkpoint, the run can go on behind it."""
        n, rows, table = len(self), part.rows, part.rows.observations
        if table is None:
            raise ValueError("the rows of a part need their observations")
        arrays = {
            OBSERVED + name: getattr(table, name) for name in table.ROWS[2:]
        }  # frame and person are those of rows
        arrays |= {name: getattr(rows, name) for name in rows.ROWS}
        arrays["status"] = np.argmax(rows.status[:, None] == _STATUS, axis=1).astype(np.uint8)
        self.kept.keep(_name(n), arrays, part.notes.as_dict())
        self._counts.append(len(rows))
        if part.checkpoint is not None and self.kept.lasting:
            before, self._followed = self._followed, f"followed-{n:06d}"
            self.kept.keep(self._followed, checkpoint_arrays(part.checkpoint))
            if before is not None:
                self.kept.drop(before)

    def column(self, n: int, name: str) -> NDArray[Any]:
        """A column of a part, by its name in people.npz, or in observations.npz with `OBSERVED` before it."""
        shared = name.removeprefix(OBSERVED)
        values = self.kept.array(_name(n), shared if shared in ObservationTable.ROWS[:2] else name)
        return _STATUS[values] if name == "status" else values

    def drop(self, n: int) -> None:
        """Forget the rows of a part."""
        self.kept.drop(_name(n))

    def notes(self) -> Notes:
        """What is to be said about all of them."""
        notes = Notes()
        for n in range(len(self)):
            notes.add(Notes.from_dict(self.kept.about(_name(n))))
        return notes

    def checkpoint(self, read: Callable[[int], Input]) -> Checkpoint | None:
        """From where following goes on; None at the beginning. `read` gives what the cameras saw of a frame."""
        name = self._followed
        if name is None:
            return None
        return checkpoint_of(lambda key: self.kept.array(name, key), self.kept.keys(name), read)


def _name(n: int) -> str:
    return f"part-{n:06d}"


@dataclass(frozen=True)
class RowsOfPeople:
    """The rows of one person, or track, out of all parts of a run: read when they are asked for."""

    parts: Parts
    """The solved windows."""
    whose: Sequence[NDArray[np.integer]]
    """For each part (R,) whose its rows are."""

    @cached_property
    def counts(self) -> dict[int, int]:
        """How many rows everybody has, by number."""
        return {number: sum(count for _, count in places) for number, places in sorted(self._places.items())}

    def pieces(
        self, number: int, columns: Sequence[str], rows: slice = slice(None)
    ) -> Iterator[tuple[NDArray[Any], ...]]:
        """`columns` of somebody's rows, part by part; `rows` counts among somebody's own."""
        start, stop, _ = rows.indices(self.counts[number])
        before = 0
        for n, count in self._places[number]:
            first, last = max(start - before, 0), min(stop - before, count)
            before += count
            if first < last:
                mine = np.flatnonzero(self.whose[n] == number)[first:last]
                yield tuple(self.parts.column(n, name)[mine] for name in columns)

    @cached_property
    def _places(self) -> dict[int, list[tuple[int, int]]]:
        """In which parts everybody is, and in how many rows of each."""
        places: dict[int, list[tuple[int, int]]] = {}
        for n, whose in enumerate(self.whose):
            numbers, counts = np.unique(whose, return_counts=True)
            for number, count in zip(numbers.tolist(), counts.tolist(), strict=True):
                places.setdefault(number, []).append((n, count))
        return places
