"""The command `report`: a result as one page for the browser."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

import typer

from shapepose_fg.cli.options import ResultUpOption, check_fps

if TYPE_CHECKING:
    from shapepose_fg.core.camera import Axis

# Everything else is imported inside the command: `--help` must not wait for it.


def report(
    results: Annotated[Path, typer.Argument(metavar="RESULTS", help="Folder of a reconstruction.")],
    fps: Annotated[float | None, typer.Option(help="Frames a second, in place of the result's own times.")] = None,
    up: ResultUpOption = None,
    body: Annotated[
        Path | None, typer.Option(help="The body model of the result, where its file has moved.")
    ] = None,
) -> None:
    """Write report.html anew: one page, to be opened in a browser, with the people in 3D and how good they are."""
    from shapepose_fg.viz.report.writing import report_of

    check_fps(fps)
    print(report_of(results, up=cast("Axis | None", up), fps=fps, body=body))
