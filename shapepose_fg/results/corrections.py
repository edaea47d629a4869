"""Corrections of the identities of a result. Beside it are corrections.json and the uncorrected
result.
"""

import json
import shlex
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, Field, NonNegativeInt

from shapepose_fg.core.bounds import MOST_NUMBER
from shapepose_fg.core.errors import InputError, naming
from shapepose_fg.core.provenance import checksums
from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.core.result_files import OBSERVATIONS, PEOPLE, RUN
from shapepose_fg.core.storage.files import inside, read_json, write_content
from shapepose_fg.core.validation import validated
from shapepose_fg.results.edits import Edit, Edited, Solve, apply, solve_anew, undo

CORRECTIONS, UNCORRECTED = "corrections.json", "uncorrected"
"""File with the list of corrections, and folder of the uncorrected result."""
_PART = f".{UNCORRECTED}.part"
"""Name of the folder of the uncorrected result while it is created, or deleted."""
_FILES = (PEOPLE, RUN, OBSERVATIONS)
_CURE = (
    f"copy the files of {UNCORRECTED} back and delete {UNCORRECTED} and {CORRECTIONS} to start "
    "again"
)

Number = Annotated[NonNegativeInt, Field(le=MOST_NUMBER)]


class _Edit(BaseModel, strict=True, extra="forbid"):
    action: Literal["merge", "split", "rename", "drop", "swap"]
    person: Number
    other: Number | None = None
    frame: Number | None = None


class _File(BaseModel, strict=True, extra="forbid"):
    format: Literal["shapepose-fg corrections 1"]
    people: str
    edits: Annotated[list[_Edit], Field(min_length=1)]


def read_corrections(folder: str | Path) -> tuple[Edit, ...]:
    """The corrections of the result in `folder`, first to last; empty if there is no
    corrections.json.

    InputError, one sentence, if this file is damaged, if people.npz is not the corrected result, or
    if `uncorrected` exists without corrections.json: then a correction was interrupted, or
    `uncorrected` is from an earlier result.
    """
    file = Path(folder) / CORRECTIONS
    if not file.is_file():
        if (Path(folder) / UNCORRECTED).exists():
            raise InputError(
                f"{file}: this file is missing beside {UNCORRECTED}, so a correction was "
                f"interrupted; copy the files of {UNCORRECTED} back and delete that folder, or "
                "only delete it if people.npz is of a later run"
            )
        return ()
    content = validated(_File, read_json(file), file, _CURE)
    with naming(file, _CURE):
        edits = tuple(Edit(**edit.model_dump()) for edit in content.edits)
    if content.people != _checksum(Path(folder)):
        raise InputError(f"{file}: people.npz is not the result of these corrections; {_CURE}")
    return edits


def correct(folder: str | Path, edit: Edit, solve: Solve | None = None) -> Edited:
    """Apply one more correction to the result in `folder` and append it to the list; returns the
    result and the changed people.

    Changed people are solved again with `solve`; without it, joints and bodies are unchanged.
    InputError if the correction is impossible. The first correction saves the original result in
    `uncorrected`.
    """
    folder = Path(folder)
    edits, people = _kept_edits(folder), Reconstruction.load(folder)
    with naming(folder):
        edited = apply(people, edit)
    solved = edited.people if solve is None else solve_anew(edited, solve)
    if len(edits) == 0:  # the result is copied atomically
        part, _ = inside(folder, _PART), inside(folder, UNCORRECTED)
        shutil.rmtree(part, ignore_errors=True)
        part.mkdir()
        for file in (folder / name for name in _FILES):
            if file.is_file():
                shutil.copy2(file, part / file.name)
        part.rename(folder / UNCORRECTED)
    _write(folder, solved, (*edits, edit))
    return replace(edited, people=solved)


def take_back(folder: str | Path, solve: Solve | None = None) -> tuple[Edit, Reconstruction]:
    """Undo the last correction; returns the correction and the result without it. InputError if
    there is none.

    If it was the only correction, the original files are restored. Otherwise only the people that
    it changed are solved again.
    """
    folder = Path(folder)
    edits = _kept_edits(folder)
    if len(edits) == 0:
        see = shlex.join(["shapepose-fg", "tracks", str(folder)])
        raise InputError(f"{folder}: there is no correction to undo; see {see}")
    if len(edits) == 1:
        _restore(folder)
        return edits[-1], Reconstruction.load(folder)
    original, current = Reconstruction.load(folder / UNCORRECTED), Reconstruction.load(folder)
    with naming(folder, _CURE):
        before = undo(original, current, edits)
    people = before.people if solve is None else solve_anew(before, solve)
    _write(folder, people, edits[:-1])
    return edits[-1], people


def refuse_corrected(folder: Path) -> None:
    """Raise InputError if `folder` has a result that was corrected by hand, which a new result
    would overwrite.
    """
    present = [name for name in (CORRECTIONS, UNCORRECTED) if (folder / name).exists()]
    if len(present) > 0:
        cure = f"give another folder, or delete {CORRECTIONS} and {UNCORRECTED} first"
        raise InputError(
            f"{folder}: this result was corrected by hand ({' and '.join(present)}); {cure}"
        )


def _write(folder: Path, people: Reconstruction, edits: Sequence[Edit]) -> None:
    """Save the result, then its corrections: an interruption between the two is detected at the
    next reading.
    """
    counts = people.run.get("people", {})
    people.with_run(people=counts | people.counts()).save(folder)
    kept = [
        {name: value for name, value in vars(edit).items() if value is not None} for edit in edits
    ]
    content = {"format": "shapepose-fg corrections 1", "people": _checksum(folder), "edits": kept}
    write_content(folder / CORRECTIONS, json.dumps(content, indent=1) + "\n")


def _kept_edits(folder: Path) -> tuple[Edit, ...]:
    """`read_corrections`; InputError if the uncorrected result is missing."""
    edits, file = read_corrections(folder), inside(folder, UNCORRECTED) / PEOPLE
    if len(edits) > 0 and not file.is_file():
        cure = f"restore it, or delete {CORRECTIONS} to keep the result as it is now"
        raise InputError(f"{file}: the uncorrected result is missing; {cure}")
    return edits


def _restore(folder: Path) -> None:
    """Restore the original files from `uncorrected`."""
    for name in _FILES:
        file = folder / UNCORRECTED / name
        if file.is_file():
            write_content(folder / name, file.read_bytes())
        else:  # people.npz existed before; the other files may not
            (folder / name).unlink(missing_ok=True)
    (folder / CORRECTIONS).unlink()
    # Renamed before it is deleted, so that a partly deleted folder is not mistaken for the original
    # result.
    shutil.rmtree(folder / _PART, ignore_errors=True)
    (folder / UNCORRECTED).rename(folder / _PART)
    shutil.rmtree(folder / _PART)


def _checksum(folder: Path) -> str:
    """Checksum of people.npz."""
    return next(iter(checksums([folder / PEOPLE]).values()))
