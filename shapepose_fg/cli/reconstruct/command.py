"""`shapepose-fg reconstruct`: from the cameras and detections of a recording to a folder of results."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

from shapepose_fg.cli.options import (
    RESULT,
    TIME,
    RunOptions,
    grouped,
    option,
)
from shapepose_fg.cli.reconstruct.carry_out import carry_out
from shapepose_fg.cli.reconstruct.request import Request, cuts_of


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
