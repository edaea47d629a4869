"""Modules that users imported and that have moved: old names still work, with a warning that says the new one."""

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
    "pipeline": "windows workers cluster solving bodies_over_time runs",
    "cli": "options terminal stopping demo batch",
    "viz": "rendering overlay report",
    "io": "export",
    "simulation": "training",
}
"""What was in the package's root until 0.1, by where it is now."""
MOVED = {name: f"{room}.{name}" for room, names in _ROOMS.items() for name in names.split()}
"""Old names to new ones, both within the package."""
MOVED |= {"pipeline_config": "pipeline.config", "person_bodies": "pipeline.bodies_over_time"}
MOVED |= dict.fromkeys(("engine", "pipeline.engine"), "pipeline.setup")


class _Finder(MetaPathFinder, Loader):
    """Finds modules by their old names, and gives those at their new places."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        package, *parts = fullname.split(".")
        for n in range(1, len(parts) + 1) if package == "shapepose_fg" else ():
            new = MOVED.get(".".join(parts[:n]))
            if new is not None:
                return ModuleSpec(fullname, self, loader_state=".".join([package, new, *parts[n:]]))
        return None

    def create_module(self, spec: ModuleSpec) -> None:
        return None

    def exec_module(self, module: ModuleType) -> None:
        assert module.__spec__ is not None
        place = module.__spec__.loader_state
        warnings.warn(f"{module.__name__} is {place} now", DeprecationWarning, stacklevel=2)
        sys.modules[module.__name__] = import_module(place)


def install() -> None:
    """From now on old names are found."""
    if not any(isinstance(finder, _Finder) for finder in sys.meta_path):
        sys.meta_path.insert(0, _Finder())
