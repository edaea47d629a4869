"""The command line: reconstruct a recording, evaluate a reconstruction, see a demo."""

import json
import os
import re
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast

import typer

from shapepose_fg.detect_command import detect
from shapepose_fg.errors import InputError
from shapepose_fg.export_command import export
from shapepose_fg.options import (
    FramesOption,
    ImageSizeOption,
    SkeletonOption,
    UnitOption,
    UpOption,
    frame_range,
    image_size_of,
)
from shapepose_fg.overlay_command import overlay
from shapepose_fg.report_command import report as report_command
from shapepose_fg.setup_command import check_calibration
from shapepose_fg.terminal import note, show, use_any_streams, warn
from shapepose_fg.terminal import progress as progress_bar
from shapepose_fg.tracks_command import tracks
from shapepose_fg.view_command import view

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
    from shapepose_fg.simulation.files import Format

# Everything else is imported inside the commands: `--help` must not wait for torch.

app = typer.Typer(
    name="shapepose-fg",
    help="Every person in the room in 3D, with a body, from several calibrated cameras.",
    add_completion=False,
    pretty_exceptions_enable=False,
)
evaluate = typer.Typer(help="Score a reconstruction against an annotation.")
app.add_typer(evaluate, name="evaluate")
app.add_typer(tracks, name="tracks")
app.command()(detect)
app.command("check-calibration")(check_calibration)
app.command()(overlay)
app.command()(export)
app.command("report")(report_command)
app.command()(view)

_UsageProblem = cast("type[Exception]", typer.BadParameter.__mro__[2])
"""What typer raises for a wrong command line; older and newer versions keep the class in different places."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line. An error is one sentence on stderr and exit code 2."""
    use_any_streams()
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    try:
        code = app(arguments or ["--help"], standalone_mode=False)
        sys.stdout.flush()
    except _UsageProblem as error:
        code = _fail(f"{cast(Any, error).format_message().rstrip('.')}; see shapepose-fg --help")
    except InputError as error:
        code = _fail(str(error))
    except BrokenPipeError:  # the reader of our output, such as `head`, has had enough
        # Or Python would complain at exit that it cannot flush.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = 1
    except OSError as error:
        place = f"{error.filename}: " if error.filename is not None else ""
        code = _fail(f"{place}{error.strerror or error}; check the path, its permissions and the space left")
    except (typer.Abort, KeyboardInterrupt):
        code = 130
    sys.exit(code if isinstance(code, int) else 0)


@app.command()
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

    _check_workers(workers)
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
    _prepare(output)
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
    summary = _summary(people, span, len(rig), seconds, output)
    if shapes is not None and known is not None and people.shapes is not None:
        known.updated(people.shapes).save(shapes)
        summary.add_row("", f"{shapes}  shapes of {len(people.shapes)} people")
    if page is not None:
        summary.add_row("", f"{page}  to look at, in a browser")
    if whole is not None:
        _add_project_files(summary, people, rig, whole)
    show(summary)
    if checked is not None:
        _show_check(checked)


@evaluate.command("shelf")
def evaluate_shelf_command(
    people: Annotated[
        Path, typer.Option(help="people.npz, or its folder; 4D Association's text; TRC, or a folder of it.")
    ],
    ground_truth: Annotated[Path, typer.Option(help="Annotation of the Shelf recording, as text.")],
    as_json: Annotated[bool, typer.Option("--json", help="Print the figures as JSON.")] = False,
) -> None:
    """PCP per limb and actor, MPJPE and recall on the Shelf recording."""
    from shapepose_fg.evaluation.other_results.reading import read_people
    from shapepose_fg.evaluation.shelf import evaluate_shelf, read_shelf_ground_truth

    score = evaluate_shelf(read_people(people), read_shelf_ground_truth(ground_truth))
    if as_json:
        print(json.dumps(score.as_dict(), indent=2, allow_nan=False))
    else:
        show(score.table())


_DEMO = """\
Built-in scene: 4 people in close motion, 6 cameras, 60 frames. A simulated
detector sees them with noise, misses, false candidates and occlusion; from what
it saw the people are reconstructed, over time."""


@app.command()
def demo(
    output: Annotated[Path, typer.Option(help="Folder for the result and the picture.")] = Path("demo"),
    report: Annotated[
        bool, typer.Option("--report/--no-report", help="Leave report.html, the result as a page to look at.")
    ] = True,
) -> None:
    """Reconstruct a built-in scene of four people, compare it with the truth, and draw it."""
    _prepare(output)
    print(_DEMO, flush=True)
    from shapepose_fg.demo import run_demo

    with progress_bar("reconstructing") as progress:
        result = run_demo(progress)
    show(result.tables())
    print()
    for line in result.save(output, report=report):
        print(line)


@app.command()
def simulate(
    name: Annotated[str, typer.Argument(help="demo, or an interaction sequence: salsa, crossing or crowd.")],
    output: Annotated[Path, typer.Option(help="Folder for cameras, detections and truth.")],
    split: Annotated[str, typer.Option(help="Takes of a sequence: tune, to choose settings by; report.")] = "tune",
    frames: FramesOption = None,
    cameras: Annotated[int, typer.Option(help="Cameras around the room, 2 to 12.")] = 6,
    people: Annotated[int | None, typer.Option(help="People in demo, 0 to 12; a sequence has its own.")] = None,
    seed: Annotated[int, typer.Option(help="Fixes the detector's errors, and the people of demo.")] = 0,
    mocap: Annotated[Path | None, typer.Option(help="Recorded motions (.npz) that sequences are made of.")] = None,
    format: Annotated[str, typer.Option(help="Detections as association (4D Association) or openpose.")] = (
        "association"
    ),
    workers: Annotated[
        int | None, typer.Option(help="Processes that look at the frames; by default one a core. No byte changes.")
    ] = None,
) -> None:
    """Simulate a recording with known truth: cameras, 2D detections, and people.npz to compare with."""
    if format not in ("association", "openpose"):
        raise InputError(f"--format {format}: must be association or openpose")
    if seed < 0:
        raise InputError(f"--seed {seed}: must be 0 or more")
    _check_workers(workers)
    _prepare(output)
    from shapepose_fg.simulation import DetectorConfig
    from shapepose_fg.simulation import simulate as run_detector
    from shapepose_fg.simulation.files import check_output, cut, cuts_of, named_scene, write_simulated
    from shapepose_fg.simulation.lookout import FRAMES_WORTH_A_WORKER
    from shapepose_fg.workers import suitable_workers

    last = re.search(r":\s*(\d{1,6})\s*$", frames or "")
    scene = named_scene(
        name,
        split=split,
        cameras=cameras,
        people=people,
        frames=int(last[1]) if last is not None else 0,
        seed=seed,
        mocap=mocap,
    )
    span = frame_range(frames, len(scene))
    part = cut(scene, span)
    check_output(part, output, cast("Format", format))
    workers = suitable_workers(len(span), FRAMES_WORTH_A_WORKER) if workers is None else workers
    start = time.perf_counter()
    with progress_bar("simulating") as progress:
        detections = run_detector(part, DetectorConfig(), seed, workers=workers, progress=progress)
    seconds = time.perf_counter() - start
    about = {"name": name, "seed": seed, "first_frame": span.start, "detector": DetectorConfig().as_dict()}
    about |= {} if name == "demo" else {"split": split}
    written = write_simulated(part, detections, output, cast("Format", format), **about)
    print(
        f"{len(span)} frames of {scene.people} people before {cameras} cameras,"
        f" {1e3 * seconds / len(span):.0f} ms a frame"
    )
    for what, path in written.items():
        print(f"{what:<12}{path}")
    timing = f"--fps {part.fps:g}" + (f" --cuts {','.join(map(str, cuts_of(part)))}" if cuts_of(part) else "")
    print(
        f"try: shapepose-fg reconstruct --calibration {written['cameras']} --detections {written['detections']}"
        f" {timing} --output {output / 'results'}"
    )


class Preset(StrEnum):
    """Settings that hang together."""

    DEFAULT = "default"
    PAPER = "paper"


@app.command("config")
def print_config(
    preset: Annotated[
        Preset,
        typer.Option(help="paper: the method as it is written, without what is settled differently here."),
    ] = Preset.DEFAULT,
) -> None:
    """Print every setting with its value, as TOML."""
    from shapepose_fg.io.config import toml_text
    from shapepose_fg.pipeline import PipelineConfig

    print(toml_text(PipelineConfig.paper() if preset is Preset.PAPER else PipelineConfig()), end="")


@app.command()
def version() -> None:
    """Print the versions of this program and of what it stands on."""
    from shapepose_fg.provenance import versions

    for name, number in versions().items():
        print(name, number)


def _check_workers(workers: int | None) -> None:
    if workers is not None and not 1 <= workers <= 64:
        raise InputError(f"--workers {workers}: must be 1 to 64; leave it out for as many as pay")


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
    _prepare(file.parent)
    return SubjectShapes.empty(whose)


def _prepare(output: Path) -> None:
    """Make the output folder and try it, before the long work and not after."""
    from shapepose_fg.files import write_atomically

    try:
        trial = output / ".trial"
        write_atomically(trial, lambda stream: stream.write(b""))
        trial.unlink()
    except OSError as error:
        raise InputError(
            f"{output}: results cannot be written here ({error.strerror}); give a folder that can be written"
        ) from None


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


def _summary(people: "Reconstruction", span: range, camera_count: int, seconds: float, output: Path) -> "Table":
    """What was reconstructed, how well it went, how long it took, and where it is."""
    import numpy as np
    from rich.table import Table

    from shapepose_fg.frame_times import rate_words
    from shapepose_fg.io.solved_setup import CAMERAS

    per_frame = np.bincount(people.frame - span.start, minlength=len(span))
    table = Table(show_header=False, box=None, padding=(0, 2, 0, 0))
    table.add_column(style="bold")
    table.add_column(overflow="fold")
    table.add_row(
        "frames", f"{len(span)} ({span.start}:{span.stop}) of {camera_count} cameras{rate_words(people.run)}"
    )
    over_time = people.run.get("configuration", {}).get("temporal", False)
    count = f"{len(np.unique(people.person))} people over time" if over_time else "no identities"
    table.add_row("people", f"{count}, {per_frame.mean():.1f} a frame ({per_frame.min()} to {per_frame.max()})")
    table.add_row("rows", f"{len(people)} in all")
    for status, count in zip(*np.unique(people.status, return_counts=True), strict=True):
        table.add_row("", f"{count} {status}", style="green" if status == "ok" else "yellow")
    for reason, count in people.run.get("people", {}).get("dropped", {}).items():
        where = _frames_words(people.run.get("dropped_frames", {}).get(reason, []))
        table.add_row("", f"{count} dropped: {reason}{where}", style="dim")
    if len(people) > 0:
        table.add_row("joints", _joints(people))
    # Loading torch and the body takes a second or two, once; it says nothing about the time of a frame.
    stages = {name: spent for name, spent in people.run.get("seconds", {}).items() if name != "load"}
    per_stage = "  ".join(f"{name} {1e3 * spent / len(span):.1f}" for name, spent in stages.items())
    table.add_row("time", f"{1e3 * sum(stages.values()) / len(span):.1f} ms a frame, {seconds:.1f} s in all")
    table.add_row("", per_stage, style="dim")
    table.add_row("written", str(output / "people.npz"))
    table.add_row("", str(output / "run.json"))
    if people.observations is not None:
        table.add_row("", str(output / "observations.npz"))
    table.add_row("", str(output / CAMERAS))
    return table


def _frames_words(spans: list[list[int]]) -> str:
    """In which frames, as far as there is room: run.json has all."""
    told = [f"{start}" if stop == start + 1 else f"{start}-{stop - 1}" for start, stop in spans[:4]]
    more = " ..." if len(spans) > len(told) else ""
    return f" (frames {' '.join(told)}{more})" if told else ""


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


def _show_check(checked: "ResultCheck") -> None:
    """How far each camera is from the result, and on stderr what looks wrong."""
    from shapepose_fg.setup_check.camera_use import use_table

    if len(checked.cameras) > 0:
        print()
        show(use_table(checked.cameras))
        show("[dim]error: median / 90 % of all detections given to people, before gates; used: after;[/]")
        show("[dim]left out: median, from where the other cameras alone put the joint[/]")
    for each in checked.warnings:
        warn(each)


def _joints(people: "Reconstruction") -> str:
    """How the joints are known, as shares, and how sure they are, as words."""
    import numpy as np

    count = people.count_known()
    words = {"seen": "seen", "body": "inferred from the body", "motion": "carried by motion", "unknown": "unknown"}
    total = max(sum(count.values()), 1)
    shares = ", ".join(f"{100 * count[how] / total:.1f} % {word}" for how, word in words.items() if count[how] > 0)
    variance = np.trace(people.covariance, axis1=-2, axis2=-1) / 3
    variance = variance[np.isfinite(variance) & (variance >= 0)]
    sigma = f"; median sigma {1e3 * np.sqrt(np.median(variance)):.0f} mm" if len(variance) > 0 else ""
    return shares + sigma


def _fail(message: str) -> int:
    """Say what went wrong, in one line on stderr."""
    from rich.console import Console
    from rich.text import Text

    line = Text.assemble(("error: ", "bold red"), " ".join(message.split()))
    Console(stderr=True).print(line, soft_wrap=True)
    return 2


if __name__ == "__main__":
    main()
