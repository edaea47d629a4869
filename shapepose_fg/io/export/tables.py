"""Exports results as tables: CSV, a line per person, frame and joint, for notebooks; Parquet, all
columns, for archives.

Axes are those of the recording; metres.
"""

import csv
import io
import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.arrays import Array, Index
from shapepose_fg.core.errors import optional
from shapepose_fg.core.reconstruction import Known, OpenedReconstruction, sigma_m
from shapepose_fg.core.storage.files import write_atomically
from shapepose_fg.core.storage.schema import code_names
from shapepose_fg.io.export.registry import Job, Written
from shapepose_fg.io.export.take import Take

COLUMNS = (
    "frame time_s person joint x_m y_m z_m sigma_m sigma_x_m sigma_y_m sigma_z_m vx_m_s vy_m_s "
    "vz_m_s known confidence"
).split()
"""Header of the CSV file."""
_GROUP_ROWS = 4096
"""Number of rows in a group of Parquet: about 20 MB, which readers load separately."""
_OBSERVED = "observations."
"""Prefix of the Parquet columns from observations.npz."""


def write_csv(job: Job) -> Written:
    """Write `joints.csv`."""
    written = Written()
    written.add(job.folder / "joints.csv", csv_text(job.take))
    return written


def csv_text(take: Take) -> str:
    """A line for each joint with a position; unknown values are empty."""

    def words(values: Array, digits: str = "%.6f") -> list[str]:
        return np.where(np.isfinite(values), np.char.mod(digits, values), "").tolist()

    people = take.people
    row, joint = np.nonzero(np.isfinite(people.joints).all(axis=2))
    order = np.lexsort((joint, people.person[row], people.frame[row]))
    row, joint = row[order], joint[order]
    covariance = people.covariance[row, joint]
    variance = np.diagonal(covariance, axis1=1, axis2=2)
    with np.errstate(invalid="ignore"):
        axes = np.sqrt(np.where(variance >= 0, variance, np.nan))
    columns = [
        people.frame[row].tolist(),
        words(take.times_s[np.searchsorted(take.frames, people.frame[row])]),
        people.person[row].tolist(),
        people.joint_names[joint].tolist(),
        *map(words, people.joints[row, joint].T),
        words(sigma_m(covariance)),
        *map(words, axes.T),
        *map(words, people.velocity[row, joint].T),
        code_names(Known)[people.known[row, joint]].tolist(),
        words(people.confidence[row, joint], "%.4f"),
    ]
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(COLUMNS)
    writer.writerows(zip(*columns, strict=True))
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
            for start in range(0, len(rows), _GROUP_ROWS):
                columns, _ = _columns(opened, rows[start : start + _GROUP_ROWS])
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
