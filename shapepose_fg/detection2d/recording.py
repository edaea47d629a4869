"""All pictures of a recording through the detector, in blocks that are kept: a run that stops can go on."""

import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from shapepose_fg.core.errors import InputError
from shapepose_fg.core.storage.files import read_json, write_atomically
from shapepose_fg.detection2d.blocks import Block, DetectionRun, write_block, write_text
from shapepose_fg.io.footage.placement import FOOTAGE, CameraFootage, write_used_footage

BLOCK = 16
"""Moments that are kept together: what a run that is killed loses at most."""
_UNFINISHED = "unfinished"
_SETTINGS = "settings.json"


def run_detection(run: DetectionRun, progress: Callable[[int, int], None] | None = None) -> "DetectionReport":
    """Detect in all pictures, and write <camera>.txt (4D Association), times.csv and footage.json into the output.

    Blocks that an earlier run of the same settings left are not done again; the files come out the same.
    `progress` is told how many pictures are done. InputError where the folder holds detections, or a run
    of other settings.
    """
    unfinished = run.output / _UNFINISHED
    _refuse_others(run, unfinished)
    write_atomically(unfinished / _SETTINGS, lambda stream: stream.write(_json(run.settings)))
    total, views = len(run.moments), len(run.rig)
    failed = np.zeros(views, dtype=np.intp)
    found = np.zeros(views, dtype=np.intp)
    for start in range(0, total, BLOCK):
        file = unfinished / f"{start:09d}.npz"
        moments = range(start, min(start + BLOCK, total))
        if not file.exists():
            write_block(run, moments, file, progress)
        block = Block.read(file)
        failed += block.failed
        found += np.bincount(block.view, minlength=views)
        if progress is not None:
            progress(moments.stop * views, total * views)
    for view, name in enumerate(run.rig.names):
        write_atomically(run.output / f"{name}.txt", lambda stream, v=view: write_text(run, v, unfinished, stream))
    _write_times(run)
    report = DetectionReport(total, tuple(found.tolist()), tuple(failed.tolist()))
    used = [
        CameraFootage(name, footage.path.resolve(), detector.placement, run.moments.picture[:, view])
        for view, (name, footage, detector) in enumerate(
            zip(run.rig.names, run.footage, run.detectors, strict=True)
        )
    ]
    write_used_footage(run.output / FOOTAGE, used, {key: run.settings[key] for key in ("network", "detection")})
    shutil.rmtree(unfinished)
    return report


@dataclass(frozen=True)
class DetectionReport:
    """What came of it."""

    moments: int
    """T, the frames of the detections."""
    candidates: tuple[int, ...]
    """(V,) how many candidates each camera has."""
    unreadable: tuple[int, ...]
    """(V,) how many pictures of each camera could not be read."""


def _write_times(run: DetectionRun) -> None:
    """times.csv: when each frame was taken, for each camera where they are not synchronised."""
    time_s = run.moments.time_s
    file = run.output / "times.csv"
    if time_s is None:
        file.unlink(missing_ok=True)
        return
    time_s = time_s - time_s.min()
    names = list(run.rig.names)
    apart = not run.moments.synchronised and not any(set(name) & set(", \t#") for name in names)
    columns = time_s if apart else time_s.mean(axis=1, keepdims=True)
    lines = [", ".join(["frame", *(names if apart else ["time_s"])])]
    lines += [f"{frame}, " + ", ".join(f"{value:.6f}" for value in row) for frame, row in enumerate(columns)]
    write_atomically(file, lambda stream: stream.write(("\n".join(lines) + "\n").encode()))


def _refuse_others(run: DetectionRun, unfinished: Path) -> None:
    """InputError where the output folder holds other detections, or an unfinished run of other settings."""
    for name in run.rig.names:
        if Path(name).name != name or name in (".", ".."):
            raise InputError(f"camera {name!r}: the name cannot be that of a file; rename it in the calibration")
    if unfinished.exists():
        if (unfinished / _SETTINGS).is_file():
            before = read_json(unfinished / _SETTINGS)
            if before == json.loads(_json(run.settings)):
                return
            raise InputError(
                f"{unfinished}: a run with {_difference(before, run)} was stopped here; start it as it was to go"
                " on, or delete this folder"
            )
        if any(unfinished.iterdir()):
            raise InputError(
                f"{unfinished}: not a run of this program; delete the folder, or give another --output"
            )
        return
    there = [name for name in run.rig.names if (run.output / f"{name}.txt").exists()]
    if len(there) > 0:
        raise InputError(
            f"{run.output / there[0]}.txt: there are detections already; delete them, or give another --output"
        )


def _difference(before: Any, run: DetectionRun) -> str:
    """Which settings of an earlier run differ."""
    words = {"network": "another network", "detection": "other settings", "cameras": "other videos or cameras"}
    now = json.loads(_json(run.settings))
    if not isinstance(before, dict):
        return "other settings"
    return " and ".join(what for key, what in words.items() if before.get(key) != now[key]) or "other settings"


def _json(value: Any) -> bytes:
    return json.dumps(value, allow_nan=False).encode()
