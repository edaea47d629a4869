"""Markers as files: TRC (OpenSim, Pose2Sim: text, metres), C3D (laboratories: binary, millimetres); both y up.

A missing marker is NaN in TRC (its other notation is a blank, but OpenSim 4.6 refuses a row whose last marker is
blank), and has the residual -1 in C3D, which ezc3d writes.
"""

import tempfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.camera import Axis
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.reconstruction import Known, Reconstruction
from shapepose_fg.io.export.job import Job, MarkerSet, Written, optional
from shapepose_fg.io.export.markers import Markers, markers_of
from shapepose_fg.io.export.take import Take
from shapepose_fg.io.pose2sim_project import Pose2SimProject

_MOST = 65_535
"""The number of a frame, and how many there are, have 16 bits in a C3D file."""


def _everybody(job: Job, take: Take, kind: str, written: Written) -> Iterator[tuple[int, Markers]]:
    """Everybody with a marker; who has none is noted."""
    for person, who in enumerate(take.persons.tolist()):
        markers = markers_of(take, person, job.markers, job.marker_body)
        if len(markers.frames) > 0:
            yield who, markers
        else:
            written.notes.append(f"{kind}: person {who} has no marker in any frame")


def write_trc(job: Job) -> Written:
    """A file per person, with a row for each frame in which the person has a marker."""
    take, written = job.take, Written()
    for who, markers in _everybody(job, take, "trc", written):
        path = job.folder / f"person_{who}.trc"
        written.add(path, trc_text(markers, take.frames, take.times_s, take.fps, path.name))
    return written


def trc_text(
    markers: Markers, frames: NDArray[np.integer], times_s: NDArray[np.float64], fps: float, name: str
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


def write_c3d(job: Job) -> Written:
    """A file per person, or several of 65,535 frames, from the first to the last with a marker, at one rate."""
    optional("ezc3d", "export")
    written = Written()
    take = written.at_one_rate(job.take)
    for who, markers in _everybody(job, take, "c3d", written):

        def name(span: tuple[int, int] | None, who: int = who) -> str:
            return f"person_{who}" + ("" if span is None else f"_frames_{span[0]}-{span[1]}")

        _write_c3d(markers, take, job.folder, name, written)
    return written


def _write_c3d(
    markers: Markers, take: Take, folder: Path, name: Callable[[tuple[int, int] | None], str], written: Written
) -> None:
    """One person's file from the first to the last frame with a marker; several of 65,535 frames.

    `take` is at one rate. `name` gives a file's name without ending: of all frames (None), or of the first to the
    last frame in it.
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
        written.add(path, c3d_bytes(markers, span[0] if fits else 0, take.fps, part))


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
    file["data"]["points"] = points
    file["data"]["meta_points"]["residuals"] = np.where(there, residuals, -1).T[None]
    file["data"]["meta_points"]["camera_masks"] = np.zeros((7, xyz.shape[1], len(xyz)), dtype=bool)
    with tempfile.TemporaryDirectory() as folder:  # ezc3d writes to a path only
        path = Path(folder) / "person.c3d"
        file.write(str(path))
        return path.read_bytes()


def write_pose2sim_files(people: Reconstruction, up: Axis, project: Pose2SimProject) -> Written:
    """A TRC and a C3D file per person into pose-3d/, where Pose2Sim's next steps look for NAME_A-B.trc; of one
    person only, where the project is of one: who has most joints in the detections of most frames.

    Frames have the project's numbers. A note says why there is no C3D, or nothing at all: this comes at the end of
    a run, which must not fail here.
    """
    written = Written()
    if len(people) == 0:
        written.notes.append("nobody was found, so there is no TRC and no C3D")
        return written
    try:
        take = Take.of(people, up)
    except ValueError as error:
        written.notes.append(f"no TRC and no C3D: {error}")
        return written
    first = project.first_number
    take = replace(take, frames=take.frames + first, times_s=take.times_s + first / take.fps)
    even = None
    try:
        optional("ezc3d", "export")
        even = written.at_one_rate(take)
    except InputError as error:
        written.notes.append(f"no C3D: {error}")
    before = {each.name for each in project.pose_3d.glob("*.trc")} if project.pose_3d.is_dir() else set()
    seen = Known.observed(take.people.known)
    most_seen = int(np.argmax([seen[rows[rows >= 0]].sum() for rows in take.rows]))
    for number, person in enumerate(range(len(take.persons)) if project.multi_person else [most_seen]):
        _write_person(take, person, number if project.multi_person else None, project, written, even)
    left = sorted(before - {each.name for each in written.files})
    if len(left) > 0:
        written.notes.append(
            f"{project.pose_3d} also has {' '.join(left[:4])}{' ...' if len(left) > 4 else ''} of before; take"
            " out what the next steps are not to read"
        )
    return written


def _write_person(
    take: Take, person: int, number: int | None, project: Pose2SimProject, written: Written, even: Take | None
) -> None:
    """The files of one person, the `number`th of several; no C3D without the take at one rate, `even`."""
    markers = markers_of(take, person, MarkerSet.OPENSIM)
    if len(markers.frames) == 0:
        written.notes.append(f"person {take.persons[person]} has no joint in any frame")
        return
    first, last = markers.frames[0], markers.frames[-1]
    name = project.name_of(number, int(take.frames[first]), int(take.frames[last]))
    path = project.pose_3d / f"{name}.trc"
    written.add(path, trc_text(markers, take.frames, take.times_s, take.fps, path.name))
    holes = int(last - first + 1 - len(markers.frames))
    if holes > 0:
        written.notes.append(f"{name}.trc leaves out {holes} frames in which nothing is known of the person")
    if even is not None:
        _write_c3d(
            markers_of(even, person, MarkerSet.OPENSIM),
            even,
            project.pose_3d,
            lambda span: name if span is None else project.name_of(number, *span),
            written,
        )
