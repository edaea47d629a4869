"""What several commands take: options in groups, and what is given as text, a range of frames or a size."""

import inspect
import re
from collections.abc import Callable
from dataclasses import MISSING, dataclass, fields, is_dataclass
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast, get_type_hints

import typer

from shapepose_fg.core.errors import InputError

if TYPE_CHECKING:
    from shapepose_fg.core.camera import Axis, Rig
    from shapepose_fg.io.calibration import Unit

INPUT, TIME, RESULT, RUN, DRAW = "Input", "Time", "Result", "Run", "What is drawn"
"""Headings under which `--help` lists options."""


def option(group: str, text: str, *names: str, **more: Any) -> Any:
    """An option under a heading, with its help."""
    how: dict[str, Any] = {"show_default": False} | more
    return typer.Option(*names, help=text, rich_help_panel=group, **how)


def grouped(command: Callable[..., Any]) -> Callable[..., Any]:
    """`command` as typer takes it: a dataclass among its parameters becomes an option for each of its fields."""
    hints = get_type_hints(command, include_extras=True)
    groups = {name: hint for name, hint in hints.items() if is_dataclass(hint)}
    taken: dict[str, list[str]] = {}
    parameters = []
    for name, parameter in inspect.signature(command).parameters.items():
        if name not in groups:
            parameters.append(parameter.replace(kind=parameter.KEYWORD_ONLY, annotation=hints[name]))
            continue
        within = get_type_hints(groups[name], include_extras=True)
        taken[name] = [each.name for each in fields(groups[name]) if hasattr(within[each.name], "__metadata__")]
        for each in fields(groups[name]):
            if each.name in taken[name]:
                default = parameter.empty if each.default is MISSING else each.default
                added = inspect.Parameter(each.name, parameter.KEYWORD_ONLY, default=default)
                parameters.append(added.replace(annotation=within[each.name]))

    @wraps(command)
    def called(**given: Any) -> Any:
        made = {
            name: cast(Any, groups[name])(**{key: given.pop(key) for key in keys}) for name, keys in taken.items()
        }
        return command(**made, **given)

    del called.__wrapped__
    cast(Any, called).__signature__ = inspect.Signature(parameters)
    called.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return called


FramesOption = Annotated[
    str | None, option(TIME, "Frames A to B-1; either may be left out.", metavar="A:B", show_default=False)
]
WorkersOption = Annotated[
    int | None, option(RUN, "Processes of this machine; by default as many as pay. They change no byte.")
]
JsonOption = Annotated[bool, option(RESULT, "Print everything as JSON.", "--json")]


@dataclass(frozen=True, kw_only=True)
class RunOptions:
    """What runs the work, and what becomes of work that was stopped."""

    workers: WorkersOption = None
    cluster: Annotated[
        str | None,
        option(
            RUN,
            "Dask scheduler (tcp://host:8786) whose processes solve; `local`: Dask's own, here.",
            metavar="ADDRESS",
        ),
    ] = None
    resume: Annotated[bool, option(RUN, "Go on with what was stopped in --output.", "--resume")] = False
    restart: Annotated[bool, option(RUN, "Begin anew, whatever was stopped in --output.", "--restart")] = False

    def check(self) -> None:
        """Refuse what contradicts itself."""
        check_workers(self.workers)
        if self.workers is not None and self.cluster not in (None, "local"):
            raise InputError(
                f"--workers and --cluster {self.cluster}: these are processes of this machine, or of the cluster;"
                " give one"
            )
        if self.resume and self.restart:
            raise InputError("--resume and --restart: this goes on or begins anew; give one of them")


@dataclass(frozen=True, kw_only=True)
class CameraOptions:
    """The cameras of a recording."""

    calibration: Annotated[Path, option(INPUT, "Cameras: a file, or a folder, of one of the formats known.")]
    up: Annotated[str | None, option(INPUT, "World axis that points up: x -x y -y z -z.", metavar="AXIS")] = None
    unit: Annotated[str | None, option(INPUT, "Unit of the calibration: m, cm or mm.", metavar="UNIT")] = None
    image_size: Annotated[
        str | None, option(INPUT, "Size of the calibrated pictures, where the file has none.", metavar="WxH")
    ] = None

    def rig(self) -> "Rig":
        """The cameras; InputError where they cannot be used."""
        from shapepose_fg.io.calibration import read_rig

        match = re.fullmatch(r"\s*(\d{1,9})\s*[x×,]\s*(\d{1,9})\s*", self.image_size or "")
        if self.image_size is not None and match is None:
            raise InputError(f"--image-size {self.image_size}: must be WIDTHxHEIGHT in pixels, such as 1920x1080")
        size = None if match is None else (int(match[1]), int(match[2]))
        up, unit = cast("Axis | None", self.up), cast("Unit | None", self.unit)
        return read_rig(self.calibration, up=up, unit=unit, image_size=size)


@dataclass(frozen=True, kw_only=True)
class DetectionOptions(CameraOptions):
    """Cameras, and what a 2D detector saw with them."""

    detections: Annotated[Path, option(INPUT, "Folder with what a 2D detector wrote of every camera.")]
    skeleton: Annotated[
        str | None, option(INPUT, "The detector's skeleton, or a TOML file that describes it.", metavar="NAME")
    ] = None


@dataclass(frozen=True, kw_only=True)
class ResultOptions:
    """A saved result, and how it is read."""

    results: Annotated[Path, typer.Argument(metavar="RESULTS", help="Folder of a reconstruction.")]
    fps: Annotated[float | None, option(TIME, "Frames a second, in place of the result's own times.")] = None
    up: Annotated[
        str | None, option(INPUT, "Axis that points up, where cameras.json is not there.", metavar="AXIS")
    ] = None
    body: Annotated[Path | None, option(INPUT, "The body model of the result, where its file has moved.")] = None

    def how(self) -> dict[str, Any]:
        """How it is read, as keywords."""
        check_fps(self.fps)
        return {"fps": self.fps, "up": self.up}


@dataclass(frozen=True, kw_only=True)
class TakeOptions(ResultOptions):
    """A part of a saved result."""

    frames: FramesOption = None
    person: Annotated[list[int] | None, option(RESULT, "Only this person; may be given several times.")] = None
    seen_only: Annotated[
        bool, option(RESULT, "Leave out joints that no view saw in that frame.", "--seen-only")
    ] = False

    def how(self) -> dict[str, Any]:
        """How it is read, as keywords."""
        persons = tuple(self.person) if self.person else None
        return super().how() | {
            "seen_only": self.seen_only,
            "frames": result_frames(self.frames),
            "persons": persons,
        }


def check_fps(fps: float | None) -> None:
    """Refuse frames a second that make no sense."""
    if fps is not None and not 0.01 <= fps <= 1e5:
        raise InputError(f"--fps {fps:g}: must be a number of frames a second, such as 25")


def check_workers(workers: int | None) -> None:
    """Refuse a number of processes that makes no sense."""
    if workers is not None and not 1 <= workers <= 64:
        raise InputError(f"--workers {workers}: must be 1 to 64; leave it out for as many as pay")


def result_frames(text: str | None) -> range | None:
    """Frames that `A:B` selects of a saved result, whose last is not known yet; None where all are."""
    if text is None:
        return None
    start, stop = ends(text)
    stop = 10**18 if stop is None else stop
    if not start < stop:
        raise InputError(f"--frames {text}: must be A:B with A below B, such as 0:100")
    return range(start, stop)


def frame_range(text: str | None, count: int) -> range:
    """Frames that `A:B` selects of a recording of `count` frames: half-open, either end optional."""
    if text is None:
        return range(count)
    start, stop = ends(text)
    stop = count if stop is None else stop
    if not start < stop <= count:
        raise InputError(
            f"--frames {text}: not in the recording, which has {count} frames; give A:B with 0 <= A < B <= {count}"
        )
    return range(start, stop)


def ends(text: str) -> tuple[int, int | None]:
    """Both ends of `A:B`; the second is None where it is left out."""
    match = re.fullmatch(r"(\d{0,18}):(\d{0,18})", text.strip())
    if match is None:
        raise InputError(f"--frames {text}: must be A:B, two frame numbers with a colon between, such as 0:100")
    return int(match[1] or 0), int(match[2]) if match[2] else None
