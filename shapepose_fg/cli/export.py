"""The command `export`: a result as files of other programs."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

import typer

from shapepose_fg.cli.options import FramesOption, ResultUpOption, check_fps, result_frames
from shapepose_fg.cli.terminal import note
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.result_files import results_folder

if TYPE_CHECKING:
    from shapepose_fg.core.camera import Axis

# Everything else is imported inside the command: `--help` must not wait for it.


def export(
    results: Annotated[Path, typer.Argument(metavar="RESULTS", help="Folder of a reconstruction.")],
    formats: Annotated[
        list[str],
        typer.Argument(metavar="FORMAT...", help="One or more of amass trc c3d bvh glb csv parquet rrd, or all."),
    ],
    output: Annotated[
        Path | None, typer.Option(help="Folder for the files; by default `export` in RESULTS.", show_default=False)
    ] = None,
    seen_only: Annotated[
        bool, typer.Option("--seen-only", help="Leave out joints that no view saw in that frame.")
    ] = False,
    markers: Annotated[
        str, typer.Option(help="In trc and c3d: opensim (Pose2Sim's names), joints (ours) or body (SMPL's).")
    ] = "opensim",
    person: Annotated[
        list[int] | None, typer.Option(help="Only this person; may be given several times.", show_default=False)
    ] = None,
    frames: FramesOption = None,
    fps: Annotated[float | None, typer.Option(help="Frames a second, in place of the result's own times.")] = None,
    up: ResultUpOption = None,
    fill_gaps: Annotated[
        float, typer.Option(metavar="SECONDS", help="Holes up to this long are filled in amass and bvh.")
    ] = 0.2,
    body: Annotated[
        Path | None, typer.Option(help="The body model of the result, where its file has moved.")
    ] = None,
) -> None:
    """Write a result for other programs: shapepose-fg export RESULTS amass trc c3d bvh glb csv parquet rrd."""
    from shapepose_fg.io.export.markers import MarkerSet
    from shapepose_fg.io.export.registry import FORMATS, chosen, export_result

    if markers not in set(MarkerSet):
        raise InputError(f"--markers {markers}: must be one of {' '.join(MarkerSet)}")
    check_fps(fps)
    if not 0 <= fill_gaps <= 3600:
        raise InputError(f"--fill-gaps {fill_gaps:g}: must be seconds, 0 or more")
    wanted = list(FORMATS.values()) if "all" in formats else chosen(formats)
    done = export_result(
        results,
        wanted,
        results_folder(results) / "export" if output is None else output,
        up=cast("Axis | None", up),
        fps=fps,
        seen_only=seen_only,
        frames=result_frames(frames),
        persons=tuple(person) if person else None,
        markers=MarkerSet(markers),
        fill_gaps_s=fill_gaps,
        body=body,
    )
    for file in (file for written in done.values() for file in written.files):
        print(file)
    for each in (told for written in done.values() for told in written.notes):
        note(each)
