"""The result of a run, made of its parts column by column: in memory, or straight into the files."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.observation_table import ObservationTable
from shapepose_fg.core.reconstruction import Reconstruction, count_rows
from shapepose_fg.core.result_files import write_result
from shapepose_fg.core.shapes import SubjectShapes
from shapepose_fg.core.storage.npz import Pieces
from shapepose_fg.core.storage.schema import Table
from shapepose_fg.pipeline.bodies_over_time import BodiesOverTime, Person
from shapepose_fg.pipeline.runs.parts import OBSERVED, Parts, RowsOfPeople


@dataclass(frozen=True)
class Assembly:
    """The parts of a run, and what makes a result of them."""

    parts: Parts
    """The solved windows."""
    joint_names: Sequence[str]
    """(J,) names of the joints."""
    view_names: Sequence[str]
    """(V,) names of the cameras."""
    names: Mapping[int, int] = field(default_factory=dict)
    """What tracks are called in the result; who is not in it keeps the name."""
    bodies: BodiesOverTime | None = None
    """Bodies that take the place of the windows' own."""
    run: dict[str, Any] = field(default_factory=dict)
    """How it came about (`Reconstruction.run`)."""

    def __len__(self) -> int:
        return self.parts.rows

    @property
    def shapes(self) -> SubjectShapes | None:
        """Everybody's shape."""
        return None if self.bodies is None else self.bodies.shapes

    @cached_property
    def persons(self) -> list[NDArray[np.int64]]:
        """For each part (R,) who its rows are."""
        tracks = (self.parts.column(n, "person").tolist() for n in range(len(self.parts)))
        return [np.array([self.names.get(each, each) for each in track], dtype=np.int64) for track in tracks]

    @cached_property
    def people(self) -> RowsOfPeople:
        """Everybody's rows."""
        return RowsOfPeople(self.parts, self.persons)

    def person(self, number: int, rows: Sequence[range]) -> Person:
        """What somebody's bodies are fitted to, in some of somebody's own rows, one range after the other."""
        columns = ("joints", "covariance", "time_s")
        pieces = [
            piece for part in rows for piece in self.people.pieces(number, columns, slice(part.start, part.stop))
        ]
        return Person.of(number, *(np.concatenate(column) for column in zip(*pieces, strict=True)))

    def pieces(self, name: str) -> Iterator[NDArray[Any]]:
        """A column of people.npz, or of observations.npz (`OBSERVED`), part by part."""
        before: Counter[int] = Counter()
        for n, person in enumerate(self.persons):
            yield self._piece(n, name, before)
            before.update(person.tolist())

    def counts(self) -> dict[str, Any]:
        """What run.json says of the rows (`Reconstruction.counts`)."""
        return count_rows(zip(self.pieces("status"), self.pieces("known"), strict=True))

    def columns(self) -> dict[str, Pieces]:
        """What people.npz holds."""
        return self._columns(Reconstruction.empty(self.joint_names), "")

    def observation_columns(self) -> dict[str, Pieces] | None:
        """What observations.npz holds; None where there are no rows."""
        empty = ObservationTable.empty(self.joint_names, self.view_names)
        return self._columns(empty, OBSERVED) if len(self) > 0 else None

    def reconstruction(self, every: int = 1, *, consume: bool = False) -> Reconstruction:
        """In memory, all of it or every so many frames.

        With `consume` the parts are given up as they are read, so that rows are not in memory twice; nothing else
        can be made of them afterwards.
        """
        chosen = [np.flatnonzero(frame % every == 0) for frame in self.pieces("frame")]
        empty = Reconstruction.empty(self.joint_names)
        unseen = ObservationTable.empty(self.joint_names, self.view_names) if len(self) > 0 else None
        columns = {name: each for name, each in self.columns().items() if name in empty.ROWS}
        if unseen is not None:
            table = self._columns(unseen, OBSERVED)
            columns |= {OBSERVED + name: table[name] for name in unseen.ROWS}
        count = sum(map(len, chosen))
        rows = {name: np.empty((count, *each.shape[1:]), each.dtype) for name, each in columns.items()}
        before: Counter[int] = Counter()
        stop = 0
        for n, (mine, person) in enumerate(zip(chosen, self.persons, strict=True)):
            start, stop = stop, stop + len(mine)
            for name, all_rows in rows.items():
                all_rows[start:stop] = self._piece(n, name, before)[mine]
            before.update(person.tolist())
            if consume:
                self.parts.drop(n)
        if unseen is not None:
            unseen = replace(unseen, **{name: rows.pop(OBSERVED + name) for name in unseen.ROWS})
        return replace(empty, **rows, run=self.run, observations=unseen, shapes=self.shapes)

    def save(self, folder: Path) -> None:
        """Write people.npz, observations.npz and run.json as `Reconstruction.save` does; it is never all in
        memory.
        """
        write_result(folder, self.columns(), self.observation_columns(), self.run)

    def with_run(self, **entries: Any) -> "Assembly":
        """The same with more to say in run.json."""
        return replace(self, run=self.run | entries)

    def _piece(self, n: int, name: str, before: Mapping[int, int]) -> NDArray[Any]:
        """A column of a part; `before` is how many rows everybody has in the parts before it."""
        if name.removeprefix(OBSERVED) == "person":
            return self.persons[n]
        values = self.parts.column(n, name)
        return values if self.bodies is None else self.bodies.filled(name, values, self.persons[n], before)

    def _columns(self, empty: Table, prefix: str) -> dict[str, Pieces]:
        """The columns of an `empty` table with the rows of all parts."""
        return {
            name: Pieces(each.dtype, (len(self), *each.shape[1:]), partial(self.pieces, prefix + name))
            if name in empty.ROWS
            else each
            for name, each in empty.columns().items()
        }
