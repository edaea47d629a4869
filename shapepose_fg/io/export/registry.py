"""Export formats, their common input, and the export of a saved result to several formats."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from functools import cached_property
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from shapepose_fg.body.model.body_model import BodyModel
from shapepose_fg.body.model.result_body import body_of, model_of
from shapepose_fg.body.model.smpl_file import SmplArrays
from shapepose_fg.core.arrays import Array, Index
from shapepose_fg.core.camera import Axis
from shapepose_fg.core.errors import InputError, naming
from shapepose_fg.core.reconstruction import OpenedReconstruction, Reconstruction
from shapepose_fg.core.result_files import results_folder
from shapepose_fg.core.rig_file import CAMERAS
from shapepose_fg.core.run_summary import covered_frames
from shapepose_fg.core.storage.files import write_content
from shapepose_fg.io.calibration import read_rig
from shapepose_fg.io.export.take import Take


class MarkerSet(StrEnum):
    """Selection and names of the markers."""

    OPENSIM = "opensim"
    """The joints of the result, named as in the OpenSim models of Pose2Sim."""
    JOINTS = "joints"
    """The joints of the result, with the names of the result."""
    BODY = "body"
    """The 24 joints of the body: smooth, and available in all frames with a body."""


@dataclass(frozen=True)
class Job:
    """A take, its output folder, and options."""

    take: Take
    """The people to export."""
    folder: Path
    """The output folder."""
    body_file: Path | None = None
    """File of the body model; None for the one with which the result was made."""
    markers: MarkerSet = MarkerSet.OPENSIM
    """Markers of TRC and C3D."""
    fill_gaps_s: float = 0.2
    """Longest gap in a body's motion, s, that is interpolated for formats without gaps."""

    @property
    def body(self) -> Path | None:
        """File of the body model; None for the built-in one."""
        named = self.take.people.run.get("body")
        return self.body_file if self.body_file is not None or named is None else Path(str(named))

    @cached_property
    def arrays(self) -> SmplArrays:
        """The body model; InputError if its file is missing."""
        return body_of(self.take.people.run, self.body_file)

    @cached_property
    def model(self) -> BodyModel:
        """The body model, with the detector's offsets; InputError if its file is missing."""
        return model_of(self.take.people.run, self.body_file)


@dataclass
class Written:
    """Output of a format."""

    files: list[Path] = field(default_factory=list)
    """The written files."""
    notes: list[str] = field(default_factory=list)
    """Notes on what was left out or changed, one sentence each."""

    def add(self, path: Path, content: str | bytes) -> None:
        """Write a file, atomically."""
        write_content(path, content)
        self.files.append(path)

    def near_origin(self, take: Take, turn: Array, kind: str, where: str) -> tuple[Take, Array]:
        """The take shifted to a local origin for single-precision formats, and that origin (3,),
        metres, in the axes that result from the rotation `turn` (3, 3).

        If the origin is not that of the world, it is noted, together with the place in the file
        that states it, `where`.
        """
        local, origin = take.near_origin()
        origin = turn @ origin
        if origin.any():
            listed = " ".join(f"{each:.0f}" for each in origin)
            self.notes.append(
                f"{kind}: coordinates are relative to {listed} m of the world, in the axes of "
                f"the file ({where}), because the format keeps seven digits"
            )
        return local, origin

    def at_one_rate(self, take: Take) -> Take:
        """The take at a constant rate, for formats that require one; frames that do not fit the
        rate are noted.
        """
        even, lost = take.at_one_rate()
        if lost > 0:
            self.notes.append(
                f"{lost} frames are left out: at {take.fps:g} Hz, other frames are nearer to "
                "their times"
            )
        return even


@dataclass(frozen=True)
class ExportFormat:
    """An export format."""

    name: str
    """Name on the command line."""
    writer: str
    """Module and function that writes it: `write(job: Job) -> Written`. With `rows`, it is
    `write(opened, rows, folder) -> Written` of an `OpenedReconstruction` and row numbers (R,), None
    for all."""
    identities: bool = True
    """Whether the format stores people over time, and therefore requires a result with
    identities."""
    observations: bool = False
    """Whether the format includes the detections from which people were solved."""
    rows: bool = False
    """Whether the format contains the rows of the result unchanged, and is written without loading
    all into memory."""

    @property
    def write(self) -> Any:
        """The writer function; InputError if a package is missing or the take lacks a
        requirement.
        """
        module, function = self.writer.split(":")
        return getattr(import_module(f"shapepose_fg.io.export.{module}"), function)


_ANYBODY = {"identities": False}
FORMATS = {
    each.name: each
    for each in (
        ExportFormat("amass", "motion_files:write_amass"),
        ExportFormat("trc", "markers:write_trc"),
        ExportFormat("c3d", "markers:write_c3d"),
        ExportFormat("bvh", "motion_files:write_bvh"),
        ExportFormat("glb", "glb:write_glb"),
        ExportFormat("angles", "tables:write_angles", **_ANYBODY),
        ExportFormat("opensim", "opensim:write_opensim"),
        ExportFormat("csv", "tables:write_csv", **_ANYBODY),
        ExportFormat("parquet", "tables:write_parquet", **_ANYBODY, rows=True),
        ExportFormat("mcap", "mcap:write_mcap"),
        ExportFormat("rrd", "rerun_app:write_rrd", **_ANYBODY, observations=True),
    )
}
"""Formats by name. To add one, write a module beside this one, and an entry here."""


def chosen(names: Sequence[str]) -> list[ExportFormat]:
    """The formats with these names, without duplicates, in the given order; InputError for unknown
    names.
    """
    for name in names:
        if name not in FORMATS:
            raise InputError(f"format {name}: must be one of {' '.join(FORMATS)}")
    return [FORMATS[name] for name in dict.fromkeys(names)]


def export_result(
    results: Path,
    formats: Sequence[ExportFormat],
    folder: Path,
    *,
    markers: MarkerSet = MarkerSet.OPENSIM,
    fill_gaps_s: float = 0.2,
    body: Path | None = None,
    **options: Any,
) -> dict[str, Written]:
    """Export a result to several formats into `folder`; returns the output by format. InputError if
    that is impossible, or if a format has no file to write.

    `options` are passed to `read_take`, the other arguments to `Job`; `body` is the current path of
    the body model. Existing files are replaced.
    """
    job: Job | None = None
    if not all(each.rows for each in formats):
        kinds = ("identities", "observations")
        needs: Any = {name: any(getattr(each, name) for each in formats) for name in kinds}
        job = Job(read_take(results, **options, **needs), folder, body, markers, fill_gaps_s)
    done: dict[str, Written] = {}
    for each in formats:
        if each.rows:
            with Reconstruction.open(results) as opened:
                rows = chosen_rows(opened, results, options.get("frames"), options.get("persons"))
                done[each.name] = each.write(opened, rows, folder)
        else:
            done[each.name] = each.write(job)
        if len(done[each.name].files) == 0:
            raise InputError(
                f"{results}: {'; '.join(done[each.name].notes)}; leave out {each.name}"
            )
    return done


def read_take(
    path: Path,
    *,
    up: Axis | None = None,
    frames: range | None = None,
    persons: tuple[int, ...] | None = None,
    observations: bool = True,
    **options: Any,
) -> Take:
    """Read the part of the result at `path` that is exported; InputError, one sentence, if that is
    impossible.

    `up` is required if there is no cameras.json beside people.npz. `frames` and `persons` choose
    rows; `observations` also reads their detections. `options` are those of `Take.of`.
    """
    cameras = results_folder(path) / CAMERAS
    with Reconstruction.open(path) as opened:
        rig = read_rig(cameras) if cameras.is_file() else None
        axis: Any = up or (None if rig is None else rig.up)
        if axis is None:
            raise InputError(
                f"{cameras}: this file is missing, and it contains the up axis; give --up, such "
                "as --up z, or write it with `people.save(folder, rig)`"
            )
        people = opened.rows(chosen_rows(opened, path, frames, persons), observations=observations)
    if frames is not None:  # the requested frames among the reconstructed ones
        spans = covered_frames(people.run) or []
        cut = [[max(span.start, frames.start), min(span.stop, frames.stop)] for span in spans]
        people = people.with_run(frames=[[start, stop] for start, stop in cut if start < stop])
    with naming(path):
        return Take.of(people, axis, rig=rig, **options)


def chosen_rows(
    opened: OpenedReconstruction, path: Path, frames: range | None, persons: tuple[int, ...] | None
) -> Index | None:
    """(R,) rows of these frames and people; None for all. InputError for unknown people."""
    if frames is None and persons is None:
        return None
    selected = np.ones(len(opened), dtype=bool)
    if persons is not None:
        strangers = sorted(set(persons) - set(opened.person.tolist()))
        if strangers:
            known = " ".join(map(str, np.unique(opened.person).tolist()))
            raise InputError(f"--person {strangers[0]}: {path} has no such person; it has {known}")
        selected = np.isin(opened.person, persons)
    if frames is None:
        return np.flatnonzero(selected)
    found, known = (
        selected & (opened.frame >= frames.start) & (opened.frame < frames.stop),
        opened.frame[selected],
    )
    if len(known) > 0 and not found.any():
        problem = f"{path} has no people in these frames"
        raise InputError(
            f"--frames: {problem}; people are in frames {known.min()} to {known.max()}"
        )
    return np.flatnonzero(found)
