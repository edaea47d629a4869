"""The options of a reconstruction, from the command line or a table of recordings."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, cast

from shapepose_fg.cli.options import (
    INPUT,
    RESULT,
    RUN,
    TIME,
    Preset,
    ProjectOptions,
    TimeOptions,
    ends,
    frame_range,
    frames_option,
    option,
    preset_option,
    refuse_missing,
)
from shapepose_fg.cli.terminal import note
from shapepose_fg.core.errors import InputError, naming
from shapepose_fg.core.result_files import CLOCKS, MOMENTS, OBSERVATIONS, PEOPLE
from shapepose_fg.core.result_files import RUN as RUN_FILE

if TYPE_CHECKING:
    from shapepose_fg.core.camera import Rig
    from shapepose_fg.io.detections.people import DeclaredJoints
    from shapepose_fg.io.pose2sim_project import Pose2SimProject
    from shapepose_fg.pipeline.config import PipelineConfig

OUTPUTS = (
    PEOPLE,
    RUN_FILE,
    OBSERVATIONS,
    "cameras.json",
    "footage.json",
    MOMENTS,
    CLOCKS,
    "report.html",
)
"""The files of a results folder."""


@dataclass(frozen=True, kw_only=True)
class Request(ProjectOptions, TimeOptions):
    """The options of `shapepose-fg reconstruct` for one recording, by their names."""

    project: Path | None = option(
        INPUT, "Pose2Sim project: use its cameras, detections and settings; also write TRC and C3D."
    )
    preset: Preset | None = preset_option(None)
    config: Path | None = option(
        RESULT, "File of settings, TOML: all or some of those that `shapepose-fg config` prints."
    )
    frames: str | None = frames_option()
    body: Path | None = option(
        INPUT, "Body model in SMPL's file format, instead of the built-in one."
    )
    trajectory: list[str] | None = option(
        INPUT, "Poses of a moving camera, TUM or CSV; may be repeated.", metavar="CAMERA=FILE"
    )
    synchronise: bool = option(
        TIME, "Estimate the start times of unsynchronised cameras from the people.", False
    )
    readout: float | None = option(
        TIME, "Readout time of rolling shutters, first to last row, seconds."
    )
    cuts: tuple[int, ...] = ()
    """First frames after a cut."""
    temporal: bool | None = option(
        TIME, "Solve people over time, or frame by frame.", None, "--temporal/--no-temporal"
    )
    shapes: Path | None = option(
        RESULT, "File (.npz) of people's body shapes; read if it exists, and updated."
    )
    chunk_frames: int | None = option(
        RUN, "Track people in parallel, too, in chunks of about this many frames."
    )
    report: bool = option(
        RESULT, "Write report.html, a page for the browser.", True, "--report/--no-report"
    )
    check: bool = option(
        RESULT, "Check whether cameras and detections fit.", True, "--check/--no-check"
    )

    def rig(self) -> "Rig":
        """The cameras; the option `readout` applies to rolling shutters that the calibration does
        not define.
        """
        from shapepose_fg.core.camera import LONGEST_READOUT_S

        found = super().rig()
        if self.trajectory:
            from shapepose_fg.io.calibration import with_trajectories

            found = with_trajectories(found, self.trajectory)
        if self.readout is None:
            return found
        if not 0 <= self.readout <= LONGEST_READOUT_S:
            most = f"0 to {LONGEST_READOUT_S:g} seconds, such as 0.02"
            raise InputError(f"--readout {self.readout:g}: must be {most}")
        cameras = (
            replace(each, readout_s=each.readout_s or self.readout) for each in found.cameras
        )
        return replace(found, cameras=tuple(cameras))


@dataclass(frozen=True)
class Prepared:
    """A request with known paths and valid options."""

    request: Request
    """The request; cameras, detections and times are those of the project if there is one."""
    project: "Pose2SimProject | None"
    """The project to which the request belongs; None if there is none."""
    calibration: Path
    """Path of the calibration."""
    detections: Path
    """The folder of detections."""
    output: Path
    """The folder of results."""

    @property
    def skeleton(self) -> "str | DeclaredJoints | None":
        """The detector's joints as given by the user, otherwise by the project."""
        declared = None if self.project is None else self.project.joints
        return self.request.skeleton or declared

    def settings(self) -> "PipelineConfig":
        """The settings; InputError if they contradict other options."""
        from shapepose_fg.io.config import read_config
        from shapepose_fg.pipeline.config import PipelineConfig

        request = self.request
        if request.config is not None and request.preset is not None:
            cure = (
                f"`shapepose-fg config --preset {request.preset}` writes its settings into a file "
                "to edit"
            )
            raise InputError(
                f"--preset {request.preset} and --config {request.config}: settings come from one "
                f"of them; {cure}"
            )
        preset = Preset.ACCURATE if request.preset is None else request.preset
        found = (
            preset.settings()
            if request.config is None
            else read_config(request.config, PipelineConfig)
        )
        found = found if request.temporal is None else replace(found, temporal=request.temporal)
        if request.shapes is not None and not found.temporal:
            raise InputError(
                "--shapes: shapes need people over time; leave out --no-temporal, or --shapes"
            )
        if request.chunk_frames is not None and not (
            found.temporal and request.chunk_frames >= found.batch_frames
        ):
            raise InputError(
                f"--chunk-frames {request.chunk_frames}: must be {found.batch_frames} "
                "(batch_frames) or more, and people over time are needed"
            )
        if self.project is not None and not found.temporal:
            raise InputError(
                "--project: its files need people over time; leave out --no-temporal, or --project"
            )
        return found

    def span(self, count: int, first: int = 0) -> range:
        """The wanted frames of a recording of `count` frames, in which no one is detected before
        frame `first`.
        """
        if self.project is not None and self.request.frames is None:
            return self.project.span(count)
        return frame_range(self.request.frames, count, first)

    def cuts(self, count: int) -> tuple[int, ...]:
        """The cuts; InputError if they are invalid for a recording of `count` frames."""
        from shapepose_fg.core.frame_times import check_cuts

        words = f"must be increasing frame numbers between 1 and {count - 1}, such as 300,600"
        with naming(f"--cuts {','.join(map(str, self.request.cuts))}", words=words):
            return check_cuts(self.request.cuts, count)


def prepare(request: Request, output: Path | None, notify: Callable[..., None] = note) -> Prepared:
    """Find a request's paths, and check its options, before any large file is read.

    `notify` receives notes on how a project's files were interpreted. InputError if something is
    missing or wrong.
    """
    from shapepose_fg.io.recording import times_beside

    request, project = request.completed(notify)
    if project is not None:
        output = output or project.output
        if request.fps is None and request.timestamps is None:
            request = replace(request, fps=project.fps)
    places = {
        "--calibration": request.calibration,
        "--detections": request.detections,
        "--output": output,
    }
    refuse_missing(places)
    calibration, detections, output = (cast(Path, place) for place in places.values())
    if request.synchronise and request.timestamps is not None:
        raise InputError(
            "--synchronise and --timestamps: times are either estimated or given; give one of them"
        )
    request = replace(request, timestamps=times_beside(detections, request.fps, request.timestamps))
    if request.synchronise and request.fps is None and request.timestamps is None:
        raise InputError("--fps: missing; give the frame rate of the cameras")
    if request.frames is not None:
        ends(request.frames)
    return Prepared(request, project, calibration, detections, output)
