"""`shapepose-fg reconstruct`: from the cameras and detections of a recording to a folder of results."""

import re
import time
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
from shapepose_fg.output_folder import prepare_output
from shapepose_fg.terminal import note, show
from shapepose_fg.terminal import progress as progress_bar

if TYPE_CHECKING:
    from rich.table import Table

    from shapepose_fg.body.fitting.fitter import BodyFitter
    from shapepose_fg.body.shapes import SubjectShapes
    from shapepose_fg.camera import Axis, Rig
    from shapepose_fg.frame_times import FrameTimes
    from shapepose_fg.io.calibration import Unit
    from shapepose_fg.io.detection_table import DetectionTable
    from shapepose_fg.io.pose2sim_project import Pose2SimProject
    from shapepose_fg.pipeline import PipelineConfig
    from shapepose_fg.reconstruction import Reconstruction
    from shapepose_fg.setup_check.in_result import ResultCheck

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
    report: Annotated[
        bool, typer.Option("--report/--no-report", help="Leave report.html, the result as a page to look at.")
    ] = True,
    check: Annotated[
        bool, typer.Option("--check/--no-check", help="Whether cameras and detections fit, and what is wrong.")
    ] = True,
) -> None:
    """Reconstruct the people of a recording: 3D joints with covariances, and bodies."""
    from shapepose_fg.io.calibration import read_rig, write_rig
    from shapepose_fg.io.config import read_config
    from shapepose_fg.io.corrections import refuse_corrected
    from shapepose_fg.io.detections import read_detections
    from shapepose_fg.io.solved_setup import CAMERAS
    from shapepose_fg.provenance import checksums
    from shapepose_fg.reconstruct_summary import show_check, summary_table

    check_workers(workers)
    whole = None if project is None else _project(project)
    calibration, detections, output = _places(calibration, detections, output, whole)
    size = image_size_of(image_size)
    rig = read_rig(calibration, up=cast("Axis | None", up), unit=cast("Unit | None", unit), image_size=size)
    recording = read_detections(detections, rig, skeleton)
    for each in recording.notes:
        note(each)
    span = frame_range(frames, len(recording))
    if whole is not None:
        span = span if frames is not None else whole.span(len(recording))
        if fps is None and timestamps is None:
            fps, timestamps = whole.fps, whole.times
    times = _times(fps, timestamps, rig, len(recording))
    first_frames = _cuts(cuts, len(recording))
    refuse_corrected(output)
    prepare_output(output)
    from shapepose_fg.pipeline import FRAMES_WORTH_A_WORKER, PipelineConfig
    from shapepose_fg.pipeline import reconstruct as run_pipeline
    from shapepose_fg.workers import suitable_workers

    settings = PipelineConfig() if config is None else read_config(config, PipelineConfig)
    settings = settings if temporal is None else replace(settings, temporal=temporal)
    if shapes is not None and not settings.temporal:
        raise InputError("--shapes: a person's shape is known over time only; leave out --shapes or --no-temporal")
    if whole is not None and not settings.temporal:
        raise InputError("--project: its files need people over time; leave out --no-temporal, or --project")
    fitter = _fitter(body, settings, recording.skeleton.joints)
    known = None if shapes is None else _known_shapes(shapes, body)
    start = time.perf_counter()
    with progress_bar("reconstructing") as progress:
        people = run_pipeline(
            recording,
            rig,
            settings,
            frames=span,
            fitter=fitter,
            times=times,
            cuts=first_frames,
            shapes=known,
            progress=progress,
            workers=suitable_workers(len(span), FRAMES_WORTH_A_WORKER) if workers is None else workers,
        )
    seconds = time.perf_counter() - start
    source = settings.offsets.source
    offsets = None if source in ("recording", "none") else Path(source)
    read = (calibration, *recording.sources, config, body, offsets, timestamps)
    inputs = [
        path for path in (*read, shapes if known is not None and len(known) > 0 else None) if path is not None
    ]
    people = people.with_run(inputs=checksums(inputs), notes=list(recording.notes), body=body)
    # Of its own detections `detect` knows which pictures they are of.
    own = (detections / "footage.json").is_file()
    videos = None if whole is None or own else whole.folder / "videos"
    checked = _checked(recording, rig, span, people, videos) if check else None
    people = people if checked is None else people.with_run(**checked.as_run())
    people.save(output)
    # What the observations were seen with: to solve or draw them anew.
    if not (output / CAMERAS).exists() or not (output / CAMERAS).samefile(calibration):
        write_rig(rig, output / CAMERAS)
    page = _report(people, rig, output) if report else _no_report(output)
    summary = summary_table(people, span, len(rig), seconds, output)
    if shapes is not None and known is not None and people.shapes is not None:
        known.updated(people.shapes).save(shapes)
        summary.add_row("", f"{shapes}  shapes of {len(people.shapes)} people")
    if page is not None:
        summary.add_row("", f"{page}  to look at, in a browser")
    if whole is not None:
        _add_project_files(summary, people, rig, whole)
    show(summary)
    if checked is not None:
        show_check(checked)


def _project(folder: Path) -> "Pose2SimProject":
    """The Pose2Sim project in a folder, and a note of what was taken to be what."""
    from shapepose_fg.io.pose2sim_project import read_pose2sim_project

    found = read_pose2sim_project(folder)
    for each in found.notes:
        note(each)
    return found


def _places(
    calibration: Path | None, detections: Path | None, output: Path | None, project: "Pose2SimProject | None"
) -> tuple[Path, Path, Path]:
    """Cameras, detections and the folder of results, as the options say, else the project."""
    if project is not None:
        return calibration or project.calibration, detections or project.detections, output or project.output
    options = {"--calibration": calibration, "--detections": detections, "--output": output}
    missing = [name for name, value in options.items() if value is None]
    if calibration is None or detections is None or output is None:
        listed = " and ".join([", ".join(missing[:-1]), missing[-1]] if len(missing) > 1 else missing)
        raise InputError(f"{listed}: missing; give them, or --project with the folder of a Pose2Sim project")
    return calibration, detections, output


def _add_project_files(summary: "Table", people: "Reconstruction", rig: "Rig", project: "Pose2SimProject") -> None:
    """Write TRC and C3D where Pose2Sim looks for them, and say so."""
    from shapepose_fg.export.pose2sim_files import write_pose2sim_files

    written = write_pose2sim_files(people, rig.up, project)
    for path in written.files:
        summary.add_row("", str(path))
    for each in written.notes:
        note(each)


def _times(fps: float | None, timestamps: Path | None, rig: "Rig", frames: int) -> "FrameTimes | None":
    """When the frames were taken, as the options say it; None where they do not."""
    from shapepose_fg.frame_times import FrameTimes
    from shapepose_fg.io.timestamps import read_timestamps

    if timestamps is not None:
        if fps is not None:
            raise InputError("--fps and --timestamps: both say when frames were taken; give one of them")
        return read_timestamps(timestamps, rig, frames)
    if fps is None:
        return None
    if not 0.01 <= fps <= 1e5:
        raise InputError(f"--fps {fps:g}: must be a number of frames a second, such as 25")
    return FrameTimes.from_fps(fps, frames)


def _cuts(text: str | None, count: int) -> tuple[int, ...]:
    """The frames that `A,B,...` names."""
    from shapepose_fg.frame_times import check_cuts

    if text is None:
        return ()
    words = re.split(r"[,\s]+", text.strip())
    try:
        return check_cuts([int(word) for word in words], count)
    except ValueError:
        raise InputError(
            f"--cuts {text}: must be rising frame numbers between 1 and {count - 1}, such as 300,600"
        ) from None


def _known_shapes(file: Path, body: Path | None) -> "SubjectShapes":
    """The people that `file` knows, on the body in use; nobody where there is no such file yet."""
    from shapepose_fg.body.fitting.weights import fingerprint
    from shapepose_fg.body.model.body_model import BodyModel
    from shapepose_fg.body.shapes import SubjectShapes

    whose = fingerprint(BodyModel.default() if body is None else BodyModel.load(body))
    if file.exists():
        return SubjectShapes.load(file, whose)
    prepare_output(file.parent)
    return SubjectShapes.empty(whose)


def _fitter(body: Path | None, settings: "PipelineConfig", joints: tuple[str, ...]) -> "BodyFitter | None":
    """The body fitter with the model of the file `body`; without one, the pipeline takes its own."""
    if body is None:
        return None
    from shapepose_fg.body.fitting.fitters import make_fitter
    from shapepose_fg.body.model.body_model import BodyModel

    return make_fitter(settings.body, BodyModel.load(body).with_keypoints(joints))


def _report(people: "Reconstruction", rig: "Rig", output: Path) -> Path:
    """The result as a page."""
    from shapepose_fg.report.writing import write_report

    return write_report(output, people, rig)


def _no_report(output: Path) -> None:
    """A page of an earlier result would say what is no longer true."""
    from shapepose_fg.report.writing import REPORT

    (output / REPORT).unlink(missing_ok=True)


def _checked(
    recording: "DetectionTable", rig: "Rig", span: range, people: "Reconstruction", videos: Path | None
) -> "ResultCheck":
    """Whether cameras, detections and, where there are any, videos fit."""
    from shapepose_fg.setup_check.diagnosis import diagnose
    from shapepose_fg.setup_check.in_result import result_check
    from shapepose_fg.setup_check.pictures import other_sizes
    from shapepose_fg.setup_check.report import report_of

    sizes = ()
    if videos is not None and videos.is_dir():
        try:
            sizes = other_sizes([str(videos)], rig)
        except InputError as error:  # the result does not need them
            note(f"{error}; their sizes are not checked")
    report = report_of(diagnose(recording, rig, span), rig, sizes)
    return result_check(report, people, recording, rig, span)
