"""What a table was made with: default settings, and the data that ship. It is old when today's differ."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from functools import cache
from pathlib import Path
from typing import Any

from shapepose_fg.body.fitting.fitters import BodyConfig
from shapepose_fg.evaluation.experiments.experiment import Basis
from shapepose_fg.evaluation.varied import varied
from shapepose_fg.pipeline.pipeline import PipelineConfig
from shapepose_fg.simulation import DetectorConfig

MadeWith = dict[str, str]
"""Value of every setting, as Python writes it, and the checksum of every file, by name."""

_PACKAGE = Path(__file__).parents[2]
_DATA = {"pipeline": ("body", "estimation", "simulation"), "bodies": ("body",)}
"""Folders whose data decide: bodies, weights and priors; motion and scatter of joints; the simulated detector."""
_OLD_NAMES = {
    "model_sigma_m": "learned.evidence.model_sigma_m",
    "kernel_scale": "learned.kernel_scale",
    "polish_steps": "learned.polish_steps",
    "unfinished": "learned.unfinished",
    "gap_s": "learned.sequence.gap_s",
    "correlation_s": "learned.sequence.lasting_s",
}
"""Settings of `BodyConfig`, and what they were called before."""
_FILES = ("*.npz", "*.json", "*.safetensors")


def made_with(basis: Basis = "pipeline") -> MadeWith:
    """The default settings and the data that ship, as far as they decide about figures of `basis`."""
    bodies_only = basis == "bodies"
    found = (
        _values(BodyConfig())
        if bodies_only
        else _values(varied(PipelineConfig())) | _values(DetectorConfig(), "detector.")
    )
    return found | {name: digest for folder in _DATA[basis] for name, digest in _checksums(folder).items()}


def changes(before: Mapping[str, str], now: Mapping[str, str]) -> list[str]:
    """What is not as it was, a few words each. A setting that is gone is a constant now, and does not count."""
    found, before = [], dict(before)
    for name, old in _OLD_NAMES.items():
        before |= {prefix + name: before[prefix + old] for prefix in ("", "body.") if prefix + old in before}
    for name, value in now.items():
        if name not in before:
            found.append(f"{name} is new")
        elif before[name] != value:
            found.append(f"{name} was {before[name]}, is {value}")
    return found + [f"{name} is gone" for name in before if "/" in name and name not in now]


def fingerprint(made: Mapping[str, str]) -> str:
    """Eight digits for what something was made with."""
    return hashlib.sha256(json.dumps(made, sort_keys=True).encode()).hexdigest()[:8]


def _values(settings: Any, prefix: str = "") -> MadeWith:
    """Every setting by its dotted name."""
    found: MadeWith = {}
    for each in fields(settings):
        value = getattr(settings, each.name)
        inner = is_dataclass(value)
        found |= _values(value, f"{prefix}{each.name}.") if inner else {f"{prefix}{each.name}": repr(value)}
    return found


@cache
def _checksums(folder: str) -> MadeWith:
    files = sorted(file for pattern in _FILES for file in (_PACKAGE / folder).rglob(pattern))
    return {
        file.relative_to(_PACKAGE).as_posix(): hashlib.sha256(file.read_bytes()).hexdigest()[:16] for file in files
    }
