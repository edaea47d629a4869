"""TRC, the marker file of OpenSim and Pose2Sim: text, metres, y up; a missing marker is NaN.

Its other notation is a blank, but OpenSim 4.6 refuses a row whose last marker is blank.
"""

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.storage.files import write_atomically
from shapepose_fg.io.export.job import Job, Written
from shapepose_fg.io.export.markers import Markers, markers_of


def write_trc(job: Job) -> Written:
    """A file per person, with a row for each frame in which the person has a marker."""
    take, written = job.take, Written()
    for person, who in enumerate(take.persons.tolist()):
        markers = markers_of(take, person, job.markers, job.marker_body)
        if len(markers.frames) == 0:
            written.notes.append(f"trc: person {who} has no marker in any frame")
            continue
        path = job.folder / f"person_{who}.trc"
        text = trc_text(markers, take.frames, take.times_s, take.fps, path.name)
        write_atomically(path, lambda stream, text=text: stream.write(text.encode()))
        written.files.append(path)
    return written


def trc_text(
    markers: Markers,
    frames: NDArray[np.integer],
    times_s: NDArray[np.float64],
    fps: float,
    name: str,
) -> str:
    """A TRC file, metres to 6 digits; `name` stands in its first line.

    A frame without any marker has no row, for OpenSim's inverse kinematics stops at one. The rows' own numbers and
    times say what is missing; `fps` is for readers that want a rate. ValueError where no frame has a marker.
    """
    rows = markers.frames
    if len(rows) == 0:
        raise ValueError(f"{name}: no frame has a marker")
    xyz, there, frames, times = markers.xyz[rows], markers.there[rows], frames[rows], times_s[rows]
    rate = f"{fps:.6g}"
    numbers = range(1, len(markers.names) + 1)
    lines = [
        f"PathFileType\t4\t(X/Y/Z)\t{name}",
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames",
        f"{rate}\t{rate}\t{len(frames)}\t{len(markers.names)}\tm\t{rate}\t{frames[0]}\t{len(frames)}",
        "Frame#\tTime\t" + "".join(f"{marker}\t\t\t" for marker in markers.names),
        "\t\t" + "".join(f"X{n}\tY{n}\tZ{n}\t" for n in numbers),
    ]
    words = np.where(there[..., None], np.char.mod("%.6f", xyz), "NaN").reshape(len(frames), -1)
    lines += [
        "\t".join((str(frame), f"{time:.6f}", *row))
        for frame, time, row in zip(frames.tolist(), times.tolist(), words.tolist(), strict=True)
    ]
    return "\n".join(lines) + "\n"
