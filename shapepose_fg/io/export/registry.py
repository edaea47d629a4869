"""The formats that a result can be exported to, and a result written in several of them."""

from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

from shapepose_fg.core.camera import Axis
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.io.export.job import Job, MarkerSet, Written
from shapepose_fg.io.export.reading import body_file, chosen_rows, read_take


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
        Format("amass", "poses and shape of a body, for learning code (npz)", "amass:write_amass"),
        Format("trc", "markers, for OpenSim and Pose2Sim", "marker_files:write_trc"),
        Format("c3d", "markers, for biomechanics", "marker_files:write_c3d"),
        Format("bvh", "a moving skeleton, for animation", "bvh:write_bvh"),
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
    up: Axis | None = None,
    fps: float | None = None,
    seen_only: bool = False,
    frames: range | None = None,
    persons: tuple[int, ...] | None = None,
    markers: MarkerSet = MarkerSet.OPENSIM,
    fill_gaps_s: float = 0.2,
    body: Path | None = None,
) -> dict[str, Written]:
    """What was written of each format into `folder`, by its name; InputError where a result does not allow it.

    The options are those of `read_take` and `Job`; `body` is where the body model's file is now. Files that are
    there already are replaced. A format of which no file came out is an InputError too.
    """
    job: Job | None = None
    if not all(each.rows for each in formats):
        take = read_take(
            results,
            up=up,
            fps=fps,
            seen_only=seen_only,
            frames=frames,
            persons=persons,
            identities=any(each.identities for each in formats),
            observations=any(each.observations for each in formats),
        )
        job = Job(take, folder, body_file(take, body), markers, fill_gaps_s)
    done: dict[str, Written] = {}
    for each in formats:
        if each.rows:
            with Reconstruction.open(results) as opened:
                done[each.name] = each.write(opened, chosen_rows(opened, results, frames, persons), folder)
        else:
            done[each.name] = each.write(job)
        if len(done[each.name].files) == 0:
            raise InputError(f"{results}: {'; '.join(done[each.name].notes)}; leave out {each.name}")
    return done
