"""C3D, the binary file of motion capture laboratories, by ezc3d: millimetres, y up; residual -1 is missing."""

import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from shapepose_fg.core.storage.files import write_atomically
from shapepose_fg.io.export.job import Job, Written, optional
from shapepose_fg.io.export.markers import Markers, markers_of
from shapepose_fg.io.export.take import Take

_MOST = 65_535
"""The number of a frame, and how many there are, have 16 bits in a C3D file."""


def write_c3d(job: Job) -> Written:
    """A file per person, or several of 65,535 frames, from the first to the last with a marker, at one rate."""
    optional("ezc3d", "export")
    take, lost = job.take.at_one_rate()
    written = Written()
    written.note_rate(lost, take.fps)
    for person, who in enumerate(take.persons.tolist()):
        markers = markers_of(take, person, job.markers, job.marker_body)
        if len(markers.frames) == 0:
            written.notes.append(f"c3d: person {who} has no marker in any frame")
            continue
        write_person(
            markers,
            take,
            job.folder,
            lambda span, who=who: f"person_{who}" + ("" if span is None else f"_frames_{span[0]}-{span[1]}"),
            written,
        )
    return written


def write_person(
    markers: Markers, take: Take, folder: Path, name: Callable[[tuple[int, int] | None], str], written: Written
) -> None:
    """One person's file in `folder`, from the first to the last frame with a marker; several of 65,535 frames.

    `take` is at one rate. `name` gives a file's name without ending: of all frames (None), or of the first to the
    last frame in it. Files and notes are added to `written`.
    """
    first, stop = int(markers.frames[0]), int(markers.frames[-1]) + 1
    for start in range(first, stop, _MOST):
        part = slice(start, min(start + _MOST, stop))
        frames = take.frames[part]
        span = int(frames[0]), int(frames[-1])
        path = folder / f"{name(None if stop - first <= _MOST else span)}.c3d"
        fits = span[1] < _MOST
        if not fits:
            written.notes.append(
                f"{path.name} counts its frames from 1, not {span[0] + 1}: numbers in C3D end at {_MOST}"
            )
        content = c3d_bytes(markers, span[0] if fits else 0, take.fps, part)
        write_atomically(path, lambda stream, content=content: stream.write(content))
        written.files.append(path)


def c3d_bytes(markers: Markers, first_frame: int, fps: float, part: slice = slice(None)) -> bytes:
    """A C3D file of the frames `part`; `first_frame`, counted from 0, is in its header, where frames count from 1.
    `part` has at most 65,535 frames, and the last is number 65,535 at most.

    A point's residual is the standard deviation of its place in whole millimetres, which the format keeps in a
    byte: 1 to 255, where 255 is more, too. It is 0 where it is not known (C3D's word for a point that was
    computed), and -1 where the point is missing.
    """
    ezc3d = optional("ezc3d", "export")
    xyz, sigma, there = markers.xyz[part], markers.sigma_m[part], markers.there[part]
    file = ezc3d.c3d()
    file["header"]["points"]["first_frame"] = first_frame
    point = file["parameters"]["POINT"]
    point["RATE"]["value"] = [fps]
    point["LABELS"]["value"] = list(markers.names)
    point["UNITS"]["value"] = ["mm"]
    # The axes as Pose2Sim's files have them: up on the screen is y.
    file.add_parameter("POINT", "X_SCREEN", "+Z")
    file.add_parameter("POINT", "Y_SCREEN", "+Y")
    points = np.ones((4, xyz.shape[1], len(xyz)))
    points[:3] = 1e3 * np.where(there[..., None], xyz, 0).transpose(2, 1, 0)
    known = np.isfinite(sigma)
    residuals = np.where(known, np.clip(np.rint(1e3 * np.where(known, sigma, 0)), 1, 255), 0)
    residuals = np.where(there, residuals, -1)
    file["data"]["points"] = points
    file["data"]["meta_points"]["residuals"] = residuals.T[None]
    file["data"]["meta_points"]["camera_masks"] = np.zeros((7, xyz.shape[1], len(xyz)), dtype=bool)
    with tempfile.TemporaryDirectory() as folder:  # ezc3d writes to a path only
        path = Path(folder) / "person.c3d"
        file.write(str(path))
        return path.read_bytes()
