"""Modules that have moved: their old names still work, with a warning that says the new one."""

import sys
import warnings
from collections.abc import Sequence
from importlib import import_module
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType

_ROOMS = {
    "core": "errors camera skeleton detections observations observation_table frame_times bounds"
    " reconstruction provenance run_summary result_files",
    "core.storage": "files kept_arrays output_folder",
    "pipeline": "engine windows workers cluster solving bodies_over_time solved_rows runs",
    "cli": "options terminal stopping demo batch",
    "viz": "rendering overlay report viewer",
    "io": "export",
    "simulation": "training",
}
"""What was in the package's root until 0.1, by where it is now."""
_MERGED = {
    "core.storage.npz": "npz_reader npz_writer core.storage.npz_reader core.storage.npz_writer",
    "core.storage.schema": "columns core.columns",
    "core.result_files": "result_options core.result_options saved_table core.storage.saved_table",
    "pipeline.runs.manifest": "pipeline.runs.room",
    "core.drawing": "viz.viewer.palette io.export.bones io.export.light_mesh",
    "pipeline.runs.parts": "pipeline.runs.rows_of_people",
    "io.export.take": "io.export.axes",
    "io.detections.association_text": "io.detections.association_skeletons io.detections.number_stream",
    "io.detections.json_people": "io.detections.one_file io.detections.frame_files",
    "io.detections.reading": "io.detections.formats io.detections.places",
    "io.calibration.json_and_toml": "io.calibration.rig_file io.calibration.json_files",
    "io.calibration.opencv_and_ros": "io.calibration.opencv_storage io.calibration.ros",
    "io.calibration.content": "io.calibration.filestorage",
    "io.footage.placement": "io.footage.used",
    "io.footage.lockstep": "io.footage.given",
    "io.export.motion_files": "io.export.amass io.export.bvh",
    "io.export.skinned": "io.export.stretches",
    "io.export.registry": "io.export.exporting io.export.reading io.export.job",
    "io.export.tables": "io.export.table io.export.parquet",
    "io.export.markers": "io.export.marker_files io.export.trc io.export.c3d io.export.pose2sim_files",
    "io.export.rerun_app": "io.export.rerun_scene io.export.rerun_statistics io.export.rrd",
    "io.export.rerun_log": "io.export.rerun_people io.export.rerun_views io.export.rerun_pictures",
}
"""Modules that are others now, under whichever name."""
_RENAMED = {
    "pipeline_config": "pipeline.config",
    "chunk_work": "pipeline.solved_windows",
    "person_bodies": "pipeline.bodies_over_time",
    "batch_command": "cli.batch.command",
    **{f"{name}_command": f"cli.{name}" for name in "tracks detect overlay export report view setup".split()},
    **{f"reconstruct_{name}": f"cli.reconstruct.{name}" for name in "command ending request run".split()},
    **{f"reconstruct_{name}": "cli.reconstruct.request" for name in ("inputs", "outcome")},
    "reconstruct_summary": "cli.reconstruct.ending",
    **{old: new for new, names in _MERGED.items() for old in names.split()},
}
MOVED = {name: f"{room}.{name}" for room, names in _ROOMS.items() for name in names.split()} | _RENAMED
"""Old names to new ones, both within the package."""


class _Loader(Loader):
    """Gives the module at its new place."""

    def __init__(self, place: str) -> None:
        self.place = place

    def create_module(self, spec: ModuleSpec) -> None:
        return None

    def exec_module(self, module: ModuleType) -> None:
        warnings.warn(f"{module.__name__} is {self.place} now", DeprecationWarning, stacklevel=2)
        sys.modules[module.__name__] = import_module(self.place)


class _Finder(MetaPathFinder):
    """Finds modules by their old names."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        package, *parts = fullname.split(".")
        for n in range(1, len(parts) + 1) if package == "shapepose_fg" else ():
            new = MOVED.get(".".join(parts[:n]))
            if new is not None:
                return ModuleSpec(fullname, _Loader(".".join([package, new, *parts[n:]])))
        return None


def install() -> None:
    """From now on old names are found."""
    if not any(isinstance(finder, _Finder) for finder in sys.meta_path):
        sys.meta_path.insert(0, _Finder())
