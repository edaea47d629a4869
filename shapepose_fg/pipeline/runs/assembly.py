"""Assembles the result of a run from its parts, by column: in memory, or directly into files."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.body.model.body_model import BodyModel
from shapepose_fg.body.model.soles import lowest_of_feet
from shapepose_fg.core.arrays import Array
from shapepose_fg.core.observation_table import ObservationTable
from shapepose_fg.core.reconstruction import (
    BODY,
    Known,
    Reconstruction,
    Status,
    check_files,
    count_rows,
)
from shapepose_fg.core.result_files import write_result
from shapepose_fg.core.shapes import SubjectShapes
from shapepose_fg.core.storage.npz import Pieces
from shapepose_fg.core.storage.schema import Table
from shapepose_fg.estimation.contact import feet_of
from shapepose_fg.estimation.floor import MEASUREMENT_S, Floor, find_floor
from shapepose_fg.pipeline.person_shapes import WindowBodies
from shapepose_fg.pipeline.runs.parts import OBSERVED, Parts

_STANDS_M_S = 0.1
"""Maximum speed of a visible heel or toe that stands, m/s; also the maximum standard deviation of
its velocity per axis."""


@dataclass(frozen=True)
class Assembly:
    """Parts of a run, with all data for assembling a result."""

    parts: Parts
    """The solved windows."""
    joint_names: Sequence[str]
    """(J,) names of the joints."""
    view_names: Sequence[str]
    """(V,) names of the cameras."""
    names: Mapping[int, int] = field(default_factory=dict)
    """Identities of tracks in the result; tracks not listed keep their number."""
    shapes: SubjectShapes | None = None
    """The shapes of all people. With them, stored bodies (`keep_bodies`) replace those of the
    windows."""
    run: dict[str, Any] = field(default_factory=dict)
    """Origin of the result (`Reconstruction.run`)."""

    def __len__(self) -> int:
        return self.parts.rows

    @cached_property
    def persons(self) -> list[NDArray[np.int64]]:
        """Identities (R,) of the rows of each part."""
        tracks = (self.parts.column(n, "person").tolist() for n in range(len(self.parts)))
        return [
            np.array([self.names.get(each, each) for each in track], dtype=np.int64)
            for track in tracks
        ]

    @cached_property
    def parts_of(self) -> dict[int, list[int]]:
        """For each person, by number, the parts with rows of the person."""
        found: dict[int, list[int]] = {}
        for n, person in enumerate(self.persons):
            for number in np.unique(person).tolist():
                found.setdefault(number, []).append(n)
        return dict(sorted(found.items()))

    def own_pieces(self, number: int, columns: Sequence[str]) -> Iterator[tuple[NDArray[Any], ...]]:
        """`columns` of one person's rows, by part."""
        for n in self.parts_of[number]:
            of_person = self.persons[n] == number
            yield tuple(self.parts.column(n, name)[of_person] for name in columns)

    def bodies(self, n: int) -> WindowBodies:
        """The bodies of a part, as they were solved."""
        _, *names = WindowBodies.__dataclass_fields__
        return WindowBodies(self.persons[n], *(self.parts.column(n, name) for name in names))

    def keep_bodies(self, n: int, columns: Mapping[str, Array]) -> None:
        """Store bodies of a part, by column."""
        self.parts.kept.keep(_bodies(n), columns)

    def pieces(self, name: str) -> Iterator[NDArray[Any]]:
        """A column of people.npz, or of observations.npz (`OBSERVED`), by part."""
        for n in range(len(self.parts)):
            yield self._piece(n, name)

    def counts(self) -> dict[str, Any]:
        """The entry of run.json about the rows (`Reconstruction.counts`)."""
        return count_rows(zip(self.pieces("status"), self.pieces("known"), strict=True))

    def columns(self) -> dict[str, Pieces]:
        """The columns of people.npz."""
        return self._columns(Reconstruction.empty(self.joint_names), "")

    def observation_columns(self) -> dict[str, Pieces] | None:
        """The columns of observations.npz; None without rows."""
        empty = ObservationTable.empty(self.joint_names, self.view_names)
        return self._columns(empty, OBSERVED) if len(self) > 0 else None

    def reconstruction(self, every: int = 1, *, consume: bool = False) -> Reconstruction:
        """The result in memory, all of it or every n-th frame.

        With `consume`, the parts are released after reading, so that rows are not in memory twice;
        nothing else can be assembled afterwards.
        """
        chosen = [np.flatnonzero(frame % every == 0) for frame in self.pieces("frame")]
        empty = Reconstruction.empty(self.joint_names)
        columns = {name: each for name, each in self.columns().items() if name in empty.ROWS}
        seen = self.observation_columns() or {}
        columns |= {
            OBSERVED + name: each for name, each in seen.items() if name in ObservationTable.ROWS
        }
        count = sum(map(len, chosen))
        rows = {
            name: np.empty((count, *each.shape[1:]), each.dtype) for name, each in columns.items()
        }
        stop = 0
        for n, index in enumerate(chosen):
            start, stop = stop, stop + len(index)
            for name, all_rows in rows.items():
                all_rows[start:stop] = self._piece(n, name)[index]
            if consume:
                self.parts.drop(n)
                self.parts.kept.drop(_bodies(n))
        table = None
        if len(self) > 0:
            table = ObservationTable.empty(self.joint_names, self.view_names)
            table = replace(table, **{name: rows.pop(OBSERVED + name) for name in table.ROWS})
        return replace(empty, **rows, run=self.run, observations=table, shapes=self.shapes)

    def save(self, folder: Path) -> None:
        """Write the files of `Reconstruction.save`, without all of it in memory at once."""
        write_result(folder, self.columns(), self.observation_columns(), self.run, check_files)

    def with_run(self, **entries: Any) -> "Assembly":
        """Return a copy with further entries in run.json."""
        return replace(self, run=self.run | entries)

    def _piece(self, n: int, name: str) -> NDArray[Any]:
        """A column of a part."""
        if name.removeprefix(OBSERVED) == "person":
            return self.persons[n]
        if name in BODY and self.shapes is not None:
            return self.parts.kept.array(_bodies(n), name)
        return self.parts.column(n, name)

    def _columns(self, empty: Table, prefix: str) -> dict[str, Pieces]:
        """The columns of an `empty` table with the rows of all parts."""
        return {
            name: Pieces(
                each.dtype, (len(self), *each.shape[1:]), partial(self.pieces, prefix + name)
            )
            if name in empty.ROWS
            else each
            for name, each in empty.columns().items()
        }

    def floor(self, model: BodyModel, up: Array) -> Floor | str:
        """The floor under the soles of all bodies, or the reason why none was found; `up` (3,)
        points up.
        """
        joints, parts = tuple(self.joint_names), self.parts
        # Ankles do not determine the soles: unseen feet follow the body's prior.
        soles = [n for n in feet_of(joints).tolist() if not joints[n].endswith("Ankle")]
        sides = [[n for n in soles if joints[n].startswith(side)] for side in "RL"]
        if len(soles) == 0:
            return "the detector has no heels and toes"
        points, measurements = [], []
        # Approximate number of rows, spread over all frames, for finding the floor.
        every = 1 + (len(self) - 1) // 4000
        for n in range(len(parts)):
            speed, spread = parts.column(n, "velocity"), parts.column(n, "velocity_covariance")
            with np.errstate(invalid="ignore"):
                still = np.linalg.norm(speed, axis=2) < _STANDS_M_S
                still &= np.trace(spread, axis1=2, axis2=3) < 3 * _STANDS_M_S**2
            still &= parts.column(n, "known") == Known.SEEN
            stands = np.stack([still[:, side].any(axis=1) for side in sides], axis=1)
            stands &= (parts.column(n, "frame") % every == 0)[:, None]
            stands &= (parts.column(n, "status") == Status.OK)[:, None]
            rows, side = np.nonzero(stands)
            betas, orient, pose, transl = (parts.column(n, name)[rows] for name in BODY)
            points.append(
                lowest_of_feet(model, (betas, orient, pose, transl), up)[np.arange(len(rows)), side]
            )
            interval = (parts.column(n, "time_s")[rows] // MEASUREMENT_S).astype(np.int64)
            measurements.append(np.stack([parts.column(n, "person")[rows], side, interval], axis=1))
        group = np.unique(np.concatenate(measurements), axis=0, return_inverse=True)[1]
        return find_floor(np.concatenate(points), group.ravel(), up)


def _bodies(n: int) -> str:
    """Name under which the bodies of a part are stored."""
    return f"bodies-{n:06d}"
