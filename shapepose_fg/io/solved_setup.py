"""What a saved result was solved with: its cameras, its settings, and where the detector puts its joints."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

from shapepose_fg.body.model.keypoint_offsets import KeypointOffsets
from shapepose_fg.body.model.smpl_file import SmplArrays
from shapepose_fg.body.shapes import read_body
from shapepose_fg.core.camera import Rig
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.io.calibration import read_rig
from shapepose_fg.io.config import ANOTHER_VERSION, config_from

CAMERAS = "cameras.json"
"""The cameras of a result, as a rig file of our own, beside its people.npz."""
Settings = TypeVar("Settings")


@dataclass(frozen=True)
class SolvedSetup(Generic[Settings]):
    """Enough to solve rows of a result anew from its observations."""

    rig: Rig
    """The cameras, in the order of the observations' views."""
    settings: Settings
    """The settings."""
    offsets: KeypointOffsets | None
    """Where the detector puts its joints on the body; None where that was not asked for."""
    body: Path | None
    """File of the body model; None for the one that ships."""


def body_of(run: Mapping[str, Any], given: Path | None = None) -> SmplArrays:
    """The body model of a result whose run.json says `run`, or of the file `given`; InputError if it is gone."""
    named = run.get("body") if given is None else given
    file = None if named is None else Path(str(named))
    if file is None or file.exists():
        return read_body(file)
    problem = "the body model of this result is not there any more"
    raise InputError(f"{file}: {problem}; put it back, or say with --body where it is")


def read_setup(folder: Path, people: Reconstruction, kind: type[Settings]) -> SolvedSetup[Settings]:
    """The setup of the result `people` that was loaded from `folder`; `kind` is the class of its settings.

    InputError, one sentence, where a file is missing or damaged, or the settings are another version's.
    """
    rig = read_rig(folder / CAMERAS)
    table = people.observations
    if table is not None and tuple(table.view_names.tolist()) != tuple(rig.names):
        raise InputError(
            f"{folder / CAMERAS}: the cameras are not those of observations.npz; reconstruct the recording again"
        )
    return setup_of(people, rig, kind, folder / "run.json")


def setup_of(
    people: Reconstruction, rig: Rig, kind: type[Settings], run_file: Path = Path("run.json")
) -> SolvedSetup[Settings]:
    """The same of a result whose cameras are known; `run_file` is where its `run` stands, for errors."""
    configuration: Any = people.run.get("configuration")
    if not isinstance(configuration, dict):
        raise InputError(f"{run_file}: configuration is missing; reconstruct the recording again")
    settings = config_from(configuration, kind, run_file, cure=ANOTHER_VERSION)
    offsets, body = people.run.get("keypoint_offsets"), people.run.get("body")
    offsets = None if offsets is None else KeypointOffsets.read(offsets, run_file)
    return SolvedSetup(rig, settings, offsets, None if body is None else Path(str(body)))
