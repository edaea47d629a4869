"""TRC and C3D where Pose2Sim's next steps look for them: pose-3d/NAME_A-B.trc, with its frame numbers."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from shapepose_fg.core.camera import Axis
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.reconstruction import Known, Reconstruction
from shapepose_fg.core.storage.files import write_atomically
from shapepose_fg.io.export.c3d import write_person
from shapepose_fg.io.export.job import Written, optional
from shapepose_fg.io.export.markers import MarkerSet, markers_of
from shapepose_fg.io.export.take import Take
from shapepose_fg.io.export.trc import trc_text
from shapepose_fg.io.pose2sim_project import Pose2SimProject


def write_pose2sim_files(people: Reconstruction, up: Axis, project: Pose2SimProject) -> Written:
    """A TRC and a C3D file per person into pose-3d/; of one person only, where the project is of one.

    That one is who has most joints in the detections of most frames. A note says why there is no C3D, or nothing
    at all: this comes at the end of a run, which must not fail here.
    """
    written = Written()
    if len(people) == 0:
        written.notes.append("nobody was found, so there is no TRC and no C3D")
        return written
    try:
        take = _numbered(Take.of(people, up), project.first_number)
    except ValueError as error:
        written.notes.append(f"no TRC and no C3D: {error}")
        return written
    chosen = range(len(take.persons)) if project.multi_person else [_main_person(take)]
    even = _even_or_why_not(take, written)
    before = {each.name for each in project.pose_3d.glob("*.trc")} if project.pose_3d.is_dir() else set()
    for number, person in enumerate(chosen):
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
    _write(
        project.pose_3d / f"{name}.trc",
        trc_text(markers, take.frames, take.times_s, take.fps, f"{name}.trc").encode(),
    )
    written.files.append(project.pose_3d / f"{name}.trc")
    holes = int(last - first + 1 - len(markers.frames))
    if holes > 0:
        written.notes.append(f"{name}.trc leaves out {holes} frames in which nothing is known of the person")
    if even is not None:
        write_person(
            markers_of(even, person, MarkerSet.OPENSIM),
            even,
            project.pose_3d,
            lambda span: name if span is None else project.name_of(number, *span),
            written,
        )


def _numbered(take: Take, first: int) -> Take:
    """The same with the project's own frame numbers, and the times that go with them."""
    return replace(take, frames=take.frames + first, times_s=take.times_s + first / take.fps)


def _main_person(take: Take) -> int:
    """Who was seen most: joints that a view saw, over all frames."""
    seen = Known.observed(take.people.known)
    count = [int(seen[rows[rows >= 0]].sum()) for rows in take.rows]
    return int(np.argmax(count))


def _even_or_why_not(take: Take, written: Written) -> Take | None:
    """The take at one rate, for C3D; None, and a note, where there cannot be one."""
    try:
        optional("ezc3d", "export")
        even, lost = take.at_one_rate()
    except InputError as error:
        written.notes.append(f"no C3D: {error}")
        return None
    written.note_rate(lost, take.fps)
    return even


def _write(path: Path, content: bytes) -> None:
    write_atomically(path, lambda stream: stream.write(content))
