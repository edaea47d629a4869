"""The work of `shapepose-fg reconstruct`: a run that can be resumed, and its output."""

import hashlib
import json
import shlex
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from shapepose_fg.body.fitting.fitters import make_fitter
from shapepose_fg.body.fitting.weights import fingerprint
from shapepose_fg.body.model.body_model import BodyModel
from shapepose_fg.body.shapes import SubjectShapes
from shapepose_fg.cameras.check.report import SetupReport, result_check
from shapepose_fg.cli.found_cameras import MOST_S, found_clocks, show_clocks
from shapepose_fg.cli.reconstruct.request import OUTPUTS, Prepared
from shapepose_fg.cli.reconstruct.summary import check_setup, show_check, summary_table
from shapepose_fg.cli.stopping import Stopped
from shapepose_fg.cli.terminal import note, note_of_reading, progress, show, show_written
from shapepose_fg.core.camera import Rig
from shapepose_fg.core.errors import InputError, failure, naming
from shapepose_fg.core.provenance import ReadInputs, checksums, program_digest, versions
from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.core.result_files import CLOCKS, MOMENTS, PEOPLE, set_aside
from shapepose_fg.core.rig_file import CAMERAS
from shapepose_fg.core.run_summary import plain
from shapepose_fg.core.storage.files import inside, read_text, write_content
from shapepose_fg.core.storage.kept_arrays import ANEW, InFolder
from shapepose_fg.core.storage.output_folder import only_run_in, prepare_output
from shapepose_fg.core.trust import Trusted, trust_in, without_poses
from shapepose_fg.io.calibration import write_rig
from shapepose_fg.io.detection_table import DetectionTable
from shapepose_fg.io.footage.placement import FOOTAGE
from shapepose_fg.io.recording import read_recording, write_moments
from shapepose_fg.io.timestamps import write_timestamps
from shapepose_fg.pipeline.execution import Execution
from shapepose_fg.pipeline.pipeline import Task, reconstruct_parts
from shapepose_fg.pipeline.runs import manifest
from shapepose_fg.pipeline.runs.assembly import Assembly
from shapepose_fg.pipeline.trajectories import kept_rig
from shapepose_fg.results.corrections import refuse_corrected
from shapepose_fg.results.track_summary import MOST_ROWS
from shapepose_fg.viz.report.writing import REPORT, th, write_report


@dataclass(frozen=True)
class Ended:
    """Summary of a reconstructed recording; plain data, which is sent between processes."""

    frames: int
    """Number of reconstructed frames."""
    rows: int
    """Number of rows in people.npz."""
    people: int | None
    """Number of people over time; None for frame-by-frame results."""
    warnings: tuple[str, ...]
    """Problems of cameras and detections."""


def carry_out(
    known: Prepared,
    execution: Execution,
    *,
    resume: bool = False,
    restart: bool = False,
    overwrite: bool = False,
) -> Ended:
    """Execute a request: reconstruct, write the results into its folder, and print a summary.

    `resume`, `restart` and `overwrite` are the command's options; `execution` without `progress`
    shows a bar. InputError, one sentence, for invalid input; `Stopped`, with the state of the run,
    on Ctrl-C or SIGTERM.
    """
    output = known.output
    refuse_corrected(output)
    if (output / PEOPLE).exists() and not (
        overwrite or (resume and (output / manifest.PARTS).is_dir())
    ):
        raise InputError(
            f"{output}: there is a finished result; give another --output, or --overwrite"
        )
    settings = known.settings()  # report wrong settings before the whole recording is read
    with only_run_in(output, OUTPUTS), _recording_folder(inside(output, ".detections")) as kept:
        known = _synchronised(known, kept=resume and (output / manifest.PARTS).is_dir())
        request = known.request
        poses = [Path(each.partition("=")[2]) for each in request.trajectory or ()]
        files = (known.calibration, request.config, request.body, request.timestamps, *poses)
        reading = ReadInputs((*files, known.detections))
        rig, own = request.rig(), output / CAMERAS
        if (
            (request.cameras or request.without)
            and own.exists()
            and own.samefile(known.calibration)
        ):
            raise InputError(
                f"{own}: the result would replace this file by fewer cameras; copy it first"
            )
        recording, times = read_recording(
            known.detections, rig, known.skeleton, kept, request.fps, request.timestamps
        )
        note_of_reading(*recording.notes)
        count = len(recording)
        span, cuts = known.span(count, recording.first), known.cuts(count)
        execution = replace(execution, chunk_frames=request.chunk_frames).with_workers(len(span))
        fitter = None
        if request.body is not None:
            model = BodyModel.load(request.body).with_keypoints(recording.skeleton.joints)
            fitter = make_fitter(settings.body, model)
            if fitter.weights is None and settings.body.method != "plain":
                cure = f"shapepose-fg train-fitter {shlex.join(['--body', str(request.body)])}"
                note(
                    f"{request.body}: bodies are fitted by the plain optimiser; {cure} trains a "
                    "better fitter, once"
                )
        task = Task(recording, rig, settings, span, times, cuts, fitter=fitter)
        inputs = reading.checksums((known.calibration, *recording.sources, *files[1:]))
        beside = rig.trajectories[: len(rig.trajectories) - len(poses)]
        inputs |= checksums([known.calibration.parent / each.name for each in beside])
        if settings.offsets.source not in ("recording", "none"):
            inputs |= checksums([settings.offsets.source])
        if fitter is not None and fitter.weights is not None and fitter.weights.file is not None:
            inputs |= checksums([fitter.weights.file])
        del reading  # it is large for half a million files
        note(*_about_moving(task))
        report = check_setup(known, task) if request.check and not rig.moves else None
        task = (
            task if report is None else replace(task, detections=Trusted(recording, report.trust))
        )
        return _Run(task, recording, known, inputs, execution, report).carried_out(
            resume=resume, restart=restart
        )


def _synchronised(known: Prepared, *, kept: bool) -> Prepared:
    """The request with synchronised.csv as its times: start times of cameras that were started by
    hand, estimated from people. With `kept`, for a resumed run, an existing file is used.
    """
    request, file = known.request, known.output / CLOCKS
    if not request.synchronise:
        return known
    if not (kept and file.is_file()):
        rig = request.still_rig("--synchronise")
        found, taken_s = found_clocks(known.detections, rig, known.skeleton, request.fps, MOST_S)
        show_clocks(found, rig)
        if problems := found.undetermined(rig):
            raise InputError(f"--synchronise: {'; '.join(problems)}")
        write_timestamps(file, rig.names, taken_s)
    return replace(known, request=replace(request, fps=None, timestamps=file))


def _about_moving(task: Task) -> list[str]:
    """Notes on pictures and settings that are not used because cameras move."""
    rig, (_, times, _) = task.rig, task.whole()
    if not rig.moves:
        return []
    notes = ["cameras move: the set-up check needs fixed cameras and is left out"]
    if (rig.carrier >= 0).all():
        notes.append(
            "no camera is fixed: the world frame is the start of the first trajectory, and "
            "drifts with it"
        )
    if not task.config.temporal:
        notes.append("frame by frame: trajectories are used as given, without uncertainty")
    spells = without_poses(rig, times)
    for view in sorted({view for view, _, _ in spells}):
        spans = [(first, last) for each, first, last in spells if each == view]
        count, where = (
            sum(last - first for first, last in spans),
            ", ".join(f"{a}:{b}" for a, b in spans[:4]),
        )
        notes.append(
            f"{rig.names[view]}: frames outside its trajectory are not used: {count} "
            f"({where}{' ...' * (len(spans) > 4)})"
        )
        if count == len(times):
            path, time_s = rig.trajectories[int(rig.carrier[view])], times.frame_s
            raise InputError(
                f"{path.name}: runs from {path.time_s[0]:.10g} to {path.time_s[-1]:.10g} s, the "
                f"pictures of {rig.names[view]} from {time_s[0]:.10g} to {time_s[-1]:.10g}; give "
                "--timestamps of its clock"
            )
    return notes


@contextmanager
def _recording_folder(folder: Path) -> Iterator[Path]:
    """A temporary folder for the detections during the block, because they may be larger than
    memory.

    Files of a killed run are removed.
    """
    shutil.rmtree(folder, ignore_errors=True)
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


@dataclass(frozen=True)
class _Run:
    """A reconstruction with its output folder; the input has been read and checked."""

    task: Task
    """The arguments of the reconstruction."""
    recording: DetectionTable
    """The detections."""
    known: Prepared
    """The request."""
    inputs: dict[str, str]
    """Checksums of the input files as read."""
    execution: Execution
    """How the reconstruction is executed (processes, cluster)."""
    report: SetupReport | None
    """Problems of cameras and detections; None if they were not checked."""

    def run_inputs(self) -> dict[str, Any]:
        """Everything on which the result depends, as plain values, which are equal in a resumed
        run.
        """
        task, request, skeleton = self.task, self.known.request, self.recording.skeleton
        frames, times, cuts = task.whole()
        return {
            "cameras": _digest(asdict(replace(task.rig, notes=()))),
            "inputs": self.inputs,
            "configuration": asdict(task.config),
            "frames": [frames.start, frames.stop],
            "time": {**times.as_dict(), "sha256": _digest(times.time_s)},
            "cuts": cuts,
            "trust": asdict(trust_in(task.detections)),
            "chunk_frames": self.execution.chunk_frames,
            "body": None if request.body is None else str(request.body),
            "shapes": None if request.shapes is None else str(request.shapes),
            "skeleton": {"name": skeleton.name, "sha256": _digest(asdict(skeleton))},
            "versions": versions(),
            "program": program_digest(),
        }

    def carried_out(self, *, resume: bool, restart: bool) -> Ended:
        """Reconstruct, and write the results into the folder; raises as `carry_out` does.

        If interrupted, the finished part is saved there, and the next call with `resume` continues.
        """
        output = self.known.output
        if not (output / manifest.PARTS).is_dir():
            needed = manifest.expected_bytes(self.recording, self.task.rig, self.task.whole()[0])
            manifest.check_room(output, needed)
            if resume:
                note(f"{output}: there is no run to resume; a new one is started")
        kept = manifest.open_run(output, self.run_inputs(), resume=resume, restart=restart)
        try:
            # All saved parts may be intact and still be inconsistent with each other.
            with naming(kept.folder, ANEW) if resume else nullcontext():
                return self._finished(kept)
        except Stopped as stop:
            raise Stopped(stop.number, self._interrupted_state()) from None
        except BrokenPipeError:  # the reader of our output, such as `head`, has ended
            raise
        except (OSError, MemoryError, RuntimeError) as error:
            if (what := failure(error)) is None:
                raise
            raise InputError(f"{what}; {self._interrupted_state()}") from None

    def _finished(self, kept: InFolder) -> Ended:
        """Assemble the reconstruction, write its files, and return its summary."""
        request, output, rig, frames = (
            self.known.request,
            self.known.output,
            self.task.rig,
            self.task.keyframes().tolist(),
        )
        file, inputs = request.shapes, dict(self.inputs)
        known = None
        if file is not None:
            known = manifest.people_at_start(kept, file, lambda: _known_people(file, request.body))
        start = time.perf_counter()
        callback = self.execution.progress
        task = replace(self.task, shapes=known)
        with progress("reconstructing") if callback is None else nullcontext(callback) as callback:
            result = reconstruct_parts(kept, task, replace(self.execution, progress=callback))
        seconds = time.perf_counter() - start
        if file is not None and known is not None and len(known) > 0:
            inputs[str(file)] = manifest.checksum_at_start(kept)
        about = {"inputs": inputs, "notes": [*rig.notes, *self.recording.notes]}
        about |= {"body": None if request.body is None else request.body.resolve()}
        about |= {} if self.recording.first == 0 else {"numbered_from": self.recording.first}
        about |= {} if self.known.project is None else {"project": self.known.project.name}
        result = result.with_run(**about)
        every = max(1, -(-len(result) // MOST_ROWS))
        if every > 1:
            note(
                f"check and report use every {th(every)} frame, because the result has "
                f"{len(result)} rows"
            )
        rig = kept_rig(kept, rig) or rig
        people = result.reconstruction(every=every)
        report = self.report
        looked_at = [frame for frame in frames if frame % every == 0]
        checked = (
            None
            if report is None
            else result_check(report, people, task.detections, rig, looked_at)
        )
        if checked is not None:
            spent = {"set-up check": checked.report.seconds} | result.run["seconds"]
            result = result.with_run(**checked.as_run(), seconds=spent)
        people = people.with_run(**result.run)
        note(*set_aside(output))
        result.save(output)
        # The cameras of the observations, for solving or drawing them again.
        if not (output / CAMERAS).exists() or not (output / CAMERAS).samefile(
            self.known.calibration
        ):
            write_rig(rig, output / CAMERAS)
        if not self.known.request.synchronise:
            (output / CLOCKS).unlink(missing_ok=True)
        used = self.known.detections / FOOTAGE
        if used.is_file():
            write_content(output / FOOTAGE, read_text(used))
        else:
            (output / FOOTAGE).unlink(missing_ok=True)
        if self.recording.picture is not None:
            write_moments(output / MOMENTS, rig, self.recording.picture)
        else:
            (output / MOMENTS).unlink(missing_ok=True)
        summary = summary_table(result, people, self.task, seconds, unchecked=checked is None)
        written = self._written(result, people, rig, every)
        if file is not None and known is not None and result.shapes is not None:
            manifest.write_people(kept, file, known.updated(result.shapes))
            written.append(f"{file}  shapes of {len(result.shapes)} people")
        manifest.end_run(output)
        show(summary)
        show_written(written)
        if checked is not None:
            show_check(checked)
        count = len(result.parts_of) if self.task.config.temporal else None
        return Ended(
            len(self.task.whole()[0]),
            len(result),
            count,
            () if checked is None else tuple(checked.warnings),
        )

    def _written(self, result: Assembly, people: Reconstruction, rig: Rig, every: int) -> list[str]:
        """Write the report and files for other programs; returns their paths and notes."""
        output, project = self.known.output, self.known.project
        files = [
            "people.npz",
            "run.json",
            *(["observations.npz"] if len(result) > 0 else []),
            CAMERAS,
        ]
        written = [str(output / name) for name in files]
        if rig.moves:
            written.append(
                f"{output / 'trajectories'}  poses of moving cameras: CSV with covariances, and TUM"
            )
        if self.known.request.report:
            written.append(
                f"{write_report(output, people, rig, every=every)}  open it in a browser"
            )
        else:  # the report of an earlier result would be out of date
            (output / REPORT).unlink(missing_ok=True)
        if project is not None:
            from shapepose_fg.io.export.markers import (
                write_pose2sim_files,
            )  # imports SciPy: a fifth of a second

            whole = people if len(people) == len(result) else result.reconstruction()
            made = write_pose2sim_files(whole, self.task.rig.up, project)
            written += map(str, made.files)
            note(*made.notes)
        return written

    def _interrupted_state(self) -> str:
        """The state of an interrupted run, and how to resume it."""
        output, count = self.known.output, len(self.task.whole()[0])
        if not (output / manifest.PARTS).is_dir():  # stopped while the summary is printed
            return f"the results in {output} are complete"
        try:
            done = manifest.frames_done(output)
        except InputError as error:
            return str(error)
        return (
            f"{done} of {count} frames are stored in {output / manifest.PARTS}; continue with "
            "--resume"
        )


def _known_people(file: Path, body: Path | None) -> SubjectShapes:
    """The shapes in `file` for the body model in use; empty if the file does not exist yet."""
    model = fingerprint(BodyModel.default() if body is None else BodyModel.load(body))
    if file.exists():
        return SubjectShapes.load(file, model)
    prepare_output(file.parent)
    return SubjectShapes.empty(model)


def _digest(value: Any) -> str:
    """SHA-256 of a plain value or array."""
    return hashlib.sha256(json.dumps(value, default=plain).encode()).hexdigest()
