"""`shapepose-fg reconstruct`: from the cameras and detections of a recording to a folder of
results.
"""

import re
from dataclasses import replace
from pathlib import Path

import typer

from shapepose_fg.cli.options import RESULT, TIME, RunOptions, grouped, option
from shapepose_fg.cli.reconstruct.request import Request, prepare
from shapepose_fg.core.errors import naming


@grouped
def reconstruct(
    request: Request,
    running: RunOptions,
    cuts: str | None = option(
        TIME, "First frames after cuts; no track or motion crosses a cut.", metavar="A,B"
    ),
    output: Path | None = option(RESULT, "Folder for the results; created if missing."),
    overwrite: bool = option(
        RESULT, "Replace a finished result in --output.", False, "--overwrite"
    ),
    strict: bool = option(RESULT, "Exit with code 1 if there are warnings.", False, "--strict"),
) -> None:
    """Reconstruct the people of a recording: 3D joints with covariances, and bodies."""
    running.check()
    with naming(f"--cuts {cuts}", words="must be increasing frame numbers, such as 300,600"):
        frames = (
            () if cuts is None else tuple(int(word) for word in re.split(r"[,\s]+", cuts.strip()))
        )
    known = prepare(replace(request, cuts=frames), output)
    from shapepose_fg.cli.reconstruct.run import carry_out
    from shapepose_fg.pipeline.execution import Execution

    execution = Execution(workers=running.workers, cluster=running.cluster)
    again = {"resume": running.resume, "restart": running.restart, "overwrite": overwrite}
    if len(carry_out(known, execution, **again).warnings) > 0 and strict:
        raise typer.Exit(1)
