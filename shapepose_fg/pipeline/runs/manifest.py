"""Folder of an unfinished run: its inputs, its progress, and disk space."""

import hashlib
import json
import shutil
from collections.abc import Callable
from io import BytesIO
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
from rich.filesize import decimal

from shapepose_fg.core.camera import Rig
from shapepose_fg.core.detections import DetectionSequence
from shapepose_fg.core.errors import InputError, naming
from shapepose_fg.core.observation_table import ObservationTable
from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.core.run_summary import difference
from shapepose_fg.core.shapes import SubjectShapes
from shapepose_fg.core.storage.files import inside, read_bytes, read_json, sweep, write_content
from shapepose_fg.core.storage.kept_arrays import ANEW, InFolder, KeptArrays
from shapepose_fg.pipeline.runs.parts import Parts

PARTS = "parts"
"""Folder of an unfinished run, next to its results."""
_GONE = ".parts-gone"
"""Name of this folder while it is removed, so that an interrupted removal is not mistaken for an
unfinished run."""
_MANIFEST = "manifest.json"
_FORMAT = "shapepose-fg unfinished run 1"
_WORDS = {"program": "version of this program", "cameras": "set of cameras", "skeleton": "skeleton"}
"""Descriptions of the manifest's keys in messages about differences; other keys describe
themselves."""


def open_run(
    output: Path, inputs: dict[str, Any], *, resume: bool = False, restart: bool = False
) -> InFolder:
    """Open the folder of a run that writes its results into `output`.

    `inputs` are the inputs of the run, plain values. With `resume` it is the folder of the
    interrupted run; with `restart`, the files of an interrupted run are removed. Raises InputError
    if there are such files and neither is given, and if the interrupted run had other inputs: the
    first difference is named. The caller must be the only run in `output`.
    """
    folder = inside(output, PARTS)
    manifest = inside(folder, _MANIFEST)
    shutil.rmtree(inside(output, _GONE), ignore_errors=True)  # left by an interrupted removal
    inputs = json.loads(json.dumps({"format": _FORMAT, **inputs}))
    # A run killed at its start leaves only the manifest's temporary file.
    left = [folder] if folder.is_file() else folder.iterdir() if folder.is_dir() else ()
    if not manifest.is_file() and any(not file.name.startswith(f".{_MANIFEST}.") for file in left):
        raise InputError(
            f"{folder}: this is not a run of this program; move it, or give another --output"
        )
    kept = InFolder(folder, _digest(inputs))
    if manifest.is_file() and not restart:
        sweep(folder)
        if resume:
            _refuse_other(folder, read_json(manifest), inputs)
            return kept
        if (done := frames_done(output)) > 0:
            raise InputError(
                f"{folder}: there is an interrupted run after {done} frames; continue with "
                "--resume, or start again with --restart"
            )
    end_run(output)
    write_content(manifest, json.dumps(inputs, indent=1))
    return kept


def frames_done(output: Path) -> int:
    """Number of solved frames of the unfinished run in `output`."""
    folder = inside(output, PARTS)
    return Parts(InFolder(folder, _digest(read_json(inside(folder, _MANIFEST))))).notes().frames


def _digest(inputs: Any) -> str:
    """Digest of a run's inputs."""
    return hashlib.sha256(json.dumps(inputs, sort_keys=True).encode()).hexdigest()


def end_run(output: Path) -> None:
    """Remove the files of a finished run."""
    removed = inside(output, _GONE)
    shutil.rmtree(removed, ignore_errors=True)
    if (output / PARTS).exists():
        (output / PARTS).rename(removed)
        shutil.rmtree(removed)


def _refuse_other(folder: Path, before: Any, now: dict[str, Any]) -> None:
    """Raise InputError if a run had other inputs."""
    found = difference(before, now)
    if found is None:
        return
    name, was, is_now = found
    how = f" ({was} then, {is_now} now)" if max(len(repr(was)), len(repr(is_now))) <= 40 else ""
    raise InputError(
        f"{folder}: the interrupted run had another {_WORDS.get(name, name)}{how}; start it with "
        "the same options to continue, or start again with --restart"
    )


def expected_bytes(detections: DetectionSequence, rig: Rig, frames: range) -> int:
    """Upper bound of the disk space for a run, bytes: its rows twice, as parts and as results.

    The number of people is estimated by the detections of each joint per view, averaged over views,
    joints and frames.
    """
    joints = detections.skeleton.joints
    if len(frames) == 0:
        return 0
    # Number of frames, spread over the run, for estimating the number of people.
    spread = np.unique(
        np.linspace(frames.start, frames.stop - 1, min(len(frames), 200)).astype(int)
    )
    people = np.mean([len(detections[frame]) for frame in spread.tolist()]) / (
        len(rig) * len(joints)
    )
    tables = (Reconstruction.empty(joints), ObservationTable.empty(joints, rig.names))
    columns = [table.columns()[name] for table in tables for name in table.ROWS]
    row = sum(column.dtype.itemsize * prod(column.shape[1:]) for column in columns)
    return int(2 * row * people * len(frames))


def check_room(folder: Path, needed: int) -> None:
    """Raise InputError if the disk of `folder` has less free space than `needed` bytes."""
    free = shutil.disk_usage(folder).free
    if free < needed:
        raise InputError(
            f"{folder}: about {decimal(needed)} of disk space are needed, and {decimal(free)} "
            "are free; free some space, give another --output, or take a part with --frames"
        )


_KNOWN, _WRITTEN, _ARRAYS = "known-people", "known-people-written", ("betas", "information")


def people_at_start(
    kept: KeptArrays, file: Path, load: Callable[[], SubjectShapes]
) -> SubjectShapes:
    """People known when the run began; `load` reads them from `file`, a file of shapes, at the
    beginning.

    Raises InputError if the file has changed since, except by this run itself.
    """
    now = hashlib.sha256(read_bytes(file)).hexdigest() if file.exists() else None
    if _KNOWN not in kept.names(_KNOWN):
        known = load()
        about = {"names": known.names.tolist(), "body": known.body, "sha256": now}
        kept.keep(_KNOWN, {name: getattr(known, name) for name in _ARRAYS}, about)
        return known
    about = kept.about(_KNOWN)
    with naming(kept.place(_KNOWN), ANEW):
        if not isinstance(about, dict) or not {"names", "body", "sha256"} <= about.keys():
            raise ValueError("the persons of its shapes are missing")
        names = np.array([*map(str, about["names"])], dtype=str)
        known = SubjectShapes(
            names, *(kept.array(_KNOWN, name) for name in _ARRAYS), body=str(about["body"])
        )
    if now not in (about["sha256"], *map(kept.about, kept.names(_WRITTEN))):
        raise InputError(
            f"{file}: this file has changed since the run was interrupted; start again with "
            "--restart to use its new content"
        )
    return known


def checksum_at_start(kept: KeptArrays) -> str:
    """SHA-256 of the file that `people_at_start` read."""
    return kept.about(_KNOWN)["sha256"]


def write_people(kept: KeptArrays, file: Path, people: SubjectShapes) -> None:
    """Update `file`; a run interrupted right afterwards recognises its own change."""
    content = BytesIO()
    people.write(content)
    kept.keep(_WRITTEN, {}, hashlib.sha256(content.getvalue()).hexdigest())
    write_content(file, content.getvalue())
