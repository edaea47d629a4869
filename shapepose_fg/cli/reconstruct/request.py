"""What a reconstruction is asked for, by the command line or in a table of recordings, and its carrying out."""

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, cast

from shapepose_fg.cli.options import check_fps, frame_range, image_size_of, refuse_no_range
from shapepose_fg.cli.reconstruct.inputs import (
    fitter_of,
    places,
    possible_cuts,
    project_of,
    recording_folder,
    times_of,
)
from shapepose_fg.cli.terminal import note, progress
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.result_files import OBSERVATIONS, PEOPLE, RUN
from shapepose_fg.core.storage.output_folder import only_run_in

if TYPE_CHECKING:
    from shapepose_fg.cli.reconstruct.outcome import Ended
    from shapepose_fg.core.camera import Axis, Rig
    from shapepose_fg.io.calibration import Unit
    from shapepose_fg.io.pose2sim_project import Pose2SimProject
    from shapepose_fg.pipeline.config import PipelineConfig

OUTPUTS = (PEOPLE, RUN, OBSERVATIONS, "cameras.json", "report.html")
"""The files that are left in the folder of results."""
_FRAMES_WORTH_A_WORKER = 100
"""A recording must have this many for each worker: a window is a hundred, and it is what is handed out."""

# Everything else is imported inside the functions: `--help` must not wait for torch.


@dataclass(frozen=True)
class Request:
    """One recording, and what is wanted of it: the options of `shapepose-fg reconstruct`, by their names."""

    calibration: Path | None = None
    """Cameras: a file, or a folder, of one of the formats known."""
    detections: Path | None = None
    """Folder with what a 2D detector wrote of every camera."""
    project: Path | None = None
    """A Pose2Sim project instead: its cameras, detections, settings; adds TRC and C3D."""
    config: Path | None = None
    """Settings as TOML."""
    frames: str | None = None
    """Frames A to B-1 of `A:B`; either may be left out."""
    up: str | None = None
    """World axis that points up."""
    unit: str | None = None
    """Unit of the calibration."""
    image_size: str | None = None
    """Size of the calibrated pictures, `WxH`, where the file has none."""
    skeleton: str | None = None
    """The detector's skeleton, or a TOML file that describes it."""
    body: Path | None = None
    """Body model in SMPL's file format, instead of the built-in."""
    fps: float | None = None
    """Frames a second."""
    timestamps: Path | None = None
    """Text file with the time of every frame in seconds."""
    cuts: tuple[int, ...] = ()
    """First frames after a cut."""
    temporal: bool | None = None
    """People over time, or every frame by itself; None for what the settings say."""
    shapes: Path | None = None
    """File (.npz) of people's shapes."""
    chunk_frames: int | None = None
    """Follow people side by side, too, in chunks of about so many frames."""
    report: bool = True
    """Leave report.html."""
    check: bool = True
    """Whether cameras and detections fit."""


@dataclass(frozen=True)
class Prepared:
    """A request whose places are known, and whose options are sound."""

    request: Request
    """What is asked for."""
    project: "Pose2SimProject | None"
    """The project that it is of."""
    calibration: Path
    """The cameras' file."""
    detections: Path
    """The folder of detections."""
    output: Path
    """The folder of results."""
    fps: float | None
    """Frames a second, where that is said."""
    timestamps: Path | None
    """File of times."""

    def rig(self) -> "Rig":
        """The cameras; InputError where they cannot be used."""
        from shapepose_fg.io.calibration import read_rig

        asked = self.request
        size = image_size_of(asked.image_size)
        up, unit = cast("Axis | None", asked.up), cast("Unit | None", asked.unit)
        return read_rig(self.calibration, up=up, unit=unit, image_size=size)

    @property
    def changes_settings(self) -> bool:
        """Whether anything is asked for that `settings` might refuse; looking at it loads torch, some seconds."""
        asked = self.request
        given = (asked.config, asked.temporal, asked.shapes, asked.chunk_frames, self.project)
        return any(each is not None for each in given)

    def settings(self) -> "PipelineConfig":
        """The settings; InputError where they do not go with the rest."""
        from shapepose_fg.io.config import read_config
        from shapepose_fg.pipeline.config import PipelineConfig

        asked = self.request
        found = PipelineConfig() if asked.config is None else read_config(asked.config, PipelineConfig)
        found = found if asked.temporal is None else replace(found, temporal=asked.temporal)
        if asked.shapes is not None and not found.temporal:
            raise InputError(
                "--shapes: a person's shape is known over time only; leave out --shapes or --no-temporal"
            )
        if asked.chunk_frames is not None and not (found.temporal and asked.chunk_frames >= found.batch_frames):
            raise InputError(
                f"--chunk-frames {asked.chunk_frames}: must be {found.batch_frames} (batch_frames) or more, and"
                " needs people over time"
            )
        if self.project is not None and not found.temporal:
            raise InputError("--project: its files need people over time; leave out --no-temporal, or --project")
        return found


def prepare(request: Request, output: Path | None, tell: Callable[[str], None] = note) -> Prepared:
    """Find a request's places, and look at its options, before any large file is read.

    `tell` is given what a project's files were taken to be. InputError, one sentence, where something is missing
    or wrong.
    """
    project = None if request.project is None else project_of(request.project, tell)
    calibration, detections, output = places(request.calibration, request.detections, output, project)
    fps, timestamps = request.fps, request.timestamps
    if project is not None and fps is None and timestamps is None:
        fps, timestamps = project.fps, project.times
    if fps is not None and timestamps is not None:
        raise InputError("--fps and --timestamps: both say when frames were taken; give one of them")
    check_fps(fps)
    refuse_no_range(request.frames)
    return Prepared(request, project, calibration, detections, output, fps, timestamps)


def carry_out(
    request: Request,
    output: Path | None,
    *,
    workers: int | None = None,
    cluster: str | None = None,
    sharing: int = 1,
    resume: bool = False,
    restart: bool = False,
    watched: "Callable[[], AbstractContextManager[Callable[[int, int], None]]] | None" = None,
) -> "Ended":
    """Reconstruct what is asked for into the folder `output`, or the project's, and say how it went.

    `workers`, `cluster`, `resume` and `restart` are the command's options. So many runs are `sharing` the cluster.
    `watched` is a context that gives what is told how many frames are done, a progress bar by default. InputError,
    one sentence, for what cannot be used; `Stopped` on Ctrl-C or a request to end.
    """
    from shapepose_fg.core.provenance import ReadInputs, checksums
    from shapepose_fg.io.corrections import refuse_corrected
    from shapepose_fg.io.detections import read_detections
    from shapepose_fg.pipeline.workers import get_ready, suitable_workers

    config, body, shapes = request.config, request.body, request.shapes
    known = prepare(request, output)
    calibration, timestamps, project, output = known.calibration, known.timestamps, known.project, known.output
    reading = ReadInputs((calibration, known.detections, config, body, timestamps))
    rig = known.rig()
    refuse_corrected(output)
    if known.changes_settings:
        known.settings()  # what is wrong with them is said before the whole recording is read
    with only_run_in(output, OUTPUTS), recording_folder(output) as kept:
        recording = read_detections(known.detections, rig, request.skeleton, kept)
        for each in recording.notes:
            note(each)
        span = frame_range(request.frames, len(recording))
        if project is not None and request.frames is None:
            span = project.span(len(recording))
        times = times_of(known.fps, timestamps, rig, len(recording))
        cuts = possible_cuts(request.cuts, len(recording))
        count = suitable_workers(len(span), _FRAMES_WORTH_A_WORKER) if workers is None else workers
        if count > 1 and cluster is None:
            get_ready("shapepose_fg.pipeline.pipeline")
        from shapepose_fg.cli.reconstruct.ending import Ending
        from shapepose_fg.cli.reconstruct.run import Job, run_job

        settings = known.settings()
        source = settings.offsets.source
        offsets = None if source in ("recording", "none") else Path(source)
        fitter = fitter_of(body, settings, recording.skeleton.joints)
        inputs = reading.checksums((calibration, *recording.sources, config, body, timestamps))
        inputs |= {} if offsets is None else checksums([offsets])
        del reading  # of half a million files it is large
        read = rig, recording, settings, span, times, cuts, body, fitter, shapes, inputs
        job = Job(*read, request.chunk_frames, sharing)
        # Of its own detections `detect` knows which pictures they are of.
        own = (known.detections / "footage.json").is_file()
        videos = None if project is None or own else project.folder / "videos"
        ending = Ending(calibration, project, videos, report=request.report, check=request.check)
        watched = watched or (lambda: progress("reconstructing"))
        return run_job(
            job, output, ending, workers=count, cluster=cluster, resume=resume, restart=restart, watched=watched
        )
