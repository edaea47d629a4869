"""The folder of a run that is not finished: room for it, what it was begun from, and what it has done so far."""

import json
import shutil
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
from rich.filesize import decimal

from shapepose_fg.core.camera import Rig
from shapepose_fg.core.detections import DetectionSequence
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.observation_table import ObservationTable
from shapepose_fg.core.reconstruction import Reconstruction
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
_LOOKED_AT = 200
"""Frames, spread over the run, by which people are counted."""


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


_WORDS = {"program": "version of this program", "cameras": "set of cameras", "skeleton": "skeleton"}
"""What differs, where a key would not say it."""


def _refuse_other(folder: Path, before: Any, now: dict[str, Any]) -> None:
    """InputError where a run was begun from something else."""
    found = difference(before, now)
    if found is None:
        return
    name, was, is_now = found
    short = all(len(repr(value)) <= 40 for value in (was, is_now))
    how = f" ({was} then, {is_now} now)" if short else ""
    raise InputError(
        f"{folder}: the run that was stopped here had another {_WORDS.get(name, name)}{how}; start it as it was to"
        " go on, or begin anew with --restart"
    )


def expected_bytes(detections: DetectionSequence, rig: Rig, frames: range) -> int:
    """What a run needs on the disk at the most: its rows twice, as parts and, compressed or not, as results.

    As many people are expected as a view has detections of each joint, in the mean over views, joints and frames.
    """
    joints = detections.skeleton.joints
    if len(frames) == 0:
        return 0
    spread = np.unique(np.linspace(frames.start, frames.stop - 1, min(len(frames), _LOOKED_AT)).astype(int))
    people = np.mean([len(detections[frame]) for frame in spread.tolist()]) / (len(rig) * len(joints))
    tables = (Reconstruction.empty(joints), ObservationTable.empty(joints, rig.names))
    columns = [table.columns()[name] for table in tables for name in table.ROWS]
    row = sum(column.dtype.itemsize * prod(column.shape[1:]) for column in columns)
    return int(2 * row * people * len(frames))


def check_room(folder: Path, needed: int) -> None:
    """InputError where the disk of `folder` has less room than that."""
    free = shutil.disk_usage(folder).free
    if free < needed:
        raise InputError(
            f"{folder}: about {decimal(needed)} are needed here, and {decimal(free)} are free; make room, give"
            " another --output, or take a part with --frames"
        )
