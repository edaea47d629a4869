"""All pictures of a recording through the detector, in blocks that are kept: a run that stops can go on."""

import json
import shutil
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.camera import Rig
from shapepose_fg.columns import read_npz
from shapepose_fg.detection2d.detector import CameraDetector
from shapepose_fg.errors import InputError
from shapepose_fg.files import read_json, write_atomically
from shapepose_fg.io.detections.association_skeletons import TEXT_SKELETONS
from shapepose_fg.io.footage.footage import Footage
from shapepose_fg.io.footage.lockstep import Lockstep
from shapepose_fg.io.footage.used import FOOTAGE, CameraFootage, write_used_footage
from shapepose_fg.io.write_detections import association_lines

BLOCK = 16
"""Moments that are kept together: what a run that is killed loses at most."""
_UNFINISHED = "unfinished"
_SETTINGS = "settings.json"


@dataclass(frozen=True)
class DetectionRun:
    """What is to be detected."""

    rig: Rig
    """The cameras."""
    footage: Sequence[Footage]
    """(V,) their pictures."""
    detectors: Sequence[CameraDetector]
    """(V,) how each camera's pictures are read."""
    moments: Lockstep
    """Which pictures belong together."""
    output: Path
    """The folder for the detections."""

    @property
    def settings(self) -> dict[str, Any]:
        """What the detections depend on: equal for a run that goes on."""
        first = self.detectors[0]
        cameras = [
            {
                "name": name,
                "path": str(footage.path.resolve()),
                "state": _state(footage.path),
                "placement": str(detector.placement.kind),
                "roll_deg": detector.roll_deg,
                "frames": self.moments.picture[:, view].tolist(),
            }
            for view, (name, footage, detector) in enumerate(
                zip(self.rig.names, self.footage, self.detectors, strict=True)
            )
        ]
        network = {"sha256": first.network.sha256, "layout": first.network.layout.name}
        return {"network": network, "detection": asdict(first.config), "cameras": cameras}


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
            _write_block(run, moments, file, progress)
        block = _Block.read(file)
        failed += block.failed
        found += np.bincount(block.view, minlength=views)
        if progress is not None:
            progress(moments.stop * views, total * views)
    for view, name in enumerate(run.rig.names):
        write_atomically(
            run.output / f"{name}.txt", lambda stream, v=view: _write_text(run, v, unfinished, stream)
        )
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


@dataclass(frozen=True)
class _Block:
    """Candidates of a few moments, of all views; sorted by moment, then view."""

    moment: NDArray[np.int64]
    """(D,) from the block's first."""
    view: NDArray[np.int64]
    joint: NDArray[np.int64]
    xy: NDArray[np.float64]
    """(D, 2) calibrated pixels."""
    score: NDArray[np.float64]
    pairs: NDArray[np.int64]
    """(E, 2) rows of this block."""
    affinity: NDArray[np.float64]
    failed: NDArray[np.int64]
    """(V,) pictures that could not be read."""
    length: NDArray[np.int64]
    """() moments of the block."""

    @classmethod
    def read(cls, file: Path) -> "_Block":
        arrays = read_npz(file, "delete the folder that it is in, and detect again")
        try:
            return cls(**arrays)
        except TypeError:
            raise InputError(f"{file}: not a block of this version; delete the folder that it is in") from None


def _write_block(
    run: DetectionRun, moments: range, file: Path, progress: Callable[[int, int], None] | None
) -> None:
    """Detect in the pictures of some moments, camera after camera of each moment, and keep what was found."""
    moment, view, found = [], [], []
    failed = np.zeros(len(run.rig), dtype=np.int64)
    for t in moments:
        for v, detector in enumerate(run.detectors):
            place = int(run.moments.picture[t, v])
            picture = run.footage[v].at(place) if place >= 0 else None
            failed[v] += place >= 0 and picture is None
            if picture is not None:
                found.append(detector.detect(picture))
                moment.append(t - moments.start)
                view.append(v)
            if progress is not None:
                progress(t * len(run.rig) + v + 1, len(run.moments) * len(run.rig))
    counts = np.array([len(each) for each in found], dtype=np.intp)
    start = np.cumsum(counts) - counts
    shifted = [each.pairs + first for each, first in zip(found, start.tolist(), strict=True)]
    arrays = {
        "moment": np.repeat(np.array(moment, dtype=np.int64), counts),
        "view": np.repeat(np.array(view, dtype=np.int64), counts),
        "joint": _joined([each.joint for each in found], np.int64),
        "xy": _joined([each.xy for each in found], np.float64, 2),
        "score": _joined([each.score for each in found], np.float64),
        "pairs": _joined(shifted, np.int64, 2),
        "affinity": _joined([each.affinity for each in found], np.float64),
        "failed": failed,
        "length": np.int64(len(moments)),
    }
    buffer = BytesIO()
    np.savez(buffer, **arrays)
    write_atomically(file, lambda stream: stream.write(buffer.getvalue()))


def _joined(parts: Sequence[NDArray[Any]], kind: type, width: int | None = None) -> NDArray[Any]:
    """The rows of all parts; none of the right shape where there are no parts."""
    shape = (0,) if width is None else (0, width)
    return np.concatenate([np.zeros(shape, dtype=kind), *parts]).astype(kind)


def _write_text(run: DetectionRun, view: int, unfinished: Path, stream: BinaryIO) -> None:
    """All candidates of one camera as 4D Association's text."""
    kind = TEXT_SKELETONS[run.detectors[view].network.layout.skeleton]
    size = np.array(run.rig.cameras[view].image_size, dtype=np.float64)
    stream.write(f"{kind.number} {len(run.moments)}\n".encode())
    for file in sorted(unfinished.glob("*.npz")):
        block = _Block.read(file)
        for t in range(int(block.length)):
            rows = np.flatnonzero((block.view == view) & (block.moment == t))
            place = np.full(len(block.view), -1, dtype=np.intp)
            place[rows] = np.arange(len(rows))
            mine = place[block.pairs[:, 0]] >= 0
            lines = association_lines(
                kind,
                block.joint[rows],
                block.xy[rows] / (size - 1),
                block.score[rows],
                place[block.pairs[mine]],
                block.affinity[mine],
            )
            stream.write(("\n".join(lines) + "\n").encode())


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


def _state(path: Path) -> list[int]:
    """Size and time of last change of a video, or of a folder's pictures: whether it is still the same."""
    files = [path] if path.is_file() else sorted(each for each in path.iterdir() if each.is_file())
    states = [each.stat() for each in files]
    return [sum(each.st_size for each in states), max((each.st_mtime_ns for each in states), default=0)]


def _json(value: Any) -> bytes:
    return json.dumps(value, allow_nan=False).encode()
