"""C3D, the binary file of motion capture laboratories, by ezc3d: millimetres, y up; residual -1 is missing."""

import tempfile
from pathlib import Path

import numpy as np

from shapepose_fg.export.job import Job, Written, optional
from shapepose_fg.export.markers import Markers, markers_of
from shapepose_fg.files import write_atomically


def write_c3d(job: Job) -> Written:
    """A file per person, from the first to the last frame with a marker, at one rate."""
    optional("ezc3d", "export")
    take, lost = job.take.at_one_rate()
    written = Written()
    written.note_rate(lost, take.fps)
    for person, who in enumerate(take.persons.tolist()):
        markers = markers_of(take, person, job.markers, job.marker_body)
        if len(markers.frames) == 0:
            written.notes.append(f"c3d: person {who} has no marker in any frame")
            continue
        part = slice(int(markers.frames[0]), int(markers.frames[-1]) + 1)
        path = job.folder / f"person_{who}.c3d"
        content = c3d_bytes(markers, int(take.frames[part.start]), take.fps, part)
        write_atomically(path, lambda stream, content=content: stream.write(content))
        written.files.append(path)
    return written


def c3d_bytes(markers: Markers, first_frame: int, fps: float, part: slice = slice(None)) -> bytes:
    """A C3D file of the frames `part`; `first_frame`, counted from 0, is in its header, where frames count from 1.

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
