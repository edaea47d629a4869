"""The formats that a result can be exported to."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.errors import InputError
from shapepose_fg.core.reconstruction import OpenedReconstruction
from shapepose_fg.io.export.job import Job, Written


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

    def write(self, job: Job) -> Written:
        """Write the files of a take; InputError where a package is missing or the take lacks what it needs."""
        write: Callable[[Job], Written] = self._function()
        return write(job)

    def write_rows(self, opened: OpenedReconstruction, rows: NDArray[np.intp] | None, folder: Path) -> Written:
        """Write a format of `rows`."""
        write: Callable[[OpenedReconstruction, NDArray[np.intp] | None, Path], Written] = self._function()
        return write(opened, rows, folder)

    def _function(self) -> Any:
        module, function = self.writer.split(":")
        return getattr(import_module(f"shapepose_fg.io.export.{module}"), function)


FORMATS = {
    each.name: each
    for each in (
        Format("amass", "poses and shape of a body, for learning code (npz)", "amass:write_amass"),
        Format("trc", "markers, for OpenSim and Pose2Sim", "trc:write_trc"),
        Format("c3d", "markers, for biomechanics", "c3d:write_c3d"),
        Format("bvh", "a moving skeleton, for animation", "bvh:write_bvh"),
        Format("glb", "moving bodies with their skin, for Blender and the web", "glb:write_glb"),
        Format("csv", "joints as a table", "table:write_csv", identities=False),
        Format("parquet", "all columns, for archives", "parquet:write_parquet", identities=False, rows=True),
        Format(
            "rrd",
            "everything on a timeline, for the rerun viewer",
            "rrd:write_rrd",
            identities=False,
            observations=True,
        ),
    )
}
"""By name. A format of your own is an entry here and a module beside this one."""


def chosen(names: Sequence[str]) -> list[Format]:
    """The formats of these names, each once, in the order given; InputError for a name that there is not."""
    for name in names:
        if name not in FORMATS:
            raise InputError(f"format {name}: there is none of this name; there are {' '.join(FORMATS)}")
    return [FORMATS[name] for name in dict.fromkeys(names)]
