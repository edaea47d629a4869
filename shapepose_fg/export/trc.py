"""TRC, the marker file of OpenSim and Pose2Sim: text, y up; a missing marker is blank."""

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.export.job import Job, Written
from shapepose_fg.export.markers import Markers, markers_of
from shapepose_fg.files import write_atomically


def write_trc(job: Job) -> Written:
    """A file per person, from the first to the last frame with a marker."""
    take, written = job.take, Written()
    for person, who in enumerate(take.persons.tolist()):
        markers = markers_of(take, person, job.markers, job.marker_body)
        part = take.part(person, np.isfinite(markers.xyz).all(axis=2).any(axis=1))
        if part.start == part.stop:
            written.notes.append(f"trc: person {who} has no marker in any frame")
            continue
        path = job.folder / f"person_{who}.trc"
        text = trc_text(markers, take.frames, take.times_s, take.fps, path.name, part)
        write_atomically(path, lambda stream, text=text: stream.write(text.encode()))
        written.files.append(path)
    return written


def trc_text(
    markers: Markers,
    frames: NDArray[np.integer],
    times_s: NDArray[np.float64],
    fps: float,
    name: str,
    part: slice = slice(None),
) -> str:
    """A TRC file of the frames `part`, metres to 6 digits; `name` stands in its first line.

    A frame's own time is in its row, so that times need no even steps; `fps` is for readers that want a rate.
    """
    xyz, frames, times = markers.xyz[part], frames[part], times_s[part]
    rate = f"{fps:.6g}"
    numbers = range(1, len(markers.names) + 1)
    lines = [
        f"PathFileType\t4\t(X/Y/Z)\t{name}",
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames",
        f"{rate}\t{rate}\t{len(frames)}\t{len(markers.names)}\tm\t{rate}\t{frames[0]}\t{len(frames)}",
        "Frame#\tTime\t" + "".join(f"{marker}\t\t\t" for marker in markers.names),
        "\t\t" + "".join(f"X{n}\tY{n}\tZ{n}\t" for n in numbers),
        "",
    ]
    there = np.isfinite(xyz).all(axis=2)
    words = np.where(there[..., None], np.char.mod("%.6f", np.where(there[..., None], xyz, 0)), "")
    rows = words.reshape(len(frames), -1).tolist()
    lines += [
        "\t".join((str(frame), f"{time:.6f}", *row))
        for frame, time, row in zip(frames.tolist(), times.tolist(), rows, strict=True)
    ]
    return "\n".join(lines) + "\n"
