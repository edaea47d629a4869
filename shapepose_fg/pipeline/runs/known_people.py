"""The file of people's shapes that a run begins with and brings up to date: read once, written once."""

import hashlib
from collections.abc import Callable
from io import BytesIO
from pathlib import Path

import numpy as np

from shapepose_fg.core.errors import InputError
from shapepose_fg.core.shapes import SubjectShapes
from shapepose_fg.core.storage.files import write_atomically
from shapepose_fg.core.storage.kept_arrays import KeptArrays

_KNOWN, _WRITTEN = "known-people", "known-people-written"
_ARRAYS = ("betas", "information")


def people_at_start(kept: KeptArrays, file: Path, load: Callable[[], SubjectShapes]) -> SubjectShapes:
    """Who was known when the run began; `load` reads them from `file` when it begins.

    InputError where the file has changed since, but for what this run itself wrote into it.
    """
    now = hashlib.sha256(file.read_bytes()).hexdigest() if file.exists() else None
    if _KNOWN not in kept.names(_KNOWN):
        known = load()
        about = {"names": known.names.tolist(), "body": known.body, "sha256": now}
        kept.keep(_KNOWN, {name: getattr(known, name) for name in _ARRAYS}, about)
        return known
    about = kept.about(_KNOWN)
    own = [kept.about(name) for name in kept.names(_WRITTEN)]
    if now not in (about["sha256"], *own):
        raise InputError(
            f"{file}: this has changed since the run was stopped; begin anew with --restart to use what it holds"
        )
    betas, information = (kept.array(_KNOWN, name) for name in _ARRAYS)
    return SubjectShapes(np.array(about["names"], dtype=str), betas, information, about["body"])


def checksum_at_start(kept: KeptArrays) -> str:
    """Of the file that `people_at_start` read, sha256."""
    return kept.about(_KNOWN)["sha256"]


def write_people(kept: KeptArrays, file: Path, people: SubjectShapes) -> None:
    """Bring `file` up to date; a run that is stopped right behind it knows its own doing."""
    content = BytesIO()
    people.write(content)
    kept.keep(_WRITTEN, {}, hashlib.sha256(content.getvalue()).hexdigest())
    write_atomically(file, lambda stream: stream.write(content.getvalue()))
