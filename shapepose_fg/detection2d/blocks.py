"""A recording that is detected in: what that depends on, and its candidates in blocks of a few moments."""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.camera import Rig
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.storage.files import write_atomically
from shapepose_fg.core.storage.npz import read_npz
from shapepose_fg.detection2d.detector import CameraDetector
from shapepose_fg.io.detections.association_text import TEXT_SKELETONS
from shapepose_fg.io.footage.footage import Footage
from shapepose_fg.io.footage.lockstep import Lockstep
from shapepose_fg.io.write_detections import association_lines


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


@dataclass(frozen=True)
class Block:
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
    def read(cls, file: Path) -> "Block":
        """What `write_block` wrote; InputError on anything else."""
        arrays = read_npz(file, cls.__dataclass_fields__, "delete the folder that it is in, and detect again")
        try:
            return cls(**arrays)
        except TypeError:
            raise InputError(f"{file}: not a block of this version; delete the folder that it is in") from None


def write_block(
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


def write_text(run: DetectionRun, view: int, unfinished: Path, stream: BinaryIO) -> None:
    """All candidates of one camera as 4D Association's text."""
    kind = TEXT_SKELETONS[run.detectors[view].network.layout.skeleton]
    size = np.array(run.rig.cameras[view].image_size, dtype=np.float64)
    stream.write(f"{kind.number} {len(run.moments)}\n".encode())
    for file in sorted(unfinished.glob("*.npz")):
        block = Block.read(file)
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


def _state(path: Path) -> list[int]:
    """Size and time of last change of a video, or of a folder's pictures: whether it is still the same."""
    files = [path] if path.is_file() else sorted(each for each in path.iterdir() if each.is_file())
    states = [each.stat() for each in files]
    return [sum(each.st_size for each in states), max((each.st_mtime_ns for each in states), default=0)]
