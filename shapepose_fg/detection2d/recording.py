"""All pictures of a recording through the detector, in blocks that are kept: a run that stops can go on."""

import json
import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from shapepose_fg.core.camera import Rig
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.storage.files import inside, read_json, write_atomically, write_content
from shapepose_fg.detection2d.decoding import Candidates
from shapepose_fg.detection2d.detector import CameraDetector
from shapepose_fg.io.detections.association_text import TEXT_SKELETONS
from shapepose_fg.io.footage.footage import Footage
from shapepose_fg.io.footage.lockstep import Lockstep
from shapepose_fg.io.footage.placement import FOOTAGE, CameraFootage, write_used_footage
from shapepose_fg.io.write_detections import association_lines

BLOCK = 16
"""Moments that are kept together: what a run that is killed loses at most."""
_UNFINISHED = "unfinished"
_SETTINGS = "settings.json"

Progress = Callable[[int, int], None]
"""Told how many pictures of how many are done."""


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
        return {"network": network, "detection": {"long_side": first.long_side}, "cameras": cameras}


@dataclass(frozen=True)
class DetectionReport:
    """What came of it."""

    moments: int
    """T, the frames of the detections."""
    candidates: tuple[int, ...]
    """(V,) how many candidates each camera has."""
    unreadable: tuple[int, ...]
    """(V,) how many pictures of each camera could not be read."""


def run_detection(run: DetectionRun, progress: Progress = lambda done, total: None) -> DetectionReport:
    """Detect in all pictures, and write <camera>.txt (4D Association), times.csv and footage.json into the output.

    Blocks that an earlier run of the same settings left are not done again; the files come out the same.
    InputError where the folder holds detections, or a run of other settings.
    """
    unfinished = inside(run.output, _UNFINISHED)
    _refuse_others(run, unfinished)
    write_content(unfinished / _SETTINGS, _json(run.settings))
    total, views = len(run.moments), len(run.rig)
    files, counts = list[Path](), np.zeros((2, views), dtype=np.intp)
    for start in range(0, total, BLOCK):
        files.append(unfinished / f"{start:09d}.json")
        moments = range(start, min(start + BLOCK, total))
        if not files[-1].exists():
            _write_block(run, moments, files[-1], progress)
        counts += [_read_block(files[-1], views, name) for name in ("found", "failed")]
        progress(moments.stop * views, total * views)
    skeleton = TEXT_SKELETONS[run.detectors[0].network.layout.skeleton]

    def text_of(view: int) -> Iterator[bytes]:
        yield f"{skeleton.number} {total}\n".encode()
        for file in files:
            yield _read_block(file, views, "text")[view].encode()

    for view, name in enumerate(run.rig.names):
        write_atomically(run.output / f"{name}.txt", lambda stream, view=view: stream.writelines(text_of(view)))
    _write_times(run)
    used = [
        CameraFootage(name, footage.path.resolve(), detector.placement, run.moments.picture[:, view])
        for view, (name, footage, detector) in enumerate(
            zip(run.rig.names, run.footage, run.detectors, strict=True)
        )
    ]
    write_used_footage(run.output / FOOTAGE, used, {key: run.settings[key] for key in ("network", "detection")})
    shutil.rmtree(unfinished)
    return DetectionReport(total, *(tuple(each) for each in counts.tolist()))


def _write_block(run: DetectionRun, moments: range, file: Path, progress: Progress) -> None:
    """Detect in the pictures of some moments, camera after camera of each moment, and keep what was found.

    For each camera that is its text, how many candidates it has, and how many pictures could not be read.
    """
    views = len(run.rig)
    lines: list[list[str]] = [[] for _ in range(views)]
    found, failed = [0] * views, [0] * views
    for t in moments:
        for v, detector in enumerate(run.detectors):
            place = int(run.moments.picture[t, v])
            picture = run.footage[v].at(place) if place >= 0 else None
            failed[v] += place >= 0 and picture is None
            candidates = Candidates.none() if picture is None else detector.detect(picture)
            found[v] += len(candidates)
            lines[v] += association_lines(
                TEXT_SKELETONS[detector.network.layout.skeleton],
                candidates.joint,
                candidates.xy / (np.array(run.rig.cameras[v].image_size) - 1.0),
                candidates.score,
                candidates.pairs,
                candidates.affinity,
            )
            progress(t * views + v + 1, len(run.moments) * views)
    text = ["".join(f"{line}\n" for line in each) for each in lines]
    write_content(file, _json({"text": text, "found": found, "failed": failed}))


def _read_block(file: Path, views: int, name: str) -> list[Any]:
    """(V,) an entry of what `_write_block` wrote; InputError on anything else."""
    block = read_json(file)
    values = block.get(name) if isinstance(block, dict) else None
    kind = str if name == "text" else int
    if not isinstance(values, list) or len(values) != views or {*map(type, values)} != {kind}:
        raise InputError(f"{file}: not a block of this version; delete the folder that it is in")
    return values


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
    write_content(file, "\n".join(lines) + "\n")


def _refuse_others(run: DetectionRun, unfinished: Path) -> None:
    """InputError where the output folder holds other detections, or an unfinished run of other settings."""
    for name in run.rig.names:
        if Path(name).name != name or name in (".", ".."):
            raise InputError(f"camera {name!r}: the name cannot be that of a file; rename it in the calibration")
    if (unfinished / _SETTINGS).is_file():
        before, now = read_json(unfinished / _SETTINGS), json.loads(_json(run.settings))
        if before != now:
            raise InputError(
                f"{unfinished}: a run with {_difference(before, now)} was stopped here; start it as it was to go"
                " on, or delete this folder"
            )
    elif unfinished.exists():
        if any(unfinished.iterdir()):
            raise InputError(
                f"{unfinished}: not a run of this program; delete the folder, or give another --output"
            )
    elif there := [name for name in run.rig.names if (run.output / f"{name}.txt").exists()]:
        raise InputError(
            f"{run.output / there[0]}.txt: there are detections already; delete them, or give another --output"
        )


def _difference(before: Any, now: dict[str, Any]) -> str:
    """Which settings of an earlier run differ."""
    words = {"network": "another network", "detection": "other settings", "cameras": "other videos or cameras"}
    if not isinstance(before, dict):
        return "other settings"
    return " and ".join(what for key, what in words.items() if before.get(key) != now[key]) or "other settings"


def _state(path: Path) -> list[int]:
    """Size and time of last change of a video, or of a folder's pictures: whether it is still the same."""
    files = [path] if path.is_file() else sorted(each for each in path.iterdir() if each.is_file())
    states = [each.stat() for each in files]
    return [sum(each.st_size for each in states), max((each.st_mtime_ns for each in states), default=0)]


def _json(value: Any) -> str:
    return json.dumps(value, allow_nan=False)
