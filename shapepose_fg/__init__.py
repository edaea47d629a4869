"""Reconstruct several people in 3D, with bodies and identities, from several calibrated cameras."""

import os
from importlib import import_module
from typing import TYPE_CHECKING, Any

# Or MKL, which torch brings, rounds by where in memory an array happens to lie, and the last digits
# of a result depend on the number of processes.
os.environ.setdefault("MKL_CBWR", "AUTO")


if TYPE_CHECKING:
    __version__: str
    from shapepose_fg.core.errors import InputError as InputError
    from shapepose_fg.core.reconstruction import Reconstruction as Reconstruction
    from shapepose_fg.io.calibration import read_rig as read_rig
    from shapepose_fg.io.calibration import write_rig as write_rig
    from shapepose_fg.io.config import read_config as read_config
    from shapepose_fg.io.detections import read_detections as read_detections
    from shapepose_fg.live.online import OnlineReconstructor as OnlineReconstructor
    from shapepose_fg.pipeline.execution import Execution as Execution
    from shapepose_fg.pipeline.pipeline import PipelineConfig as PipelineConfig
    from shapepose_fg.pipeline.pipeline import reconstruct as reconstruct
    from shapepose_fg.pipeline.pipeline import refine_trajectories as refine_trajectories
    from shapepose_fg.results.explain import explain as explain

_HOMES = {
    "Execution": "shapepose_fg.pipeline.execution",
    "InputError": "shapepose_fg.core.errors",
    "OnlineReconstructor": "shapepose_fg.live.online",
    "PipelineConfig": "shapepose_fg.pipeline.pipeline",
    "Reconstruction": "shapepose_fg.core.reconstruction",
    "explain": "shapepose_fg.results.explain",
    "read_config": "shapepose_fg.io.config",
    "read_detections": "shapepose_fg.io.detections",
    "read_rig": "shapepose_fg.io.calibration",
    "reconstruct": "shapepose_fg.pipeline.pipeline",
    "refine_trajectories": "shapepose_fg.pipeline.pipeline",
    "write_rig": "shapepose_fg.io.calibration",
}
"""Module of each public name, which is imported on first use, so that this import loads no
torch."""


def __getattr__(name: str) -> Any:
    """Import a public name on first use (PEP 562)."""
    if name == "__version__":  # the one of pyproject.toml, from the installed package
        return import_module("shapepose_fg.core.provenance").versions()["shapepose-fg"]
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(_HOMES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*globals(), *_HOMES, "__version__"])
