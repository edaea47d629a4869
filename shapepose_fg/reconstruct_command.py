"""`shapepose-fg reconstruct`: from the cameras and detections of a recording to a folder of results."""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

import typer

from shapepose_fg.errors import InputError
from shapepose_fg.options import (
    FramesOption,
    ImageSizeOption,
    SkeletonOption,
    UnitOption,
    UpOption,
    check_workers,
    frame_range,
    image_size_of,
)
from shapepose_fg.output_folder import only_run_in
from shapepose_fg.reconstruct_inputs import cuts_of, fitter_of, places, project_of, recording_folder, times_of
from shapepose_fg.result_files import OBSERVATIONS, PEOPLE, RUN
from shapepose_fg.terminal import note

if TYPE_CHECKING:
    from shapepose_fg.camera import Axis
    from shapepose_fg.io.calibration import Unit

_OUTPUTS = (PEOPLE, RUN, OBSERVATIONS, "cameras.json", "report.html")
"""The files that are left in the folder of results."""

# Everything else is imported inside the functions: `--help` must not wait for torch.


def reconstruct(
    calibration: Annotated[
        Path | None, typer.Option(help="Cameras: a file, or a folder, of one of the formats known.")
    ] = None,
    detections: Annotated[
        Path | None, typer.Option(help="Folder with what a 2D detector wrote of every camera.")
    ] = None,
    output: Annotated[
        Path | None, typer.Option(help="Folder for people.npz and run.json; made if it is not there.")
    ] = None,
    project: Annotated[
        Path | None,
        typer.Option(help="A Pose2Sim project instead: its cameras, detections, settings; adds TRC and C3D."),
    ] = None,
    config: Annotated[
        Path | None, typer.Option(help="Settings as TOML; `shapepose-fg config` prints all.")
    ] = None,
    frames: FramesOption = None,
    up: UpOption = None,
    unit: UnitOption = None,
    image_size: ImageSizeOption = None,
    skeleton: SkeletonOption = None,
    body: Annotated[
        Path | None, typer.Option(help="Body model in SMPL's file format, instead of the built-in.")
    ] = None,
    fps: Annotated[float | None, typer.Option(help="Frames a second; 30 are assumed otherwise.")] = None,
    timestamps: Annotated[
        Path | None, typer.Option(help="Text file with the time of every frame in seconds, also by camera.")
    ] = None,
    cuts: Annotated[
        str | None, typer.Option(metavar="A,B", help="First frames after a cut: nothing carries over to them.")
    ] = None,
    temporal: Annotated[
        bool | None, typer.Option("--temporal/--no-temporal", help="People over time, or every frame by itself.")
    ] = None,
    shapes: Annotated[
        Path | None, typer.Option(help="File (.npz) of people's shapes: read where it is there, kept up to date.")
    ] = None,
    workers: Annotated[
        int | None, typer.Option(help="Processes that solve; by default as many as pay. They change no byte.")
    ] = None,
    cluster: Annotated[
        str | None,
        typer.Option(metavar="ADDRESS", help="Dask scheduler (tcp://host:8786) whose processes solve, or: local."),
    ] = None,
    chunk_frames: Annotated[
        int | None, typer.Option(help="Follow people side by side, too, in chunks of about so many frames.")
    ] = None,
    report: Annotated[
        bool, typer.Option("--report/--no-report", help="Leave report.html, the result as a page to look at.")
    ] = True,
    check: Annotated[
        bool, typer.Option("--check/--no-check", help="Whether cameras and detections fit, and what is wrong.")
    ] = True,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on with the run that was stopped in --output.")
    ] = False,
    restart: Annotated[
        bool, typer.Option("--restart", help="Begin anew, whatever a run that was stopped left in --output.")
    ] = False,
) -> None:
    """Reconstruct the people of a recording: 3D joints with covariances, and bodies."""
    from shapepose_fg.io.calibration import read_rig
    from shapepose_fg.io.config import read_config
    from shapepose_fg.io.corrections import refuse_corrected
    from shapepose_fg.io.detections import read_detections
    from shapepose_fg.provenance import ReadInputs, checksums

    check_workers(workers)
    if resume and restart:
        raise InputError("--resume and --restart: a run goes on or begins anew; give one of them")
    whole = None if project is None else project_of(project)
    calibration, detections, output = places(calibration, detections, output, whole)
    if whole is not None and fps is None and timestamps is None:
        fps, timestamps = whole.fps, whole.times
    reading = ReadInputs((calibration, detections, config, body, timestamps))
    size = image_size_of(image_size)
    rig = read_rig(calibration, up=cast("Axis | None", up), unit=cast("Unit | None", unit), image_size=size)
    refuse_corrected(output)
    with only_run_in(output, _OUTPUTS), recording_folder(output) as kept:
        recording = read_detections(detections, rig, skeleton, kept)
        for each in recording.notes:
            note(each)
        span = frame_range(frames, len(recording))
        if whole is not None and frames is None:
            span = whole.span(len(recording))
        times = times_of(fps, timestamps, rig, len(recording))
        first_frames = cuts_of(cuts, len(recording))
        from shapepose_fg.pipeline import PipelineConfig
        from shapepose_fg.reconstruct_ending import Ending
        from shapepose_fg.reconstruct_run import Job, run_job

        settings = PipelineConfig() if config is None else read_config(config, PipelineConfig)
        settings = settings if temporal is None else replace(settings, temporal=temporal)
        if shapes is not None and not settings.temporal:
            raise InputError(
                "--shapes: a person's shape is known over time only; leave out --shapes or --no-temporal"
            )
        if chunk_frames is not None and not (settings.temporal and chunk_frames >= settings.batch_frames):
            raise InputError(
                f"--chunk-frames {chunk_frames}: must be {settings.batch_frames} (batch_frames) or more, and needs"
                " people over time"
            )
        if whole is not None and not settings.temporal:
            raise InputError("--project: its files need people over time; leave out --no-temporal, or --project")
        source = settings.offsets.source
        offsets = None if source in ("recording", "none") else Path(source)
        fitter = fitter_of(body, settings, recording.skeleton.joints)
        inputs = reading.checksums((calibration, *recording.sources, config, body, timestamps))
        inputs |= {} if offsets is None else checksums([offsets])
        del reading  # of half a million files it is large
        job = Job(rig, recording, settings, span, times, first_frames, body, fitter, shapes, inputs, chunk_frames)
        # Of its own detections `detect` knows which pictures they are of.
        own = (detections / "footage.json").is_file()
        videos = None if whole is None or own else whole.folder / "videos"
        ending = Ending(calibration, whole, videos, report=report, check=check)
        run_job(job, output, ending, workers=workers, cluster=cluster, resume=resume, restart=restart)
