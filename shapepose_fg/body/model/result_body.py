"""The body model with which a saved result was solved."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from shapepose_fg.body.model.body_model import BodyModel
from shapepose_fg.body.model.keypoint_offsets import KeypointOffsets
from shapepose_fg.body.model.smpl_file import SmplArrays, read_smpl_file
from shapepose_fg.core.errors import InputError


def body_of(run: Mapping[str, Any], given: Path | None = None) -> SmplArrays:
    """The body model named in `run` (the content of run.json), or in the file `given`; InputError
    if it is missing.
    """
    named = run.get("body") if given is None else given
    file = None if named is None else Path(str(named))
    if file is None:
        return BodyModel.default().arrays
    if file.exists():
        return read_smpl_file(file)
    problem = "the body model of this result is missing"
    raise InputError(f"{file}: {problem}; restore it, or give its path with --body")


def model_of(
    run: Mapping[str, Any], given: Path | None = None, run_file: Path = Path("run.json")
) -> BodyModel:
    """The body model of `body_of`, with the detector's offsets that the run estimated; `run` is the
    content of `run_file`.
    """
    arrays, default, offsets = body_of(run, given), BodyModel.default(), run.get("keypoint_offsets")
    model = default if arrays is default.arrays else BodyModel(arrays)
    if offsets is None:
        return model
    return model.with_keypoint_offsets(KeypointOffsets.read(offsets, run_file))
