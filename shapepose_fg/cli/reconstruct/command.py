"""`shapepose-fg reconstruct`: from the cameras and detections of a recording to a folder of results."""

from pathlib import Path
from typing import Annotated

import typer

from shapepose_fg.cli.options import (
    FramesOption,
    ImageSizeOption,
    SkeletonOption,
    UnitOption,
    UpOption,
    check_workers,
)
from shapepose_fg.cli.reconstruct.inputs import cuts_of
from shapepose_fg.cli.reconstruct.request import Request, carry_out
from shapepose_fg.core.errors import InputError


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
    check_workers(workers)
    if workers is not None and cluster not in (None, "local"):
        raise InputError(
            f"--workers and --cluster {cluster}: these are processes of this machine, or of the cluster; give one"
        )
    if resume and restart:
        raise InputError("--resume and --restart: a run goes on or begins anew; give one of them")
    request = Request(
        calibration=calibration,
        detections=detections,
        project=project,
        config=config,
        frames=frames,
        up=up,
        unit=unit,
        image_size=image_size,
        skeleton=skeleton,
        body=body,
        fps=fps,
        timestamps=timestamps,
        cuts=cuts_of(cuts),
        temporal=temporal,
        shapes=shapes,
        chunk_frames=chunk_frames,
        report=report,
        check=check,
    )
    carry_out(request, output, workers=workers, cluster=cluster, resume=resume, restart=restart)
