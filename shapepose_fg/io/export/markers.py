"""Marker files of named points: TRC (OpenSim, Pose2Sim: text, metres), C3D (laboratories: binary,
mm).

Both are y up. A missing marker is NaN in TRC (a blank is also allowed, but OpenSim 4.6 refuses a
row with a blank last marker), and has the residual -1 in C3D, which is written by ezc3d.
"""

import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from shapepose_fg.body.model.smpl_file import SmplArrays
from shapepose_fg.core.arrays import Array, Index, Mask, Whole
from shapepose_fg.core.camera import Axis
from shapepose_fg.core.errors import InputError, optional
from shapepose_fg.core.reconstruction import Known, Reconstruction, sigma_m
from shapepose_fg.core.skeleton import MID_HIP, SMPL_24
from shapepose_fg.core.world_axes import opensim_axes
from shapepose_fg.io.export.registry import Job, MarkerSet, Written
from shapepose_fg.io.export.skinned import motion_of
from shapepose_fg.io.export.take import Take
from shapepose_fg.io.pose2sim_project import Pose2SimProject

_MOST = 65_535
"""Maximum number of frames in a C3D file, and maximum frame number: both have 16 bits."""
_TRC_HEAD = "\t".join(
    "DataRate CameraRate NumFrames NumMarkers Units OrigDataRate OrigDataStartFrame "
    "OrigNumFrames".split()
)


@dataclass(frozen=True)
class Markers:
    """One person's M markers over T frames, in the axes of TRC and C3D."""

    names: tuple[str, ...]
    """(M,) names."""
    xyz: Array
    """(T, M, 3) metres, y up; NaN if the marker is missing."""
    sigma_m: Array
    """(T, M) standard deviation, root mean square over the axes, metres; NaN if unknown."""

    @property
    def present(self) -> Mask:
        """(T, M) mask of the existing markers."""
        return np.asarray(np.isfinite(self.xyz).all(axis=2))

    @property
    def frames(self) -> Index:
        """(F,) the frames with at least one marker."""
        return np.flatnonzero(self.present.sum(axis=1))


def markers_of(
    take: Take, person: int, kind: MarkerSet, arrays: SmplArrays | None = None
) -> Markers:
    """The markers of one person; `arrays` is the body model, required only for `MarkerSet.BODY`."""
    axes = opensim_axes(take.up)
    if kind == MarkerSet.BODY:
        if arrays is None:
            raise ValueError("markers on the body need the body model")
        xyz = np.full((len(take.frames), len(SMPL_24), 3), np.nan)
        motion = motion_of(take, person, arrays, axes)
        if motion is not None:
            xyz[motion.index] = motion.joints()
        return Markers(SMPL_24, xyz, np.full(xyz.shape[:2], np.nan))
    names = tuple(take.people.joint_names.tolist())
    xyz = take.column("joints", person) @ axes.T
    sigma = sigma_m(take.column("covariance", person))
    return Markers(opensim_names(names) if kind == MarkerSet.OPENSIM else names, xyz, sigma)


def opensim_names(joints: tuple[str, ...]) -> tuple[str, ...]:
    """Names of joints in Pose2Sim's OpenSim models. They are ours, except for MidHip: `Hip` in the
    model for HALPE_26 (which also has the top of the head), and `CHip` in those for BODY_25 and
    COCO.
    """
    hip = "Hip" if "Head" in joints else "CHip"
    return tuple(hip if name == MID_HIP else name for name in joints)


def write_trc(job: Job) -> Written:
    """A file per person, with a row for each frame in which the person has a marker."""

    def write(person: int, markers: Markers, take: Take, written: Written) -> None:
        path = job.folder / f"person_{person}.trc"
        written.add(path, trc_text(markers, take.frames, take.times_s, take.fps, path.name))

    return _each(job, job.take, "trc", Written(), write)


def write_c3d(job: Job) -> Written:
    """A file per person, from the first to the last frame with a marker, at a constant rate;
    several files beyond 65,535 frames.
    """
    optional("ezc3d", "export")
    written = Written()
    even, origin = _c3d_take(written, job.take)

    def write(person: int, markers: Markers, take: Take, written: Written) -> None:
        def name(span: tuple[int, int] | None) -> str:
            return f"person_{person}" + ("" if span is None else f"_frames_{span[0]}-{span[1]}")

        _write_c3d(markers, take, job.folder, name, written, origin)

    return _each(job, even, "c3d", written, write)


def _c3d_take(written: Written, take: Take) -> tuple[Take, Array]:
    """The take in a form for C3D: at a constant rate and near a local origin (3,), metres in the
    axes of the file.
    """
    even = written.at_one_rate(take)
    return written.near_origin(even, opensim_axes(take.up), "c3d", "its parameter POINT:ORIGIN_M")


def _each(
    job: Job,
    take: Take,
    kind: str,
    written: Written,
    write: Callable[[int, Markers, Take, Written], None],
) -> Written:
    """Call `write` for each person with a marker; people without markers are noted."""
    for person, identity in enumerate(take.persons.tolist()):
        markers = markers_of(
            take, person, job.markers, job.arrays if job.markers == MarkerSet.BODY else None
        )
        if len(markers.frames) > 0:
            write(identity, markers, take, written)
        else:
            written.notes.append(f"{kind}: person {identity} has no marker in any frame")
    return written


def trc_text(markers: Markers, frames: Whole, times_s: Array, fps: float, name: str) -> str:
    """A TRC file, metres with 6 decimals; `name` is in its first line.

    A frame without any marker has no row, because OpenSim's inverse kinematics would stop there.
    Frame numbers and times of the rows show which are missing; `fps` is for programs that need a
    rate. ValueError if no frame has a marker.
    """
    rows = markers.frames
    if len(rows) == 0:
        raise ValueError(f"{name}: no frame has a marker")
    frames, words = (
        frames[rows],
        np.where(markers.present[..., None], np.char.mod("%.6f", markers.xyz), "NaN")[rows],
    )
    rate, count = f"{fps:.10g}", len(markers.names)
    lines = [
        f"PathFileType\t4\t(X/Y/Z)\t{name}",
        _TRC_HEAD,
        f"{rate}\t{rate}\t{len(frames)}\t{count}\tm\t{rate}\t{frames[0]}\t{len(frames)}",
        "Frame#\tTime\t" + "".join(f"{marker}\t\t\t" for marker in markers.names),
        "\t\t" + "".join(f"X{n}\tY{n}\tZ{n}\t" for n in range(1, count + 1)),
    ]
    every = zip(
        frames.tolist(), times_s[rows].tolist(), words.reshape(len(rows), -1).tolist(), strict=True
    )
    lines += ["\t".join((str(frame), f"{time:.6f}", *row)) for frame, time, row in every]
    return "\n".join(lines) + "\n"


def _write_c3d(
    markers: Markers,
    take: Take,
    folder: Path,
    name: Callable[[tuple[int, int] | None], str],
    written: Written,
    origin_m: Array,
) -> None:
    """One person's file from the first to the last frame with a marker; several of 65,535 frames.

    `take` has a constant rate. `name` returns a file's name without extension: for all frames
    (None), or for its first and last frame.
    """
    first, stop = int(markers.frames[0]), int(markers.frames[-1]) + 1
    for start in range(first, stop, _MOST):
        part = slice(start, min(start + _MOST, stop))
        span = int(take.frames[part][0]), int(take.frames[part][-1])
        path = folder / f"{name(None if stop - first <= _MOST else span)}.c3d"
        fits = span[1] < _MOST
        if not fits:
            counts = f"{path.name} numbers its frames from 1, not {span[0] + 1}"
            written.notes.append(f"{counts}: frame numbers in C3D are at most {_MOST}")
        written.add(path, c3d_bytes(markers, span[0] if fits else 0, take.fps, part, origin_m))


def c3d_bytes(
    markers: Markers,
    first_frame: int,
    fps: float,
    part: slice = slice(None),
    origin_m: Array | None = None,
) -> bytes:
    """A C3D file of the frames `part`; `first_frame`, counted from 0, is in its header, where
    frames count from 1. `part` has at most 65,535 frames, and the last is number 65,535 at most.

    A point's residual is the standard deviation of its position in whole millimetres, clipped to 1
    to 255 because the format has one byte for it. It is 0 if unknown (in C3D: a computed point),
    and -1 if the point is missing. `origin_m` (3,), metres, is the origin of the points in the
    world, in the axes of the file.
    """
    ezc3d = optional("ezc3d", "export")
    xyz, sigma, exists = markers.xyz[part], markers.sigma_m[part], markers.present[part]
    file = ezc3d.c3d()
    file["header"]["points"]["first_frame"] = first_frame
    point = file["parameters"]["POINT"]
    point["RATE"]["value"] = [fps]
    point["LABELS"]["value"] = list(markers.names)
    point["UNITS"]["value"] = ["mm"]
    # Axes as in Pose2Sim's files: y is up.
    file.add_parameter("POINT", "X_SCREEN", "+Z")
    file.add_parameter("POINT", "Y_SCREEN", "+Y")
    if origin_m is not None and origin_m.any():
        file.add_parameter("POINT", "ORIGIN_M", origin_m.tolist())
    points = np.ones((4, xyz.shape[1], len(xyz)))
    points[:3] = 1e3 * np.where(exists[..., None], xyz, 0).transpose(2, 1, 0)
    residuals = np.nan_to_num(np.clip(np.rint(1e3 * sigma), 1, 255), nan=0.0)
    file["data"]["points"] = points
    file["data"]["meta_points"]["residuals"] = np.where(exists, residuals, -1).T[None]
    file["data"]["meta_points"]["camera_masks"] = np.zeros((7, xyz.shape[1], len(xyz)), dtype=bool)
    with tempfile.TemporaryDirectory() as folder:  # ezc3d writes only to a path
        path = Path(folder) / "person.c3d"
        file.write(str(path))
        return path.read_bytes()


def write_pose2sim_files(people: Reconstruction, up: Axis, project: Pose2SimProject) -> Written:
    """Write a TRC and a C3D file per person into pose-3d/, where Pose2Sim's next steps look for
    NAME_A-B.trc. For a single-person project, only the person with the most detected joints is
    written.

    Frames have the project's numbers. A note gives the reason if there is no C3D or no file: this
    is the last step of a run, which must not fail here.
    """
    written, folder = Written(), project.pose_3d
    try:
        take = Take.of(people, up)
    except ValueError as error:
        written.notes.append(f"TRC and C3D are not written: {error}")
        return written
    first = project.first_number
    take = replace(take, frames=take.frames + first, times_s=take.times_s + first / take.fps)
    even, origin = None, np.zeros(3)
    try:
        optional("ezc3d", "export")
        even, origin = _c3d_take(written, take)
    except InputError as error:
        written.notes.append(f"C3D is not written: {error}")
    before = {each.name for each in folder.glob("*.trc")} if folder.is_dir() else set()
    seen = Known.observed(take.people.known)
    chosen = list(range(len(take.persons)))
    if not project.multi_person:
        chosen = [int(np.argmax([seen[rows[rows >= 0]].sum() for rows in take.rows]))]
    for number, person in enumerate(chosen):
        markers = markers_of(take, person, MarkerSet.OPENSIM)
        if len(markers.frames) == 0:
            written.notes.append(f"person {take.persons[person]} has no joint in any frame")
            continue

        def name(
            span: tuple[int, int] | None, number: int = number, markers: Markers = markers
        ) -> str:
            first, last = take.frames[markers.frames[[0, -1]]].tolist() if span is None else span
            return project.name_of(number if project.multi_person else None, first, last)

        path = folder / f"{name(None)}.trc"
        written.add(path, trc_text(markers, take.frames, take.times_s, take.fps, path.name))
        holes = int(np.ptp(markers.frames)) + 1 - len(markers.frames)
        if holes > 0:
            written.notes.append(
                f"{path.name} leaves out {holes} frames without data of the person"
            )
        if even is not None:
            _write_c3d(
                markers_of(even, person, MarkerSet.OPENSIM), even, folder, name, written, origin
            )
    left = sorted(before - {each.name for each in written.files})
    if len(left) > 0:
        written.notes.append(
            f"{folder} also has {' '.join(left[:4])}{' ...' if len(left) > 4 else ''} of an "
            "earlier run; remove the files that other programs should not read"
        )
    return written
