"""Apache Parquet, for archives: all columns of a result under their own names, some rows in memory at a time."""

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.observation_table import Gate
from shapepose_fg.core.reconstruction import Known, OpenedReconstruction
from shapepose_fg.core.storage.files import write_atomically
from shapepose_fg.core.storage.schema import code_names
from shapepose_fg.io.export.job import Written, optional

_GROUP_ROWS = 4096
"""Rows of a group: some 20 MB, of which readers take what they need."""
_OBSERVED = "observations."
"""What the names of observations.npz's columns begin with."""
_SHARED = ("frame", "person")
"""Those that are in people.npz, too."""


def write_parquet(opened: OpenedReconstruction, rows: NDArray[np.intp] | None, folder: Path) -> Written:
    """`people.parquet`: a row per person and frame, columns as in people.npz and observations.npz.

    `rows` (R,), rising, chooses; None takes all. An array of a row is a flat list in C order, of a length that is
    the same in all rows; its shape is in the column's metadata, as JSON under `shape`. The file's metadata has
    `joint_names`, `known_names`, `view_names` and `gate_names`, and `run`, which is run.json.
    """
    arrow, parquet = optional("pyarrow", "archive"), optional("pyarrow.parquet", "archive")
    rows = np.arange(len(opened)) if rows is None else rows
    path = folder / "people.parquet"
    # Without a row there are columns too.
    first = _columns(opened, rows[:1])
    fields = [
        arrow.field(name, _type(arrow, values), metadata={"shape": json.dumps(values.shape[1:])})
        for name, values in first.items()
    ]
    schema = arrow.schema(fields, metadata=_about(opened, rows[:1]))

    def write(stream: Any) -> None:
        with parquet.ParquetWriter(stream, schema, compression="zstd") as writer:
            for start in range(0, len(rows), _GROUP_ROWS):
                columns = _columns(opened, rows[start : start + _GROUP_ROWS])
                pairs = zip(columns.values(), schema, strict=True)
                arrays = [_array(arrow, values, field.type) for values, field in pairs]
                writer.write_table(arrow.Table.from_arrays(arrays, schema=schema))

    write_atomically(path, write)
    return Written([path])


def _columns(opened: OpenedReconstruction, rows: NDArray[np.intp]) -> dict[str, NDArray[Any]]:
    """All columns in some rows, by their names."""
    people = opened.rows(rows)
    columns = {name: getattr(people, name) for name in people.ROWS}
    table = people.observations
    if table is not None:
        columns |= {_OBSERVED + name: getattr(table, name) for name in table.ROWS if name not in _SHARED}
    return columns


def _about(opened: OpenedReconstruction, rows: NDArray[np.intp]) -> dict[str, str]:
    """What is said of the whole file."""
    people = opened.rows(rows)
    about: dict[str, Any] = {"joint_names": people.joint_names.tolist(), "known_names": code_names(Known).tolist()}
    if people.observations is not None:
        about |= {"view_names": people.observations.view_names.tolist(), "gate_names": code_names(Gate).tolist()}
    return {name: json.dumps(value) for name, value in (about | {"run": opened.run}).items()}


def _type(arrow: Any, values: NDArray[Any]) -> Any:
    """The type of a column."""
    own = arrow.string() if values.dtype.kind == "U" else arrow.from_numpy_dtype(values.dtype)
    return own if values.ndim == 1 else arrow.list_(own, int(np.prod(values.shape[1:])))


def _array(arrow: Any, values: NDArray[Any], kind: Any) -> Any:
    """A column of some rows."""
    if values.ndim == 1:
        return arrow.array(values, type=kind)
    return arrow.FixedSizeListArray.from_arrays(arrow.array(values.ravel()), type=kind)
