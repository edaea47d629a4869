"""The folder of a run that is not finished: what the run was begun from, and what it has done so far."""

import json
import shutil
from pathlib import Path
from typing import Any

from shapepose_fg.core.errors import InputError
from shapepose_fg.core.run_summary import difference
from shapepose_fg.core.storage.files import read_json, sweep, write_atomically
from shapepose_fg.core.storage.kept_arrays import InFolder
from shapepose_fg.pipeline.runs.parts import Parts

PARTS = "parts"
"""The folder of an unfinished run, beside its results."""
_GONE = ".parts-gone"
"""What that folder is called while it is removed."""
_MANIFEST = "manifest.json"
_FORMAT = "shapepose-fg unfinished run 1"


def open_run(output: Path, begun: dict[str, Any], *, resume: bool = False, restart: bool = False) -> InFolder:
    """The folder of a run into `output` that is begun from `begun`, plain values; or goes on, with `resume`.

    With `restart` what a stopped run left is removed. InputError where a stopped run left something and neither is
    given, and where it was begun from something else: the first difference is named. The caller is the only run in
    `output`.
    """
    folder = output / PARTS
    manifest = folder / _MANIFEST
    shutil.rmtree(output / _GONE, ignore_errors=True)  # what a kill left of a run that was being removed
    begun = json.loads(json.dumps({"format": _FORMAT, **begun}))
    if folder.exists() and not manifest.is_file() and not _only_ours(folder):
        raise InputError(f"{folder}: not of a run of this program; move it away, or give another --output")
    kept = InFolder(folder)
    if manifest.is_file() and not restart:
        sweep(folder)
        done = Parts(kept).notes().frames
        if resume:
            _refuse_other(folder, read_json(manifest), begun)
            return kept
        if done > 0:
            raise InputError(
                f"{folder}: a run was stopped here after {done} frames; go on with --resume, or begin anew with"
                " --restart"
            )
    _remove(output)
    write_atomically(manifest, lambda stream: stream.write(json.dumps(begun, indent=1).encode()))
    return kept


def frames_done(output: Path) -> int:
    """How many frames of the unfinished run in `output` are kept."""
    return Parts(InFolder(output / PARTS)).notes().frames


def end_run(output: Path) -> None:
    """Remove what a run kept: its results are written."""
    _remove(output)


def _remove(output: Path) -> None:
    """Remove what a run kept, under another name: after a kill on the way it is no half of a run."""
    gone = output / _GONE
    shutil.rmtree(gone, ignore_errors=True)
    if (output / PARTS).exists():
        (output / PARTS).rename(gone)
        shutil.rmtree(gone)


def _only_ours(folder: Path) -> bool:
    """Whether a folder holds nothing but what a run leaves that was killed at its very beginning."""
    return folder.is_dir() and all(file.name.startswith(f".{_MANIFEST}.") for file in folder.iterdir())


def _refuse_other(folder: Path, before: Any, now: dict[str, Any]) -> None:
    """InputError where a run was begun from something else."""
    name = difference(before, now) if isinstance(before, dict) else "all of it"
    if name is None:
        return
    was, is_now = (_at(values, name) for values in (before, now))
    short = all(len(repr(value)) <= 40 for value in (was, is_now))
    how = f" ({was} then, {is_now} now)" if short else ""
    raise InputError(
        f"{folder}: the run that was stopped here had another {_WORDS.get(name, name)}{how}; start it as it was to"
        " go on, or begin anew with --restart"
    )


_WORDS = {"program": "version of this program", "cameras": "set of cameras", "skeleton": "skeleton"}
"""What differs, where a key would not say it."""


def _at(values: Any, name: str) -> Any:
    """The value of a dotted name; a key may have dots in it."""
    if not isinstance(values, dict) or name == "":
        return values
    for key, value in values.items():
        if name == key:
            return value
        if name.startswith(f"{key}."):
            return _at(value, name[len(key) + 1 :])
    return None
