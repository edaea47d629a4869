"""Exports results as tables: CSV, a line per person, frame and joint, for notebooks; Parquet, all
columns, for archives.

Axes are those of the recording; metres.
"""

import csv
import io
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.biomechanics.joint_angles import joint_angles
from shapepose_fg.core.arrays import Index
from shapepose_fg.core.errors import optional
from shapepose_fg.core.reconstruction import OpenedReconstruction
from shapepose_fg.core.storage.files import ROWS_AT_ONCE, write_atomically
from shapepose_fg.io.export.registry import Job, Written
from shapepose_fg.io.export.take import Take

_OBSERVED = "observations."
"""Prefix of the Parquet columns from observations.npz."""


def write_csv(job: Job) -> Written:
    """Write `joints.csv`."""
    written = Written()
    written.add(job.folder / "joints.csv", csv_text(job.take))
    return written


def csv_text(take: Take) -> str:
    """A line for each joint with a position; unknown values are empty."""
    people = take.people
    times = take.times_s[np.searchsorted(take.frames, people.frame)]
    return columns_text(replace(people, time_s=times).by_joint())


def write_angles(job: Job) -> Written:
    """Write `angles.csv`: a line for each person and frame with a body."""
    take, written = job.take, Written()
    angles = joint_angles(take.people, take.up, job.model)
    times = take.times_s[np.searchsorted(take.frames, take.people.frame)]
    columns = angles.columns() | {"time_s": times}
    order = np.lexsort((take.people.person, take.people.frame))
    order = order[np.isfinite(angles.degrees[order, 0])]
    chosen = {name: values[order] for name, values in columns.items()}
    written.add(job.folder / "angles.csv", columns_text(chosen, "%.3f"))
    return written


def columns_text(columns: dict[str, NDArray[Any]], digits: str = "%.6f") -> str:
    """CSV of columns of equal length; unknown numbers are empty."""

    def words(name: str, values: NDArray[Any]) -> list[Any]:
        if values.dtype.kind != "f":
            return values.tolist()
        form = {"confidence": "%.4f", "time_s": "%.6f"}.get(name, digits)
        return np.where(np.isfinite(values), np.char.mod(form, values), "").tolist()

    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(zip(*(words(*each) for each in columns.items()), strict=True))
    return stream.getvalue()


def write_parquet(opened: OpenedReconstruction, rows: Index | None, folder: Path) -> Written:
    """Write `people.parquet`: a row per person and frame, with the columns of people.npz and
    observations.npz.

    `rows`: sorted indices to write, or None for all. Written in blocks. An array in a row is a flat
    list in C order, of constant length; its shape is in the metadata of the column, as JSON under
    `shape`. The metadata of the file have `joint_names`, `known_names`, `view_names` and
    `gate_names`, and `run` (the content of run.json).
    """
    arrow, parquet = optional("pyarrow", "archive"), optional("pyarrow.parquet", "archive")
    rows = np.arange(len(opened)) if rows is None else rows

    def kind(values: NDArray[Any]) -> Any:
        own = arrow.string() if values.dtype.kind == "U" else arrow.from_numpy_dtype(values.dtype)
        return own if values.ndim == 1 else arrow.list_(own, int(np.prod(values.shape[1:])))

    # A file without rows still has all columns.
    first, about = _columns(opened, rows[:1])
    fields = [
        arrow.field(name, kind(values), metadata={"shape": json.dumps(values.shape[1:])})
        for name, values in first.items()
    ]
    schema = arrow.schema(
        fields, metadata={name: json.dumps(value) for name, value in about.items()}
    )

    def array(values: NDArray[Any], kind: Any) -> Any:
        if values.ndim == 1:
            return arrow.array(values, type=kind)
        return arrow.FixedSizeListArray.from_arrays(arrow.array(values.ravel()), type=kind)

    def write(stream: Any) -> None:
        with parquet.ParquetWriter(stream, schema, compression="zstd") as writer:
            for start in range(0, len(rows), ROWS_AT_ONCE):
                columns, _ = _columns(opened, rows[start : start + ROWS_AT_ONCE])
                typed = zip(columns.values(), schema, strict=True)
                arrays = [array(values, field.type) for values, field in typed]
                writer.write_table(arrow.Table.from_arrays(arrays, schema=schema))

    write_atomically(folder / "people.parquet", write)
    return Written([folder / "people.parquet"])


def _columns(
    opened: OpenedReconstruction, rows: Index
) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """All columns of some rows, by name, and the metadata of the whole file."""
    people = opened.rows(rows)
    table = people.observations
    columns = {name: getattr(people, name) for name in people.ROWS}
    about: dict[str, Any] = {"joint_names": people.joint_names.tolist()}
    about |= {name: words.tolist() for name, words in people.meanings().items()}
    if table is not None:
        columns |= {_OBSERVED + name: getattr(table, name) for name in table.ROWS[2:]}
        about |= {"view_names": table.view_names.tolist()}
        about |= {name: words.tolist() for name, words in table.meanings().items()}
    return columns, about | {"run": opened.run}
