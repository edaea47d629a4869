"""The files of a result (people.npz, observations.npz and run.json): written together with a common
id, and opened.

A run also leaves cameras.json (`rig_file.py`), report.html (`viz/report/`), and, depending on the
input, moments.csv and synchronised.csv (below). While it is unfinished, its windows are in a
folder of parts (`pipeline/runs/`). docs/results.md describes all files.
"""

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import replace
from itertools import chain, count
from pathlib import Path
from typing import Any, BinaryIO, Generic, TypeVar, cast

import numpy as np
from numpy.typing import NDArray
from rich.filesize import decimal

from shapepose_fg.core.arrays import Index
from shapepose_fg.core.errors import InputError, naming
from shapepose_fg.core.run_summary import plain
from shapepose_fg.core.storage.files import write_together
from shapepose_fg.core.storage.npz import NpzFile, Pieces, write_npz
from shapepose_fg.core.storage.schema import Table, columns_of

PEOPLE, RUN, OBSERVATIONS = "people.npz", "run.json", "observations.npz"
MOMENTS = "moments.csv"
"""File with the number of each camera's picture in each frame, if cameras differ."""
CLOCKS = "synchronised.csv"
"""File with the times of each camera's frames, if they were estimated from the people."""
RUN_ID = "run_id"
"""Key of the common id of a result's files: a digest of all columns of people.npz."""
T = TypeVar("T", bound=Table)
_DIGITS = 32
"""Number of digits of the run's id. The id depends only on the people, so that a resumed run writes
the same bytes as an uninterrupted one."""


def results_folder(results: Path) -> Path:
    """The folder of a result, given as this folder or as the people.npz in it."""
    return results.parent if results.name == PEOPLE else results


def set_aside(folder: Path) -> list[str]:
    """Rename exports and overlays of an earlier result in `folder`, so that they are not mistaken
    for those of the new one.

    Returns a sentence about each.
    """
    notes = []
    for made in (folder / name for name in ("export", "overlay")):
        if made.is_dir():
            names = (
                made.with_name(f"{made.name}-older{number}") for number in chain([""], count(2))
            )
            made.rename(free := next(path for path in names if not path.exists()))
            notes.append(f"{made} belongs to the previous result; it was renamed to {free.name}")
    return notes


def write_result(
    folder: Path,
    people: Mapping[str, Pieces],
    observations: Mapping[str, Pieces] | None,
    run: Mapping[str, Any],
    check: Callable[[Path, Path | None], object] | None = None,
) -> None:
    """Write the files of a result into `folder`; none is put in place before all are complete on
    disk.

    If the process is killed, each file is either the old or the new one; `check_id` detects files
    of different runs. Without `observations`, those of an earlier result are removed. Before files
    are replaced, `check` is called with the new people.npz and observations.npz; if it raises,
    nothing is replaced. ValueError if `run` cannot be written as JSON; OSError that names the file
    if one cannot be written.
    """
    digest = hashlib.sha256()

    def id_text() -> str:
        return digest.hexdigest()[:_DIGITS]

    def run_text() -> str:
        return (
            json.dumps({RUN_ID: id_text(), **run}, indent=2, allow_nan=False, default=plain) + "\n"
        )

    def write_people(stream: BinaryIO) -> None:
        # The id is read after all columns before it have been written.
        last = {RUN_ID: Pieces(np.dtype(f"U{_DIGITS}"), (), lambda: (np.array(id_text()),))}
        write_npz(
            stream,
            {name: _with_digest(name, each, digest.update) for name, each in people.items()} | last,
        )

    def write_observations(stream: BinaryIO) -> None:
        write_npz(stream, {**(observations or {}), RUN_ID: np.array(id_text())})

    run_text()  # fails before the work if it cannot be written
    # The order matters: the id is known only after people.npz has been written.
    files = {folder / PEOPLE: write_people}
    files |= {} if observations is None else {folder / OBSERVATIONS: write_observations}

    def checked(new: Mapping[Path, Path]) -> None:
        try:
            if check is not None:
                check(new[folder / PEOPLE], new.get(folder / OBSERVATIONS))
        except InputError as error:
            message = str(error)
            for path, temporary in new.items():
                message = message.replace(str(temporary), str(path))
            raise InputError(message) from None

    write_together(
        {**files, folder / RUN: lambda stream: stream.write(run_text().encode())}, checked
    )
    if observations is None:
        (folder / OBSERVATIONS).unlink(missing_ok=True)


def check_id(people_id: object, other_id: object, file: Path) -> None:
    """Raise InputError if `file` is from another run than the people.npz beside it.

    An id is text, an array with this text, or None in files of earlier versions, which are accepted
    unchecked.
    """
    if people_id is None or other_id is None or str(people_id) == str(other_id):
        return
    raise InputError(
        f"{file}: this file is of another run than the {PEOPLE} beside it, perhaps because a run "
        "was killed while it wrote its results; start that run again with --resume, or put the "
        "files of one run together"
    )


def _with_digest(name: str, column: Pieces, update: Any) -> Pieces:
    """Return the column; when its pieces are read, its name, type, shape and bytes are passed to
    `update`.
    """

    def pieces() -> Iterator[NDArray[Any]]:
        update(f"{name} {column.dtype} {column.shape}\n".encode())
        for piece in column.pieces():
            same = np.ascontiguousarray(piece, dtype=column.dtype).reshape(piece.shape)
            if same.size > 0:
                update(same.reshape(-1).view(np.uint8))
            yield same

    return replace(column, pieces=pieces)


class SavedTable(ExitStack, Generic[T]):
    """An opened people.npz or observations.npz: a table of the class `kind`."""

    def __init__(self, file: Path, kind: type[T], cure: str) -> None:
        """Open the table; InputError, with the `cure`, if the file cannot be read, or if a required
        array is missing.
        """
        super().__init__()
        self.file, self.kind, self.cure = file, kind, cure
        self._columns, meanings = columns_of(kind), kind.meanings()
        names = (*kind.ROWS, *kind.shared(), *meanings, RUN_ID)
        self._npz = self.enter_context(NpzFile(file, names, f"{cure}, or run one first"))
        try:
            stored = self._npz.names
            for name in stored:
                self._npz.shape(name)  # report a damaged array before a missing one
            added = {name for name, column in self._columns.items() if column.missing is not None}
            added |= {f"{name}_names" for name in added if name not in stored}
            for name in (*kind.ROWS, *kind.shared(), *meanings):
                if name not in stored and name not in added:
                    raise InputError(f"{file}: column {name} is missing; {cure}")
            for name in meanings.keys() & set(stored):
                words = self._npz.array(name)
                # Files of earlier versions have fewer codes; new codes are appended.
                if not (len(words) > 0 and np.array_equal(words, meanings[name][: len(words)])):
                    raise InputError(f"{file}: {name} are not those of this version; {cure}")
            self.run_id = self._npz.array(RUN_ID) if RUN_ID in stored else None
            self._rows = [name for name in kind.ROWS if name in stored]
            self.count = (self._npz.shape(self._rows[0]) or (0,))[0]
            """Number of rows."""
            for name in self._rows:
                if self._npz.shape(name)[:1] != (self.count,):
                    raise InputError(
                        f"{file}: {name} must have an entry for each row, as many as "
                        f"{self._rows[0]}, got the shape {self._npz.shape(name)}; {cure}"
                    )
            self._shared = {name: self._npz.array(name) for name in kind.shared()}
        except InputError:
            self.close()
            raise

    def column(self, name: str) -> NDArray[Any]:
        """A whole column, checked. Rows are selected by it before other columns are read."""
        if (
            name not in self._rows
        ):  # a column shared by all rows, or one missing in files of earlier versions
            return self._shared[name] if name in self._shared else getattr(self.read(None), name)
        with naming(self.file, self.cure):
            column = self._columns[name].checked(name, self._npz.array(name), {"N": self.count})
            self._columns[name].check_range(name, column)
            return column

    def read(self, index: Index | None, **others: Any) -> T:
        """The rows `index` (R,), increasing, or all, with the fields `others`; InputError if they
        are invalid, or too many for the memory.
        """
        count = self.count if index is None else len(index)
        needed = 2 * count * sum(map(self._npz.row_bytes, self._rows))  # twice, for working copies
        check_memory(
            f"{self.file}: {count} rows", needed, "--frames, --person, or Reconstruction.open"
        )
        read = self._npz.array if index is None else lambda name: self._npz.rows(name, index)
        with naming(self.file, self.cure):
            table = self.kind(**{name: read(name) for name in self._rows}, **self._shared)
            table.check_ranges()
            return replace(cast(Any, table), **others) if others else table


def check_memory(what: str, needed: int, options: str) -> None:
    """Raise InputError if more bytes of memory are `needed` than are free; `options` are the
    options that select a part.
    """
    import psutil

    free = psutil.virtual_memory().available
    if needed > free:
        space = f"need {decimal(needed)} of memory, and {decimal(free)} are free"
        raise InputError(f"{what} {space}; read fewer frames or people at a time ({options})")
