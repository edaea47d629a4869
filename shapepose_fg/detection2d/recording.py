"""Runs the detector on all pictures of a recording, in blocks that are saved, so that a run can be
resumed.
"""

import json
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.arrays import Array
from shapepose_fg.core.camera import Camera
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.frame_sets import FrameSets
from shapepose_fg.core.run_summary import difference
from shapepose_fg.core.storage.files import inside, read_json, write_atomically, write_content
from shapepose_fg.detection2d.decoding import PictureCandidates
from shapepose_fg.detection2d.opening import Network
from shapepose_fg.detection2d.top_down import PicturePeople
from shapepose_fg.detection2d.upright import UprightView, roll_of
from shapepose_fg.io.footage.footage import Footage, Progress
from shapepose_fg.io.footage.placement import (
    FOOTAGE,
    UNFINISHED,
    UNFINISHED_SETTINGS,
    CameraFootage,
    Placement,
    write_used_footage,
)
from shapepose_fg.io.timestamps import nameable, write_timestamps

BLOCK = 16
"""Number of frame sets in a block. An interrupted run loses at most one block."""


@dataclass(frozen=True)
class CameraDetector:
    """The detector for the pictures of one camera."""

    camera: Camera
    """The camera."""
    footage: Footage
    """Pictures of the camera."""
    placement: Placement
    """Mapping from calibrated pixels to the pixels of the pictures."""
    network: Network
    """The network."""
    view: UprightView
    """The network's input."""

    @classmethod
    def of(
        cls, camera: Camera, up: Array, footage: Footage, placement: Placement, network: Network
    ) -> Self:
        """The detector for `camera` in a world where `up` (3,) points up."""
        view = network.view(placement.region, roll_of(camera, up))
        return cls(camera, footage, placement, network, view)

    def detect(self, picture: NDArray[np.uint8]) -> PictureCandidates | PicturePeople:
        """Detections in a `picture` (H, W, 3), blue green red; in calibrated pixels, not
        undistorted.
        """
        found = self.network.detect(self.view.input_of(picture))
        xy = self.view.picture_from_input(found.xy)
        # Detections in the empty corners of a rotated picture are left out.
        return found.moved(self.placement.to_calibrated(xy), self.view.inside(xy))


@dataclass(frozen=True)
class DetectionRun:
    """A detection run over all cameras."""

    cameras: Sequence[CameraDetector]
    """(V,) detector of each camera; all with the same network."""
    moments: FrameSets
    """Synchronised frame sets."""
    output: Path
    """The folder for the detections."""

    @property
    def settings(self) -> dict[str, Any]:
        """All settings that affect the detections; equal in a resumed run."""
        cameras = {
            each.camera.name: {
                "path": str(each.footage.path.resolve()),
                "state": _state(each.footage.path),
                "placement": str(each.placement.kind),
                "turned_deg": each.view.turn_deg,
                "frames": self.moments.picture[:, view].tolist(),
            }
            for view, each in enumerate(self.cameras)
        }
        return {**self.cameras[0].network.settings, "cameras": cameras}


def run_detection(
    run: DetectionRun, progress: Progress = lambda done, total: None
) -> tuple[list[int], list[int]]:
    """Detect in all pictures, and write <camera>.txt or <camera>.json, times.csv and footage.json
    into the output.

    Returns (V,) the number of joints in each camera's pictures, and (V,) the number of unreadable
    pictures. Blocks of an interrupted run with the same settings are reused, with the same
    resulting files. InputError if the folder has other detections, or a run with other settings.
    """
    unfinished = inside(run.output, UNFINISHED)
    _refuse_others(run, unfinished)
    write_content(unfinished / UNFINISHED_SETTINGS, json.dumps(run.settings, allow_nan=False))
    total, views = len(run.moments), len(run.cameras)
    files, counts = list[Path](), np.zeros((2, views), dtype=np.intp)
    for start in range(0, total, BLOCK):
        files.append(unfinished / f"{start:09d}.json")
        moments = range(start, min(start + BLOCK, total))
        if not files[-1].exists():
            _write_block(run, moments, files[-1], progress)
        counts += [_read_block(files[-1], views, name) for name in ("found", "failed")]
        progress(moments.stop * views, total * views)
    network = run.cameras[0].network

    def text_of(view: int) -> Iterator[bytes]:
        yield network.head(total).encode()
        for file in files:
            yield _read_block(file, views, "text")[view].encode()
        yield network.tail.encode()

    used = []
    for view, each in enumerate(run.cameras):
        file = run.output / f"{each.camera.name}{network.suffix}"
        write_atomically(file, lambda stream, view=view: stream.writelines(text_of(view)))
        places = run.moments.picture[:, view]
        used.append(
            CameraFootage(each.camera.name, each.footage.path.resolve(), each.placement, places)
        )
    _write_times(run)
    write_used_footage(run.output / FOOTAGE, used, network.settings)
    shutil.rmtree(unfinished)
    joints, unreadable = counts.tolist()
    return joints, unreadable


def _write_block(run: DetectionRun, moments: range, file: Path, progress: Progress) -> None:
    """Detect in the pictures of some frame sets, camera by camera of each set, and save the
    results.

    For each camera these are its text, the number of joints, and the number of unreadable pictures.
    """
    views = len(run.cameras)
    text, found, failed = [""] * views, [0] * views, [0] * views
    for t in moments:
        for v, each in enumerate(run.cameras):
            place = int(run.moments.picture[t, v])
            picture = each.footage.at(place) if place >= 0 else None
            failed[v] += place >= 0 and picture is None
            seen = None if picture is None else each.detect(picture)
            found[v] += 0 if seen is None else len(seen)
            text[v] += each.network.text(t, seen, each.camera.image_size)
            progress(t * views + v + 1, len(run.moments) * views)
    write_content(file, json.dumps({"text": text, "found": found, "failed": failed}))


def _read_block(file: Path, views: int, name: str) -> list[Any]:
    """(V,) the entry `name` of a block file written by `_write_block`; InputError for any other
    content.
    """
    block = read_json(file)
    values = block.get(name) if isinstance(block, dict) else None
    kind = str if name == "text" else int
    if not isinstance(values, list) or len(values) != views or {*map(type, values)} != {kind}:
        raise InputError(f"{file}: this is not a block of this version; delete its folder")
    return values


def _write_times(run: DetectionRun) -> None:
    """Write times.csv: the times of the frames; one column per camera if they are asynchronous."""
    time_s = run.moments.time_s
    file = run.output / "times.csv"
    if time_s is None:
        file.unlink(missing_ok=True)
        return
    names = [each.camera.name for each in run.cameras]
    by_camera = not run.moments.synchronised and nameable(names)
    write_timestamps(file, names, time_s if by_camera else np.nanmean(time_s, axis=1))


def _refuse_others(run: DetectionRun, unfinished: Path) -> None:
    """Raise InputError where the output folder has other detections, or an unfinished run with
    other settings.
    """
    names = [each.camera.name for each in run.cameras]
    if Path(FOOTAGE).stem in names:
        raise InputError(
            f"camera {Path(FOOTAGE).stem!r}: this name would conflict with {FOOTAGE}; rename the"
            " camera in the calibration"
        )
    places = [run.output / f"{name}{suffix}" for name in names for suffix in (".txt", ".json")]
    if (unfinished / UNFINISHED_SETTINGS).is_file():
        found = difference(read_json(unfinished / UNFINISHED_SETTINGS), run.settings)
        if found is not None:
            name, was, now = found
            how = f" ({was} then, {now} now)" if max(len(repr(was)), len(repr(now))) <= 40 else ""
            raise InputError(
                f"{unfinished}: the interrupted run had another {name}{how}; start it with the "
                "same options to continue, or delete this folder"
            )
    elif unfinished.exists() and any(unfinished.iterdir()):
        raise InputError(
            f"{unfinished}: this is not a run of this program; delete the folder, or give "
            "another --output"
        )
    elif existing := [place for place in places if place.exists()]:
        raise InputError(
            f"{existing[0]}: there are detections already; delete them, or give another --output"
        )


def _state(path: Path) -> list[int]:
    """Size and modification time of a video, or of a folder's pictures, for detecting changes."""
    files = [path] if path.is_file() else sorted(each for each in path.iterdir() if each.is_file())
    states = [each.stat() for each in files]
    return [
        sum(each.st_size for each in states),
        max((each.st_mtime_ns for each in states), default=0),
    ]
