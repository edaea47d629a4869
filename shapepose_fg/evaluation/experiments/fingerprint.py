"""What a table was made with, as eight digits: a table is old when today's differ."""

import hashlib
from functools import cache
from pathlib import Path

from shapepose_fg.io.config import toml_text
from shapepose_fg.pipeline import PipelineConfig
from shapepose_fg.simulation import DetectorConfig

_PACKAGE = Path(__file__).parents[2]
_DATA = ("*.npz", "*.json", "*.safetensors")


@cache
def fingerprint() -> str:
    """Of every default setting, and of the data that ships: weights, priors, body, the simulated detector."""
    whole = hashlib.sha256(toml_text(PipelineConfig()).encode())
    whole.update(repr(DetectorConfig()).encode())
    for file in sorted(file for pattern in _DATA for file in _PACKAGE.rglob(pattern)):
        whole.update(file.relative_to(_PACKAGE).as_posix().encode() + file.read_bytes())
    return whole.hexdigest()[:8]
