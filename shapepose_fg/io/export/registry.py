"""The formats that a result can be exported to, and a saved result written in several of them."""

from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.camera import Axis
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.reconstruction import OpenedReconstruction, Reconstruction
from shapepose_fg.core.result_files import results_folder
from shapepose_fg.core.run_summary import covered_frames
from shapepose_fg.io.calibration import read_rig
from shapepose_fg.io.export.job import Job, MarkerSet, Written
from shapepose_fg.io.export.take import Take
from shapepose_fg.io.solved_setup import CAMERAS


@dataclass(frozen=True)
class Format:
    """One format of file."""

    name: str
    """What it is called on the command line."""
    about: str
    """What it holds and who reads it, in a few words."""
    writer: str
    """Module and function that writes it: `write(job: Job) -> Written`; with `rows` it is `write(opened, rows,
    folder) -> Written` of an `OpenedReconstruction` and the rows of it (R,), None for all."""
    identities: bool = True
    """Whether it follows people over frames, and so needs a result over time."""
    observations: bool = False
    """Whether it shows what people were solved from."""
    rows: bool = False
    """Whether it holds the result's rows as they are, and is written without having them all in memory."""

    @property
    def write(self) -> Any:
        """The function; InputError where a package is missing or a take lacks what it needs."""
        module, function = self.writer.split(":")
        return getattr(import_module(f"shapepose_fg.io.export.{module}"), function)


_ANYBODY = {"identities": False}
FORMATS = {
    each.name: each
    for each in (
        Format("amass", "poses and shape of a body, for learning code (npz)", "motion_files:write_amass"),
        Format("trc", "markers, for OpenSim and Pose2Sim", "markers:write_trc"),
        Format("c3d", "markers, for biomechanics", "markers:write_c3d"),
        Format("bvh", "a moving skeleton, for animation", "motion_files:write_bvh"),
        Format("glb", "moving bodies with their skin, for Blender and the web", "glb:write_glb"),
        Format("csv", "joints as a table", "tables:write_csv", **_ANYBODY),
        Format("parquet", "all columns, for archives", "tables:write_parquet", **_ANYBODY, rows=True),
        Format(
            "rrd", "everything on a timeline, for the rerun viewer", "rerun_app:write_rrd", **_ANYBODY,
            observations=True,
        ),
    )
}  # fmt: skip
"""By name. A format of your own is an entry here and a module beside this one."""


def chosen(names: Sequence[str]) -> list[Format]:
    """The formats of these names, each once, in the order given; InputError for a name that there is not."""
    for name in names:
        if name not in FORMATS:
            raise InputError(f"format {name}: there is none of this name; there are {' '.join(FORMATS)}")
    return [FORMATS[name] for name in dict.fromkeys(names)]


def export_result(
    results: Path,
    formats: Sequence[Format],
    folder: Path,
    *,
    markers: MarkerSet = MarkerSet.OPENSIM,
    fill_gaps_s: float = 0.2,
    body: Path | None = None,
    **options: Any,
) -> dict[str, Written]:
    """What was written of each format into `folder`, by its name; InputError where a result does not allow it.

    `options` are those of `read_take`, the others `Job`'s; `body` is where the body model's file is now. Files
    that are there already are replaced. A format of which no file came out is an InputError too.
    """
    job: Job | None = None
    if not all(each.rows for each in formats):
        needs = {name: any(getattr(each, name) for each in formats) for name in ("identities", "observations")}
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
            raise InputError(f"{results}: {'; '.join(done[each.name].notes)}; leave out {each.name}")
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
    """What of the result at `path` is exported; InputError, one sentence, where it cannot be.

    `up` is asked for where there is no cameras.json beside people.npz. `frames` and `persons` choose rows;
    `observations` says whether what they were solved from is read, too. `options` are those of `Take.of`.
    """
    cameras = results_folder(path) / CAMERAS
    if up is not None and up not in get_args(Axis):
        raise InputError(f"--up {up}: must be one of x -x y -y z -z")
    with Reconstruction.open(path) as opened:
        rig = read_rig(cameras) if cameras.is_file() else None
        axis: Any = up or (None if rig is None else rig.up)
        if axis is None:
            raise InputError(f"{cameras}: it is not there to say which axis is up; give --up, such as --up z")
        people = opened.rows(chosen_rows(opened, path, frames, persons), observations=observations)
    if frames is not None:  # of those that were reconstructed the ones that are asked for
        spans = covered_frames(people.run) or []
        cut = [[max(span.start, frames.start), min(span.stop, frames.stop)] for span in spans]
        people = people.with_run(frames=[[start, stop] for start, stop in cut if start < stop])
    try:
        return Take.of(people, axis, rig=rig, **options)
    except ValueError as error:
        raise InputError(f"{path}: {error}") from None


def chosen_rows(
    opened: OpenedReconstruction, path: Path, frames: range | None, persons: tuple[int, ...] | None
) -> NDArray[np.intp] | None:
    """(R,) rows of these frames and people; None for all. InputError for somebody who is not there."""
    if frames is None and persons is None:
        return None
    mine = np.ones(len(opened), dtype=bool)
    if persons is not None:
        strangers = sorted(set(persons) - set(opened.person.tolist()))
        if strangers:
            there = " ".join(map(str, np.unique(opened.person).tolist()))
            raise InputError(f"--person {strangers[0]}: {path} has no such person; it has {there}")
        mine = np.isin(opened.person, persons)
    if frames is None:
        return np.flatnonzero(mine)
    found, there = mine & (opened.frame >= frames.start) & (opened.frame < frames.stop), opened.frame[mine]
    if len(there) > 0 and not found.any():
        raise InputError(
            f"--frames: {path} has nobody in these frames; people are in frames {there.min()} to {there.max()}"
        )
    return np.flatnonzero(found)
