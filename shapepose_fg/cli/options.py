"""Options that several commands share, in groups; parses ranges of frames, and sizes."""

import inspect
import re
import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, Field, dataclass, field, fields, is_dataclass, replace
from enum import StrEnum
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Self, cast, get_type_hints

import typer
from annotated_types import Interval

from shapepose_fg.cli.terminal import note, note_of_reading
from shapepose_fg.core.bounds import Axis, Unit, interval_of, violated
from shapepose_fg.core.errors import InputError, naming
from shapepose_fg.core.frame_times import LEAST_FPS, MOST_FPS
from shapepose_fg.core.storage.output_folder import prepare_output

if TYPE_CHECKING:
    from shapepose_fg.core.camera import Rig
    from shapepose_fg.core.frame_times import FrameTimes
    from shapepose_fg.io.detection_table import DetectionTable
    from shapepose_fg.io.detections.people import DeclaredJoints
    from shapepose_fg.io.pose2sim_project import Pose2SimProject
    from shapepose_fg.pipeline.config import PipelineConfig

INPUT, TIME, RESULT, RUN, DRAW = "Input", "Time", "Result", "Run", "Drawing"
"""Headings under which `--help` lists options."""
REQUIRED: Any = MISSING
"""Placeholder for the default of a required option."""
Hertz = Annotated[float, Interval(ge=LEAST_FPS, le=MOST_FPS)]
"""A frame rate, Hz."""
Workers = Annotated[int, Interval(ge=1, le=64)]
"""A number of processes, or of recordings at once."""
Stature = Annotated[float, Interval(ge=0.5, le=2.5)]
"""A stature of people, m."""


def option(group: str, text: str, default: Any = None, *names: str, **more: Any) -> Any:
    """Declare an option under the heading `group`, with its help text: used as the default of a
    parameter of a `grouped` command, or of a field.
    """
    shown = isinstance(default, str | int | float | Path) and not isinstance(default, bool)
    how: dict[str, Any] = {"show_default": shown, "help": text, "rich_help_panel": group}
    return field(default=default, metadata={"typer": typer.Option(*names, **how | more)})


def argument(metavar: str, text: str, default: Any = MISSING) -> Any:
    """Declare a positional argument of a command."""
    return field(default=default, metadata={"typer": typer.Argument(metavar=metavar, help=text)})


class Preset(StrEnum):
    """Named sets of settings (presets)."""

    ACCURATE = "accurate"
    FAST = "fast"
    PAPER = "paper"

    def settings(self) -> "PipelineConfig":
        """All settings of the preset."""
        from shapepose_fg.pipeline.config import PipelineConfig

        made = {
            Preset.ACCURATE: PipelineConfig,
            Preset.FAST: PipelineConfig.fast,
            Preset.PAPER: PipelineConfig.paper,
        }
        return made[self]()


def preset_option(default: Preset | None) -> Any:
    """The option `--preset`."""
    return option(
        RESULT,
        (
            "Settings: accurate (default); fast (solves about every third frame); paper (the "
            "method as published)."
        ),
        default,
    )


def grouped(command: Callable[..., Any]) -> Callable[..., Any]:
    """Convert `command` for typer: each field of a parameter that is a dataclass becomes an
    option. Values outside the bounds in an option's type (`Interval`) are refused.
    """
    hints, parameters = get_type_hints(command), list[inspect.Parameter]()
    taken: dict[str, list[str]] = {}
    bounds: dict[str, Interval | None] = {}

    def take(name: str, of: Any, given: Field[Any]) -> None:
        default = inspect.Parameter.empty if given.default is MISSING else given.default
        added = inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default)
        hint = Annotated[get_type_hints(of)[name], given.metadata["typer"]]
        parameters.append(added.replace(annotation=hint))
        bounds[name] = interval_of(get_type_hints(of, include_extras=True)[name])

    for name, parameter in inspect.signature(command).parameters.items():
        if is_dataclass(group := hints[name]):
            options = [each for each in fields(group) if "typer" in each.metadata]
            taken[name] = [each.name for each in options]
            for each in options:
                take(each.name, group, each)
        else:
            take(name, command, parameter.default)

    @wraps(command)
    def called(**given: Any) -> Any:
        for name, interval in bounds.items():
            value = given[name]
            if interval and value is not None and (problem := violated(interval, value)):
                raise InputError(f"--{name.replace('_', '-')} {value:g}: must {problem}")
        for name, keys in taken.items():
            given[name] = hints[name](**{key: given.pop(key) for key in keys})
        return command(**given)

    del called.__wrapped__
    cast(Any, called).__signature__ = inspect.Signature(parameters)
    called.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return flowing(called)


def flowing(command: Callable[..., Any]) -> Callable[..., Any]:
    """Join the lines of each paragraph of the docstring; otherwise `--help` would break lines where
    the source does, too.
    """
    command.__doc__ = re.sub(r"(?<=\S)\n(?=[^\s-])", " ", inspect.getdoc(command) or "")
    return command


def frames_option() -> Any:
    """The option for frames of a recording or of a result."""
    return option(TIME, "Range of frames, A to B-1; either may be left out.", metavar="A:B")


def workers_option() -> Any:
    """The option for the number of processes."""
    return option(
        RUN, "Number of processes; by default as many as are useful. Results do not depend on it."
    )


def json_option() -> Any:
    """The option for output as JSON."""
    return option(RESULT, "Print everything as JSON.", False, "--json")


@dataclass(frozen=True, kw_only=True)
class RunOptions:
    """Options of execution, and of interrupted runs."""

    workers: Workers | None = workers_option()
    cluster: str | None = option(
        RUN, "Dask scheduler for the solving (tcp://host:8786), or `local`.", metavar="ADDRESS"
    )
    resume: bool = option(RUN, "Continue the interrupted run in --output.", False, "--resume")
    restart: bool = option(
        RUN, "Start again, and delete the interrupted run in --output.", False, "--restart"
    )

    def check(self) -> None:
        """Raise InputError if options contradict each other."""
        if self.workers is not None and self.cluster not in (None, "local"):
            raise InputError(
                f"--workers and --cluster {self.cluster}: processes are either of this machine "
                "or of the cluster; give one of them"
            )
        if self.resume and self.restart:
            raise InputError(
                "--resume and --restart: a run is either continued or started again; give one of "
                "them"
            )


@dataclass(frozen=True, kw_only=True)
class CameraOptions:
    """The cameras of a recording."""

    calibration: Path | None = option(
        INPUT, "Calibration of the cameras: a file or folder in a known format."
    )
    up: Axis | None = option(
        INPUT, "World axis that points up: x, -x, y, -y, z or -z.", metavar="AXIS"
    )
    unit: Unit | None = option(INPUT, "Unit of the calibration: m, cm or mm.", metavar="UNIT")
    image_size: str | None = option(
        INPUT, "Size of the calibrated pictures, if the file does not contain it.", metavar="WxH"
    )
    cameras: str | None = option(INPUT, "Use only these cameras.", metavar="A,B")
    without: str | None = option(INPUT, "Leave out these cameras.", metavar="A,B")

    def rig(self) -> "Rig":
        """The cameras; InputError if they cannot be used."""
        from shapepose_fg.io.calibration import read_rig

        if self.calibration is None:
            raise InputError("--calibration: missing; give the calibration file or folder")
        size = picture_size(self.image_size)
        chosen = {"cameras": names_of(self.cameras), "without": names_of(self.without) or ()}
        found = read_rig(self.calibration, up=self.up, unit=self.unit, image_size=size, **chosen)
        note_of_reading(*found.notes)
        return found

    def calibration_options(self) -> dict[str, object]:
        """The options about the calibration, to be repeated in the next command."""
        names = ("up", "unit", "image_size", "cameras", "without")
        return {f"--{name.replace('_', '-')}": getattr(self, name) for name in names}


@dataclass(frozen=True, kw_only=True)
class SeenOptions:
    """2D detections of cameras."""

    detections: Path = option(INPUT, "Folder with the 2D detections of all cameras.", REQUIRED)
    skeleton: str | None = option(
        INPUT,
        "Keypoint layout of the detector: a name such as COCO_17, or a TOML file.",
        metavar="NAME",
    )


@dataclass(frozen=True, kw_only=True)
class DetectionOptions(CameraOptions, SeenOptions):
    """Cameras, and their 2D detections."""

    def rig(self) -> "Rig":
        """The cameras; InputError if they cannot be used, or if there are fewer than two."""
        found = super().rig()
        if len(found) < 2:
            raise InputError(f"{self.calibration}: at least 2 cameras are needed, got {len(found)}")
        return found

    def still_rig(self, what: str) -> "Rig":
        """The cameras, which must be fixed; InputError if one moves. `what` names the command or
        step that requires it.
        """
        found = self.rig()
        moving = next((camera.name for camera in found.cameras if camera.carrier), None)
        if moving is not None:
            cure = "leave it out with --without; reconstruct refines trajectories itself"
            raise InputError(
                f"{self.calibration}: camera {moving} moves, and {what} needs fixed cameras; {cure}"
            )
        return found


@dataclass(frozen=True, kw_only=True)
class Located(DetectionOptions):
    """Cameras and detections with known paths."""

    source: "Pose2SimProject | None" = None
    """The project to which they belong; None if there is none."""

    @property
    def joints(self) -> "str | DeclaredJoints | None":
        """The detector's joints as given by the user, otherwise by the project."""
        return self.skeleton or (None if self.source is None else self.source.joints)

    def rate(self, given: "RateOptions") -> "RateOptions":
        """Times of frames as given by the user, otherwise by the project."""
        if self.source is None or given.fps is not None or given.timestamps is not None:
            return given
        return replace(given, fps=self.source.fps)

    def given(self) -> dict[str, object]:
        """Options to be repeated in the next command for the same detections and joints, without
        the calibration.
        """
        if self.source is None:
            return {"--detections": self.detections, "--skeleton": self.skeleton}
        return {"--project": self.source.folder, "--skeleton": self.skeleton}


@dataclass(frozen=True, kw_only=True)
class ProjectOptions(DetectionOptions):
    """Cameras and their 2D detections, each given or from a Pose2Sim project."""

    detections: Path | None = option(INPUT, "Folder with the 2D detections of all cameras.")
    project: Path | None = option(
        INPUT, "Pose2Sim project: use its cameras, detections and frame rate."
    )

    def completed(
        self, notify: Callable[..., None] = note
    ) -> "tuple[Self, Pose2SimProject | None]":
        """The options with the missing paths filled in from the project, and the project; `notify`
        receives its notes.
        """
        if self.project is None:
            return self, None
        from shapepose_fg.io.pose2sim_project import read_pose2sim_project

        source = read_pose2sim_project(self.project)
        notify(*source.notes)
        calibration, detections = (
            self.calibration or source.calibration,
            self.detections or source.detections,
        )
        return replace(self, calibration=calibration, detections=detections), source

    def located(self) -> Located:
        """The options with known paths; InputError if one is missing."""
        whole, source = self.completed()
        refuse_missing({"--calibration": whole.calibration, "--detections": whole.detections})
        given = {each.name: getattr(whole, each.name) for each in fields(DetectionOptions)}
        return Located(**given, source=source)


@dataclass(frozen=True, kw_only=True)
class TimeOptions:
    """Options about the times of frames."""

    fps: Hertz | None = option(TIME, "Frame rate, Hz; by default that of times.csv, else 30.")
    timestamps: Path | None = option(
        TIME,
        "File with the time of every frame, seconds; by default times.csv beside the detections.",
    )

    def read(
        self,
        detections: Path,
        skeleton: "str | DeclaredJoints | None",
        rig: "Rig",
        kept: Path,
        own_frames: bool = False,
    ) -> "tuple[DetectionTable, FrameTimes | None]":
        """The recording, and the times of its frames, None if unknown (`read_recording`); notes are
        printed.
        """
        from shapepose_fg.io.recording import read_recording

        recording, times = read_recording(
            detections, rig, skeleton, kept, self.fps, self.timestamps, own_frames=own_frames
        )
        note_of_reading(*recording.notes)
        return recording, times


@dataclass(frozen=True, kw_only=True)
class RateOptions(TimeOptions):
    """Options about the times of frames, and about which frames are used."""

    frames: str | None = frames_option()

    def part(
        self,
        detections: Path,
        skeleton: "str | DeclaredJoints | None",
        rig: "Rig",
        kept: Path,
        own_frames: bool = False,
    ) -> "tuple[DetectionTable, FrameTimes, range]":
        """The recording, its times (30 frames a second if unknown), and the frames to use."""
        from shapepose_fg.core.frame_times import FrameTimes

        recording, times = self.read(detections, skeleton, rig, kept, own_frames)
        count = len(recording)
        span = frame_range(self.frames, count, recording.first)
        return recording, FrameTimes.assumed(count) if times is None else times, span

    def given(self) -> dict[str, object]:
        """Options to be repeated in the next command for the same times and frames."""
        return {"--fps": self.fps, "--timestamps": self.timestamps, "--frames": self.frames}


@dataclass(frozen=True, kw_only=True)
class ResultOptions:
    """Options: a saved result, and how it is read."""

    results: Path = argument("RESULTS", "Folder of a reconstruction.")
    fps: Hertz | None = option(TIME, "Frame rate, Hz, instead of the result's own times.")
    up: Axis | None = option(
        INPUT, "World axis that points up, if cameras.json is missing.", metavar="AXIS"
    )
    body: Path | None = option(INPUT, "Body model of the result, if its file has moved.")

    def how(self) -> dict[str, Any]:
        """Keyword arguments of the functions that read it."""
        return {"fps": self.fps, "up": self.up}


@dataclass(frozen=True, kw_only=True)
class TakeOptions(ResultOptions):
    """Options: a part of a saved result."""

    frames: str | None = frames_option()
    person: list[int] | None = option(RESULT, "Use only this person; may be repeated.")
    seen_only: bool = option(
        RESULT, "Leave out joints without a detection in that frame.", False, "--seen-only"
    )

    def how(self) -> dict[str, Any]:
        """Keyword arguments of the functions that read it."""
        persons, frames = tuple(self.person) if self.person else None, result_frames(self.frames)
        return super().how() | {"seen_only": self.seen_only, "frames": frames, "persons": persons}


def next_reconstruct(options: Mapping[str, object]) -> str:
    """A command line to copy: `reconstruct` with those `options` that have values."""
    words = [
        word
        for name, value in options.items()
        if value is not None
        for word in (name, f"{value:g}" if isinstance(value, float) else str(value))
    ]
    return f"next: {shlex.join(['shapepose-fg', 'reconstruct', *words])}"


def check_output_files(files: Mapping[str, Path | None]) -> None:
    """Raise InputError, before long work, if one of the output files, by option, is a folder, is in
    a folder where nothing can be written, or is that of another option, too.
    """
    given = {option: file for option, file in files.items() if file is not None}
    for option, file in given.items():
        if file.is_dir():
            raise InputError(f"{option} {file}: this is a folder; give the name of a file")
        if file.parent.is_dir():
            prepare_output(file.parent)
        for other, same in given.items():
            if other != option and same.resolve() == file.resolve():
                raise InputError(f"{option} and {other} {file}: this is one file; give two")


def refuse_missing(places: Mapping[str, Path | None]) -> None:
    """Raise InputError if one of the options, by name, has no value from the user or from a
    project.
    """
    missing = [name for name, place in places.items() if place is None]
    if missing:
        listed = " and ".join(
            [", ".join(missing[:-1]), missing[-1]] if len(missing) > 1 else missing
        )
        them = "it" if len(missing) == 1 else "them"
        raise InputError(
            f"{listed}: missing; give {them}, or --project with the folder of a Pose2Sim project"
        )


def chosen_cameras(names: Sequence[str], cameras: str | None, without: str | None) -> list[str]:
    """The camera names among `names` that the options --cameras and --without choose."""
    from shapepose_fg.core.camera import choose

    with naming("--cameras, --without"):
        return choose(names, names_of(cameras), names_of(without) or ())


def names_of(text: str | None) -> list[str] | None:
    """Names of cameras, separated by commas; None if no text is given."""
    return None if text is None else [name.strip() for name in text.split(",") if name.strip()]


def picture_size(text: str | None) -> tuple[int, int] | None:
    """Width and height of `WIDTHxHEIGHT`; None if no text is given."""
    if text is None:
        return None
    match = re.fullmatch(r"\s*(\d{1,9})\s*[x×,]\s*(\d{1,9})\s*", text)
    if match is None:
        raise InputError(f"--image-size {text}: must be WIDTHxHEIGHT in pixels, such as 1920x1080")
    return int(match[1]), int(match[2])


def result_frames(text: str | None) -> range | None:
    """Frames selected by `A:B` from a saved result with an unknown last frame; None for all."""
    if text is None:
        return None
    start, stop = ends(text)
    found = range(start, 10**18 if stop is None else stop)
    if len(found) == 0:
        raise InputError(f"--frames {text}: must be A:B with A below B, such as 0:100")
    return found


def frame_range(text: str | None, count: int, first: int = 0) -> range:
    """Frames selected by `A:B` from a recording of `count` frames: half-open, either end may be
    left out. For None, all frames from `first` on.
    """
    start, stop = (first, count) if text is None else ends(text)
    found = range(start, count if stop is None else stop)
    if text is not None and not (found and found.stop <= count):
        raise InputError(
            f"--frames {text}: not in the recording, which has {count} frames; give A:B with 0 "
            f"<= A < B <= {count}"
        )
    return found


def ends(text: str) -> tuple[int, int | None]:
    """Both ends of `A:B`; the second is None if it is left out."""
    match = re.fullmatch(r"(\d{0,18}):(\d{0,18})", text.strip())
    if match is None:
        raise InputError(f"--frames {text}: must be A:B with two frame numbers, such as 0:100")
    return int(match[1] or 0), int(match[2]) if match[2] else None
