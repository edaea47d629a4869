"""The work of `shapepose-fg reconstruct`: a run that is kept as it goes, and what is made of it at its end."""

import hashlib
import json
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from shapepose_fg.body.fitting.fitter import BodyFitter
from shapepose_fg.body.shapes import SubjectShapes
from shapepose_fg.cli.reconstruct.ending import Ending
from shapepose_fg.cli.reconstruct.inputs import known_shapes
from shapepose_fg.cli.reconstruct.outcome import Ended
from shapepose_fg.cli.reconstruct.summary import show_check
from shapepose_fg.cli.stopping import Stopped
from shapepose_fg.cli.terminal import note, show
from shapepose_fg.core.camera import Rig
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.frame_times import FrameTimes
from shapepose_fg.core.provenance import program_digest, versions
from shapepose_fg.core.storage.kept_arrays import KeptArrays
from shapepose_fg.io.calibration import write_rig
from shapepose_fg.io.detection_table import DetectionTable
from shapepose_fg.io.solved_setup import CAMERAS
from shapepose_fg.pipeline.pipeline import PipelineConfig, Progress, reconstruct_parts
from shapepose_fg.pipeline.runs.known_people import checksum_at_start, people_at_start, write_people
from shapepose_fg.pipeline.runs.manifest import PARTS, check_room, end_run, expected_bytes, frames_done, open_run


@dataclass(frozen=True)
class Job:
    """What is to be reconstructed, read and checked."""

    rig: Rig
    """The cameras."""
    recording: DetectionTable
    """What they saw."""
    settings: PipelineConfig
    """How."""
    frames: range
    """Which frames."""
    times: FrameTimes | None
    """When they were taken, where that is said."""
    cuts: tuple[int, ...]
    """First frames of what follows a cut."""
    body: Path | None
    """File of the body model; None for the one that ships."""
    fitter: BodyFitter | None
    """The fitter with that model; None for the pipeline's own."""
    shapes: Path | None
    """File of people's shapes."""
    inputs: dict[str, str]
    """Checksums of the files that were read."""
    chunk_frames: int | None = None
    """Into chunks of how many frames the recording is cut; None for one."""
    sharing: int = 1
    """How many runs share the cluster."""

    def begun(self) -> dict[str, Any]:
        """All that the result depends on, as plain values: equal for a run that goes on."""
        times = FrameTimes.assumed(len(self.recording)) if self.times is None else self.times
        skeleton = {"name": self.recording.skeleton.name, "sha256": _digest(asdict(self.recording.skeleton))}
        cameras = [
            (
                camera.name,
                camera.image_size,
                camera.lens,
                *map(_numbers, (camera.K, camera.distortion, camera.wTc)),
            )
            for camera in self.rig.cameras
        ]
        return {
            "inputs": self.inputs,
            "configuration": asdict(self.settings),
            "frames": [self.frames.start, self.frames.stop],
            "time": {**times.as_dict(), "sha256": _digest(_numbers(times.time_s))},
            "cuts": list(self.cuts),
            "chunk_frames": self.chunk_frames,
            "body": None if self.body is None else str(self.body),
            "shapes": None if self.shapes is None else str(self.shapes),
            "skeleton": skeleton,
            "cameras": _digest([self.rig.up, cameras]),
            "versions": versions(),
            "program": program_digest(),
        }


def run_job(
    job: Job,
    output: Path,
    ending: Ending,
    *,
    workers: int,
    cluster: str | None,
    resume: bool,
    restart: bool,
    watched: Callable[[], AbstractContextManager[Progress]],
) -> Ended:
    """Reconstruct, and leave the results in `output`, where the caller is the only one.

    `watched` gives what is told how many frames are done.

    Whatever stops it, what is done is kept there, and the next call with `resume` goes on. InputError where that
    cannot be, or the disk is full; `Stopped`, with where it stands, on Ctrl-C or a request to end.
    """
    begun = job.begun()
    if not (output / PARTS).is_dir():
        check_room(output, expected_bytes(job.recording, job.rig, job.frames))
        if resume:
            note(f"{output}: no run was stopped here; this one begins anew")
    kept = open_run(output, begun, resume=resume, restart=restart)
    try:
        return _run(job, output, ending, kept, workers, cluster, watched)
    except Stopped as stop:
        raise Stopped(stop.number, _standing(job, output)) from None
    except OSError as error:
        place = f"{error.filename}: " if error.filename is not None else ""
        raise InputError(f"{place}{error.strerror or error}; {_standing(job, output)}") from None


def _run(
    job: Job,
    output: Path,
    ending: Ending,
    kept: KeptArrays,
    workers: int,
    cluster: str | None,
    watched: Callable[[], AbstractContextManager[Progress]],
) -> Ended:
    """The reconstruction, its files, and what is said of it."""
    file = job.shapes
    known: SubjectShapes | None = None
    if file is not None:
        known = people_at_start(kept, file, lambda: known_shapes(file, job.body))
    start = time.perf_counter()
    with watched() as progress:
        result = reconstruct_parts(
            kept,
            job.recording,
            job.rig,
            job.settings,
            frames=job.frames,
            fitter=job.fitter,
            times=job.times,
            cuts=job.cuts,
            shapes=known,
            progress=progress,
            workers=workers,
            cluster=cluster,
            chunk_frames=job.chunk_frames,
            sharing=job.sharing,
        )
    seconds = time.perf_counter() - start
    inputs = dict(job.inputs)
    if file is not None and known is not None and len(known) > 0:
        inputs[str(file)] = checksum_at_start(kept)
    result = result.with_run(inputs=inputs, notes=list(job.recording.notes), body=job.body)
    people = ending.looked_at(result)
    checked = ending.checked(job.recording, job.rig, job.frames, people)
    result = result if checked is None else result.with_run(**checked.as_run())
    people = people.with_run(**result.run)
    result.save(output)
    # What the observations were seen with: to solve or draw them anew.
    if not (output / CAMERAS).exists() or not (output / CAMERAS).samefile(ending.calibration):
        write_rig(job.rig, output / CAMERAS)
    if file is not None and known is not None and result.shapes is not None:
        write_people(kept, file, known.updated(result.shapes))
    summary = ending.written(result, people, job.rig, job.frames, seconds, output)
    if file is not None and result.shapes is not None:
        summary.add_row("", f"{file}  shapes of {len(result.shapes)} people")
    end_run(output)
    show(summary)
    if checked is not None:
        show_check(checked)
    warnings = () if checked is None else tuple(checked.warnings)
    count = len(result.people.counts) if job.settings.temporal else None
    return Ended(len(job.frames), len(result), count, warnings)


def _standing(job: Job, output: Path) -> str:
    """How far a run that was stopped has come, and how to go on."""
    try:
        done = frames_done(output)
    except InputError as error:
        return str(error)
    if done == 0:
        return "nothing is kept: no frame was done"
    return f"{done} of {len(job.frames)} frames are kept in {output / PARTS}; go on with --resume"


def _numbers(array: Any) -> list[Any]:
    return array.tolist()


def _digest(value: Any) -> str:
    """sha256 of plain values."""
    return hashlib.sha256(json.dumps(value, default=list).encode()).hexdigest()
