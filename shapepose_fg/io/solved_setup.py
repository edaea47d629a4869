"""What a saved result was solved with: its cameras and its body."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from shapepose_fg.body.model.body_model import BodyModel
from shapepose_fg.body.model.smpl_file import SmplArrays, read_smpl_file
from shapepose_fg.core.errors import InputError

CAMERAS = "cameras.json"
"""The cameras of a result, as a rig file of our own, beside its people.npz."""


def body_of(run: Mapping[str, Any], given: Path | None = None) -> SmplArrays:
    """The body model of a result whose run.json says `run`, or of the file `given`; InputError if it is gone."""
    named = run.get("body") if given is None else given
    file = None if named is None else Path(str(named))
    if file is None:
        return BodyModel.default().arrays
    if file.exists():
        return read_smpl_file(file)
    problem = "the body model of this result is not there any more"
    raise InputError(f"{file}: {problem}; put it back, or say with --body where it is")
