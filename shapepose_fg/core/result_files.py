"""The files of a result, people.npz, observations.npz and run.json: written together, tied by one id."""

import hashlib
import json
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.errors import InputError
from shapepose_fg.core.run_summary import plain
from shapepose_fg.core.storage.files import write_together
from shapepose_fg.core.storage.npz import Pieces, write_npz
from shapepose_fg.core.storage.saved_table import RUN_ID

PEOPLE, RUN, OBSERVATIONS = "people.npz", "run.json", "observations.npz"
_DIGITS = 32
"""Of the id. The same people have the same one, so that a run that was stopped and went on leaves the same bytes
as one that was not."""


def results_folder(results: Path) -> Path:
    """The folder of a result, which may be given as its people.npz too."""
    return results.parent if results.name == PEOPLE else results


def write_result(
    folder: Path, people: Mapping[str, Pieces], observations: Mapping[str, Pieces] | None, run: Mapping[str, Any]
) -> None:
    """Write the files of a result into `folder`, none before all are complete on the disk.

    A process killed on the way leaves each file as it was or as it shall be; `check_id` tells where they are of
    two runs. Without `observations`, those of an earlier result are removed. ValueError where `run` holds what
    JSON cannot, OSError that names the file where one cannot be written.
    """
    digest = hashlib.sha256()

    def id_text() -> str:
        return digest.hexdigest()[:_DIGITS]

    def run_text() -> str:
        return json.dumps({RUN_ID: id_text(), **run}, indent=2, allow_nan=False, default=plain) + "\n"

    def write_people(stream: BinaryIO) -> None:
        # The id is asked for when all columns before it have been written.
        last = {RUN_ID: Pieces(np.dtype(f"U{_DIGITS}"), (), lambda: (np.array(id_text()),))}
        write_npz(stream, {name: _told(name, each, digest.update) for name, each in people.items()} | last)

    def write_observations(stream: BinaryIO) -> None:
        write_npz(stream, {**(observations or {}), RUN_ID: np.array(id_text())})

    run_text()  # what cannot be written is known before the work
    # The order counts: the id is known when people.npz has been written.
    files = {folder / PEOPLE: write_people}
    files |= {} if observations is None else {folder / OBSERVATIONS: write_observations}
    write_together({**files, folder / RUN: lambda stream: stream.write(run_text().encode())})
    if observations is None:
        (folder / OBSERVATIONS).unlink(missing_ok=True)


def check_id(people_id: object, other_id: object, file: Path) -> None:
    """InputError where `file` is of another run than the people.npz beside it.

    An id is text, an array that holds it, or None in files of earlier versions, which are taken as they are.
    """
    if people_id is None or other_id is None or str(people_id) == str(other_id):
        return
    raise InputError(
        f"{file}: this is of another run than the {PEOPLE} beside it, as after a run that was killed while it"
        " wrote its results; start that run again with --resume, or put together the files of one run"
    )


def _told(name: str, column: Pieces, tell: Any) -> Pieces:
    """The same column; `tell` is given its name, type, shape and bytes when its pieces are asked for."""

    def pieces() -> Iterator[NDArray[Any]]:
        tell(f"{name} {column.dtype} {column.shape}\n".encode())
        for piece in column.pieces():
            same = np.ascontiguousarray(piece, dtype=column.dtype).reshape(piece.shape)
            if same.size > 0:
                tell(same.reshape(-1).view(np.uint8))
            yield same

    return replace(column, pieces=pieces)
