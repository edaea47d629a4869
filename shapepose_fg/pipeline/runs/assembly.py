"""The result of a run, made of its parts column by column: in memory, or straight into the files."""

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.body.shapes import SubjectShapes
from shapepose_fg.core.observation_table import ObservationTable
from shapepose_fg.core.reconstruction import Reconstruction, count_rows, shared_columns
from shapepose_fg.core.result_files import write_result
from shapepose_fg.core.storage.npz_writer import Column
from shapepose_fg.pipeline.bodies_over_time import BodiesOverTime, Person
from shapepose_fg.pipeline.runs.parts import OBSERVED, Parts
from shapepose_fg.pipeline.runs.rows_of_people import RowsOfPeople


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
        return [self._named(self.parts.column(n, "person")) for n in range(len(self.parts))]

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

    def columns(self) -> dict[str, Column]:
        """What people.npz holds."""
        empty = Reconstruction.empty(self.joint_names)
        return self._columns(empty.columns(), Reconstruction.ROWS, "") | shared_columns(empty.joint_names)

    def observation_columns(self) -> dict[str, Column] | None:
        """What observations.npz holds; None where there are no rows."""
        if len(self) == 0:
            return None
        empty = ObservationTable.empty(self.joint_names, self.view_names).columns()
        return self._columns(empty, ObservationTable.ROWS, OBSERVED)

    def reconstruction(self, every: int = 1, *, consume: bool = False) -> Reconstruction:
        """In memory, all of it or every so many frames.

        With `consume` the parts are given up as they are read, so that rows are not in memory twice; nothing else
        can be made of them afterwards.
        """
        chosen = [np.flatnonzero(frame % every == 0) for frame in self.pieces("frame")]
        people, table = self.columns(), self.observation_columns() or {}
        tables = (("", people, Reconstruction.ROWS), (OBSERVED, table, ObservationTable.ROWS))
        rows = {
            prefix + name: np.empty((sum(map(len, chosen)), *columns[name].shape[1:]), columns[name].dtype)
            for prefix, columns, names in tables
            for name in names
            if name in columns
        }
        before: Counter[int] = Counter()
        stop = 0
        for n, (mine, person) in enumerate(zip(chosen, self.persons, strict=True)):
            start, stop = stop, stop + len(mine)
            for name, all_rows in rows.items():
                all_rows[start:stop] = self._piece(n, name, before)[mine]
            before.update(person.tolist())
            if consume:
                self.parts.drop(n)
        observed = None
        if len(table) > 0:
            names = [name for name in table if name != "gate_names"]
            observed = ObservationTable(**{name: _array(table[name], rows.get(OBSERVED + name)) for name in names})
        columns = {name: _array(people[name], rows.get(name)) for name in people if name != "known_names"}
        return Reconstruction(**columns, run=self.run, observations=observed, shapes=self.shapes)

    def save(self, folder: Path) -> None:
        """Write people.npz, observations.npz and run.json as `Reconstruction.save` does, without having it all in
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

    def _named(self, track: NDArray[np.int64]) -> NDArray[np.int64]:
        """(R,) what each row's track is called."""
        return np.array([self.names.get(each, each) for each in track.tolist()], dtype=np.int64)

    def _columns(self, empty: Mapping[str, Column], rows: Sequence[str], prefix: str) -> dict[str, Column]:
        """`empty` columns with the rows of all parts."""

        def pieces(name: str) -> Callable[[], Iterator[NDArray[Any]]]:
            return lambda: self.pieces(prefix + name)

        return {
            name: Column(each.dtype, (len(self), *each.shape[1:]), pieces(name)) if name in rows else each
            for name, each in empty.items()
        }


def _array(column: Column, rows: NDArray[Any] | None) -> NDArray[Any]:
    """The rows of a column, where it has some."""
    return column.array() if rows is None else rows
