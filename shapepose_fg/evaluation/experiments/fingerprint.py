"""What a table was made with, as eight digits: a table is old when today's differ."""

import hashlib
from functools import cache
from pathlib import Path

from shapepose_fg.body.fitting.fitters import BodyConfig
from shapepose_fg.evaluation.experiments.experiment import Basis
from shapepose_fg.pipeline import PipelineConfig
from shapepose_fg.simulation import DetectorConfig

_PACKAGE = Path(__file__).parents[2]
_DATA = {"pipeline": ("body", "estimation", "simulation"), "bodies": ("body",), "detector": ("body", "simulation")}
"""Rooms whose data decide: bodies, weights and priors; motion and scatter of joints; the simulated detector."""
_FILES = ("*.npz", "*.json", "*.safetensors")


@cache
def fingerprint(basis: Basis = "pipeline") -> str:
    """Of the default settings and of the data that ship, as far as they decide about figures of `basis`."""
    settings = {"pipeline": (PipelineConfig(),), "bodies": (BodyConfig(),), "detector": ()}[basis]
    whole = hashlib.sha256(repr(settings).encode())
    if basis != "bodies":
        whole.update(repr(DetectorConfig()).encode())
    for room in _DATA[basis]:
        for file in sorted(file for pattern in _FILES for file in (_PACKAGE / room).rglob(pattern)):
            whole.update(file.relative_to(_PACKAGE).as_posix().encode() + file.read_bytes())
    return whole.hexdigest()[:8]
