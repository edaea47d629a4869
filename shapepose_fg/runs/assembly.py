"""The result of a run, made of its parts column by column: in memory, or straight into the files."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.bodies_over_time import BodiesOverTime
from shapepose_fg.body.shapes import SubjectShapes
from shapepose_fg.npz_writer import Column
from shapepose_fg.observation_table import ObservationTable
from shapepose_fg.person_bodies import Person
from shapepose_fg.reconstruction import Reconstruction, count_rows, shared_columns
from shapepose_fg.result_files import write_result
from shapepose_fg.runs.parts import OBSERVED, Parts
from shapepose_fg.runs.rows_of_people import RowsOfPeople


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

    def person(self, number: int, rows: slice) -> Person:
        """What somebody's bodies are fitted to, in some of somebody's own rows."""
        pieces = self.people.pieces(number, ("joints", "covariance", "time_s"), rows)
        return Person.of(number, *(np.concatenate(column) for column in zip(*pieces, strict=True)))

    def pieces(self, name: str) -> Iterator[NDArray[Any]]:
        """A column of people.npz, or of observations.npz (`OBSERVED`), part by part."""
        before: dict[int, int] = {}
        for n, person in enumerate(self.persons):
            if name.removeprefix(OBSERVED) == "person":
                yield person
                continue
            values = self.parts.column(n, name)
            if self.bodies is not None:
                values = self.bodies.filled(name, values, person, before)
                numbers, counts = np.unique(person, return_counts=True)
                for number, count in zip(numbers.tolist(), counts.tolist(), strict=True):
                    before[number] = before.get(number, 0) + count
            yield values

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

    def reconstruction(self, every: int = 1) -> Reconstruction:
        """In memory, all of it or every so many frames."""

        def array(column: Column) -> NDArray[Any]:
            if column.shape[:1] != (len(self),) or every == 1:
                return column.array()
            frames = self.pieces("frame")
            return np.concatenate(
                [piece[frame % every == 0] for piece, frame in zip(column.pieces(), frames, strict=True)]
            )

        columns = {name: array(column) for name, column in self.columns().items() if name != "known_names"}
        observed = self.observation_columns()
        table = None
        if observed is not None:
            table = ObservationTable(
                **{name: array(column) for name, column in observed.items() if name != "gate_names"}
            )
        return Reconstruction(**columns, run=self.run, observations=table, shapes=self.shapes)

    def save(self, folder: Path) -> None:
        """Write people.npz, observations.npz and run.json as `Reconstruction.save` does, without having it all in
        memory.
        """
        write_result(folder, self.columns(), self.observation_columns(), self.run)

    def with_run(self, **entries: Any) -> "Assembly":
        """The same with more to say in run.json."""
        return replace(self, run=self.run | entries)

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
