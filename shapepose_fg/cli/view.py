"""The command `view`: a result in the rerun viewer."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

import typer

from shapepose_fg.cli.options import FramesOption, ResultUpOption, check_fps, result_frames
from shapepose_fg.cli.terminal import note, progress
from shapepose_fg.core.errors import InputError

if TYPE_CHECKING:
    from shapepose_fg.core.camera import Axis
    from shapepose_fg.io.export.take import Take
    from shapepose_fg.io.footage.footage import Footage
    from shapepose_fg.io.footage.used import CameraFootage

# Everything else is imported inside the command: `--help` must not wait for it.


def view(
    results: Annotated[Path, typer.Argument(metavar="RESULTS", help="Folder of a reconstruction.")],
    frames: FramesOption = None,
    person: Annotated[
        list[int] | None, typer.Option(help="Only this person; may be given several times.", show_default=False)
    ] = None,
    seen_only: Annotated[
        bool, typer.Option("--seen-only", help="Leave out joints that no view saw in that frame.")
    ] = False,
    fps: Annotated[float | None, typer.Option(help="Frames a second, in place of the result's own times.")] = None,
    up: ResultUpOption = None,
    body: Annotated[
        Path | None, typer.Option(help="The body model of the result, where its file has moved.")
    ] = None,
    connect: Annotated[
        str | None,
        typer.Option(
            metavar="URL", help="A viewer that runs already: rerun+http://HOST:9876/proxy.", show_default=False
        ),
    ] = None,
    videos: Annotated[
        list[str] | None,
        typer.Option(
            "--videos",
            "--images",
            metavar="FOLDER|CAMERA=PATH",
            help="Show the cameras' videos or pictures too, which are given as for `detect`.",
            show_default=False,
        ),
    ] = None,
    image_placement: Annotated[
        list[str] | None,
        typer.Option(
            metavar="KIND|CAMERA=KIND",
            help="As for `detect`, where pictures have another size.",
            show_default=False,
        ),
    ] = None,
    statistics: Annotated[
        bool,
        typer.Option(
            "--statistics", help="Leave rerun's statistics of use, sent to its makers, as they are set: not off."
        ),
    ] = False,
) -> None:
    """Show a result in the rerun viewer: people, cameras, and what was used of what they saw, on a timeline."""
    from shapepose_fg.io.export.job import Job
    from shapepose_fg.io.export.reading import body_file, read_take
    from shapepose_fg.io.export.rerun_app import (
        body_if_there,
        log_take,
        new_stream,
        open_viewer,
        switch_off,
        viewer_file,
    )
    from shapepose_fg.io.export.rerun_log import log_pictures

    check_fps(fps)
    take = read_take(
        results,
        up=cast("Axis | None", up),
        fps=fps,
        seen_only=seen_only,
        frames=result_frames(frames),
        persons=tuple(person) if person else None,
        identities=False,
    )
    pictures = [] if not videos else _pictures(take, videos, image_placement or [])
    stream = new_stream()
    viewer = viewer_file()
    if connect is None and not statistics and viewer is not None and switch_off(viewer):
        note(
            "rerun's statistics of use were on and are switched off now; `rerun analytics enable` switches them on"
        )
    open_viewer(stream, take, connect)
    arrays, missing = body_if_there(Job(take, results, body_file(take, body)))
    if missing is not None:
        note(missing)
    log_take(stream, take, arrays)
    if len(pictures) > 0:
        with progress("showing pictures", "pictures") as done:
            log_pictures(stream, take, pictures, done)
    stream.flush()


def _pictures(
    take: "Take", videos: list[str], image_placement: list[str]
) -> "list[tuple[CameraFootage, Footage]]":
    """The cameras' videos or pictures: of all, or of those that are given one by one."""
    from shapepose_fg.viz.overlay.result_pictures import pictures_of

    if take.rig is None:
        raise InputError("--videos: there is no cameras.json beside the result, so no picture has a place")
    named = {each.partition("=")[0].strip() for each in videos if "=" in each}
    drawn = [name for name in take.rig.names if name in named] or list(take.rig.names)
    return pictures_of(take.people.run, take.rig, drawn, videos, None, image_placement)
