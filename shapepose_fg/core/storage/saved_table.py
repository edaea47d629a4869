"""A saved table with a row per person and frame, open: some of its rows are read without the others in memory."""

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.filesize import decimal

from shapepose_fg.core.errors import InputError
from shapepose_fg.core.result_files import RUN_ID
from shapepose_fg.core.storage.npz_reader import NpzFile


class SavedTable:
    """people.npz or observations.npz."""

    def __init__(
        self,
        file: Path,
        *,
        rows: Collection[str],
        shared: Collection[str],
        code_names: Mapping[str, NDArray[np.str_]],
        added: Collection[str] = (),
        cure: str,
    ) -> None:
        """InputError, with the `cure`, where it cannot be read or an array is missing.

        `rows` are the columns with an entry per row, and `shared` arrays beside them; those of `added` may be
        missing. `code_names` are arrays that say what the codes of a column mean, which must be these, or the
        first of them, where the column, the name without `_names`, is there.
        """
        self.file, self._cure = file, cure
        self._npz = NpzFile(file, (*rows, *shared, *code_names, RUN_ID), f"{cure}, or run one first")
        try:
            there = self._npz.names
            for name in there:
                self._npz.shape(name)  # one that is damaged goes before one that is missing
            unneeded = {f"{name}_names" for name in added if name not in there}
            named = [name for name in code_names if name not in unneeded]
            for name in (*rows, *shared, *named):
                if name not in there and name not in added:
                    raise InputError(f"{file}: column {name} is missing; {cure}")
            for name in named:
                told = self._npz.array(name)
                # Older files know fewer codes: what is added to them comes last.
                if not (len(told) > 0 and np.array_equal(told, code_names[name][: len(told)])):
                    raise InputError(f"{file}: {name} are not those of this version; {cure}")
            self.run_id = self._npz.array(RUN_ID) if RUN_ID in there else None
            self._rows = [name for name in rows if name in there]
            self.count = self._counted()
            """How many rows there are."""
            self.shared = {name: self._npz.array(name) for name in shared if name in there}
        except InputError:
            self._npz.close()
            raise

    def column(self, name: str) -> NDArray[Any]:
        """All of a column."""
        return self._npz.array(name)

    def columns(self, index: NDArray[np.intp] | None) -> dict[str, NDArray[Any]]:
        """Columns in the rows `index` (R,), rising, or in all; and what is beside them.

        InputError where they would not fit in memory.
        """
        self._check_memory(self.count if index is None else len(index))
        if index is None:
            return {name: self._npz.array(name) for name in self._rows} | self.shared
        return {name: self._npz.rows(name, index) for name in self._rows} | self.shared

    def _counted(self) -> int:
        """Rows of all columns; InputError where one has others."""
        first = self._rows[0]
        count = (self._npz.shape(first) or (0,))[0]
        for name in self._rows:
            if self._npz.shape(name)[:1] != (count,):
                raise InputError(
                    f"{self.file}: {name} must have an entry for each row, as many as {first}, got the shape"
                    f" {self._npz.shape(name)}; {self._cure}"
                )
        return count

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
