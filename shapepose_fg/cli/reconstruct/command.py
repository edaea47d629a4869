"""`shapepose-fg reconstruct`: from the cameras and detections of a recording to a folder of results."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from shapepose_fg.cli.options import (
    RESULT,
    TIME,
    RunOptions,
    grouped,
    option,
)
from shapepose_fg.cli.reconstruct.request import OUTPUTS, Ended, Request, cuts_of, prepare
from shapepose_fg.cli.terminal import note
from shapepose_fg.core.storage.output_folder import only_run_in

if TYPE_CHECKING:
    from shapepose_fg.core.storage.kept_arrays import InFolder
    from shapepose_fg.pipeline.execution import Execution

_RECORDING = ".detections"
"""Where what the cameras saw is kept meanwhile."""

# Everything else is imported inside the functions: `--help` must not wait for torch.


@grouped
def reconstruct(
    request: Request,
    running: RunOptions,
    cuts: Annotated[
        str | None, option(TIME, "First frames after a cut: nothing carries over to them.", metavar="A,B")
    ] = None,
    output: Annotated[
        Path | None, option(RESULT, "Folder for people.npz and run.json; made if it is not there.")
    ] = None,
) -> None:
    """Reconstruct the people of a recording: 3D joints with covariances, and bodies."""
    from shapepose_fg.pipeline.execution import Execution

    running.check()
    execution = Execution(workers=running.workers, cluster=running.cluster)
    request = replace(request, cuts=cuts_of(cuts))
    carry_out(request, output, execution, resume=running.resume, restart=running.restart)


def carry_out(
    request: Request, output: Path | None, execution: "Execution", *, resume: bool = False, restart: bool = False
) -> Ended:
    """Reconstruct what is asked for into the folder `output`, or the project's, and say how it went.

    `resume` and `restart` are the command's options; `execution` without `progress` shows a bar. InputError, one
    sentence, for what cannot be used; `Stopped` on Ctrl-C or a request to end.
    """
    from shapepose_fg.core.provenance import ReadInputs, checksums
    from shapepose_fg.io.corrections import refuse_corrected
    from shapepose_fg.io.detections import read_detections
    from shapepose_fg.pipeline.workers import get_ready

    known = prepare(request, output)
    asked, output = known.request, known.output
    files = (known.calibration, asked.config, asked.body, asked.timestamps)
    reading = ReadInputs((*files, known.detections))
    rig = asked.rig()
    refuse_corrected(output)
    if known.changes_settings:
        known.settings()  # what is wrong with them is said before the whole recording is read
    with only_run_in(output, OUTPUTS), _recording_folder(output) as kept:
        recording = read_detections(known.detections, rig, asked.skeleton, kept)
        for each in recording.notes:
            note(each)
        count = len(recording)
        span, times, cuts = known.span(count), known.times(rig, count), known.cuts(count)
        execution = replace(execution, chunk_frames=asked.chunk_frames).worth(len(span))
        if execution.workers != 1 and execution.cluster is None:
            get_ready("shapepose_fg.pipeline.pipeline")
        from shapepose_fg.cli.reconstruct.run import Run, fitter_of
        from shapepose_fg.pipeline.pipeline import Task

        settings = known.settings()
        fitter = fitter_of(asked.body, settings, recording.skeleton.joints)
        task = Task(recording, rig, settings, span, times, cuts, fitter=fitter)
        inputs = reading.checksums((known.calibration, *recording.sources, *files[1:]))
        if settings.offsets.source not in ("recording", "none"):
            inputs |= checksums([settings.offsets.source])
        del reading  # of half a million files it is large
        return Run(task, recording, known, inputs, execution).carried_out(resume=resume, restart=restart)


@contextmanager
def _recording_folder(output: Path) -> "Iterator[InFolder]":
    """Where what the cameras saw is kept while the block runs: files in `output`.

    What a killed run left there is removed. They are not in memory, because they may be larger than that.
    """
    from shapepose_fg.core.storage.kept_arrays import InFolder

    folder = output / _RECORDING
    shutil.rmtree(folder, ignore_errors=True)
    try:
        yield InFolder(folder)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
