"""What a writer is given, and what it says it has done."""

from dataclasses import dataclass, field
from enum import StrEnum
from functools import cached_property
from importlib import import_module
from pathlib import Path
from types import ModuleType

from shapepose_fg.body.model.smpl_file import SmplArrays
from shapepose_fg.body.shapes import read_body
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.storage.files import write_content
from shapepose_fg.io.export.take import Take


class MarkerSet(StrEnum):
    """Which points are markers, and what they are called."""

    OPENSIM = "opensim"
    """The joints of the result, named as in the OpenSim models of Pose2Sim."""
    JOINTS = "joints"
    """The joints of the result with its own names."""
    BODY = "body"
    """The 24 joints of the body: smooth, and there whenever the body is."""


@dataclass(frozen=True)
class Job:
    """A take, where its files go, and what was asked for."""

    take: Take
    """What is exported."""
    folder: Path
    """Where the files go."""
    body_file: Path | None = None
    """File of the body model; None for the one that the result was made with."""
    markers: MarkerSet = MarkerSet.OPENSIM
    """What TRC and C3D hold."""
    fill_gaps_s: float = 0.2
    """Holes in a body's motion up to this long are interpolated where a format can have none."""

    @property
    def body(self) -> Path | None:
        """File of the body model; None for the one that ships."""
        named = self.take.people.run.get("body")
        return self.body_file if self.body_file is not None or named is None else Path(str(named))

    @cached_property
    def arrays(self) -> SmplArrays:
        """The body model; InputError where its file is not there any more."""
        try:
            return read_body(self.body)
        except InputError as error:
            if self.body is None or self.body.exists():
                raise
            raise InputError(
                f"{self.body}: the body model of this result is not there any more; put it back, or say with"
                " --body where it is"
            ) from error


@dataclass
class Written:
    """What came of a format."""

    files: list[Path] = field(default_factory=list)
    """The files, whole."""
    notes: list[str] = field(default_factory=list)
    """What was left out or changed, a sentence each."""

    def add(self, path: Path, content: str | bytes) -> None:
        """Write a file, whole or not at all."""
        write_content(path, content)
        self.files.append(path)

    def at_one_rate(self, take: Take) -> Take:
        """The take for formats that know one rate only; frames that have no place at it are noted."""
        even, lost = take.at_one_rate()
        if lost > 0:
            self.notes.append(f"{lost} frames left out: at {take.fps:g} a second others are nearer to their place")
        return even


def optional(module: str, extra: str) -> ModuleType:
    """A package of an extra; InputError with the command where it is not installed."""
    try:
        return import_module(module)
    except ImportError:
        package = module.partition(".")[0]
        raise InputError(f'{package} is not installed; pip install "shapepose-fg[{extra}]"') from None
