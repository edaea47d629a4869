"""A saved table, open: some of its rows are read without the others in memory."""

from dataclasses import replace
from pathlib import Path
from typing import Any, Generic, TypeVar, cast

import numpy as np
from numpy.typing import NDArray
from rich.filesize import decimal

from shapepose_fg.core.errors import InputError
from shapepose_fg.core.storage.npz import NpzFile
from shapepose_fg.core.storage.schema import Table, columns_of

RUN_ID = "run_id"
"""What ties the files of a result: a digest of all columns of people.npz."""
T = TypeVar("T", bound=Table)


class SavedTable(Generic[T]):
    """people.npz or observations.npz: a table of the class `kind`."""

    def __init__(self, file: Path, kind: type[T], cure: str) -> None:
        """InputError, with the `cure`, where it cannot be read or an array is missing that earlier files have
        too.
        """
        self.file, self.kind, self.cure = file, kind, cure
        self._columns, told = columns_of(kind), kind.meanings()
        self._npz = NpzFile(file, (*kind.ROWS, *kind.shared(), *told, RUN_ID), f"{cure}, or run one first")
        try:
            there = self._npz.names
            for name in there:
                self._npz.shape(name)  # one that is damaged goes before one that is missing
            added = {name for name, column in self._columns.items() if column.missing is not None}
            added |= {f"{name}_names" for name in added if name not in there}
            for name in (*kind.ROWS, *kind.shared(), *told):
                if name not in there and name not in added:
                    raise InputError(f"{file}: column {name} is missing; {cure}")
            for name in told.keys() & set(there):
                words = self._npz.array(name)
                # Older files know fewer codes: what is added to them comes last.
                if not (len(words) > 0 and np.array_equal(words, told[name][: len(words)])):
                    raise InputError(f"{file}: {name} are not those of this version; {cure}")
            self.run_id = self._npz.array(RUN_ID) if RUN_ID in there else None
            self._rows = [name for name in kind.ROWS if name in there]
            self.count = (self._npz.shape(self._rows[0]) or (0,))[0]
            """How many rows there are."""
            for name in self._rows:
                if self._npz.shape(name)[:1] != (self.count,):
                    raise InputError(
                        f"{file}: {name} must have an entry for each row, as many as {self._rows[0]}, got the"
                        f" shape {self._npz.shape(name)}; {cure}"
                    )
            self._shared = {name: self._npz.array(name) for name in kind.shared()}
        except InputError:
            self._npz.close()
            raise

    def numbers(self, name: str) -> NDArray[np.integer]:
        """All of a column of whole numbers, checked: rows are chosen by it before the others are read."""
        try:
            column = self._columns[name].checked(name, self._npz.array(name), {"N": self.count})
            self._columns[name].check_range(name, column)
        except InputError:
            raise
        except ValueError as error:
            raise InputError(f"{self.file}: {error}; {self.cure}") from None
        return column

    def read(self, index: NDArray[np.intp] | None, **others: Any) -> T:
        """The rows `index` (R,), rising, or all, and `others` beside them; InputError where they do not make a
        table, or would not fit in memory.
        """
        self._check_memory(self.count if index is None else len(index))
        read = self._npz.array if index is None else lambda name: self._npz.rows(name, index)
        try:
            table = self.kind(**{name: read(name) for name in self._rows}, **self._shared)
            table.check_ranges()
            return replace(cast(Any, table), **others) if others else table
        except InputError:
            raise
        except ValueError as error:
            raise InputError(f"{self.file}: {error}; {self.cure}") from None

    def _check_memory(self, count: int) -> None:
        """InputError where so many rows, and as much again to work with them, are more than there is room for."""
        needed, free = 2 * count * sum(map(self._npz.row_bytes, self._rows)), free_memory()
        if free is not None and needed > free:
            raise InputError(
                f"{self.file}: {count} rows would take {decimal(needed)} of memory, and {decimal(free)} are free;"
                " take some frames or people at a time (--frames, --person, or Reconstruction.open)"
            )

    def close(self) -> None:
        """Nothing can be read any more."""
        self._npz.close()


def free_memory() -> int | None:
    """Bytes of memory that programs could have now; None where the system does not say."""
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
    except OSError:
        return None
    found = [line.split()[1] for line in lines if line.startswith("MemAvailable:")]
    return 1024 * int(found[0]) if found else None
