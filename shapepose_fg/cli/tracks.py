"""The command `tracks`: lists the people of a result over time, and corrects identities by hand."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from shapepose_fg.cli.options import flowing
from shapepose_fg.cli.terminal import note, show, table
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.result_files import results_folder, set_aside

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rich.console import RenderableType

    from shapepose_fg.body.model.smpl_file import SmplArrays
    from shapepose_fg.core.reconstruction import Reconstruction
    from shapepose_fg.tracking.edits import Solve


tracks = typer.Typer(invoke_without_command=True)

Person = Annotated[int, typer.Argument(metavar="A", help="Number of a person.", min=0)]
Other = Annotated[int, typer.Argument(metavar="B", help="Number of another person.", min=0)]
From = Annotated[int, typer.Argument(metavar="FRAME", help="First frame that changes.", min=0)]


@tracks.callback()
@flowing
def people_over_time(
    context: typer.Context,
    results: Annotated[Path, typer.Argument(metavar="RESULTS", help="Folder of a reconstruction.")],
) -> None:
    """List the people of a result over time, or correct identities: shapepose-fg tracks RESULTS
    merge 3 9.

    Without a command, all people are listed. The original result stays in RESULTS/uncorrected, and
    `undo` takes corrections back one by one.
    """
    context.obj = results
    if context.invoked_subcommand is None:
        list_people(context)


@tracks.command("list")
def list_people(
    context: typer.Context,
    as_json: Annotated[bool, typer.Option("--json", help="Print everything as JSON.")] = False,
) -> None:
    """List all people: frames, gaps, stature, share of frames seen, distance walked."""
    from shapepose_fg.core.reconstruction import Reconstruction
    from shapepose_fg.tracking.listing import list_saved_tracks

    if not as_json:
        show(_tracks_table(context.obj))
        return
    with Reconstruction.open(context.obj) as opened:
        listed = [asdict(track) for track in list_saved_tracks(opened, _body_of(opened.run))]
    plain = [
        {name: None if value != value else value for name, value in track.items()}
        for track in listed
    ]
    print(json.dumps(plain, indent=2, allow_nan=False))


@tracks.command("merge")
def merge_people(context: typer.Context, person: Person, other: Other) -> None:
    """Merge B into A: B's rows become A's."""
    _correct(context, "merge", person, other=other)


New = Annotated[
    int | None, typer.Option(help="Number of the new person; by default the next free number.")
]


@tracks.command("split")
def split_person(context: typer.Context, person: Person, frame: From, new: New = None) -> None:
    """Split A at FRAME: from this frame on, A is a new person."""
    _correct(context, "split", person, other=new, frame=frame)


@tracks.command("rename")
def rename_person(context: typer.Context, person: Person, other: Other) -> None:
    """Rename A to B, which must be a free number."""
    _correct(context, "rename", person, other=other)


@tracks.command("drop")
def drop_person(context: typer.Context, person: Person) -> None:
    """Drop A, a false positive: its rows are removed."""
    _correct(context, "drop", person)


@tracks.command("swap")
def swap_people(context: typer.Context, person: Person, other: Other, frame: From) -> None:
    """Swap A and B from FRAME on."""
    _correct(context, "swap", person, other=other, frame=frame)


@tracks.command("undo")
def undo_correction(context: typer.Context) -> None:
    """Undo the last correction."""
    from shapepose_fg.io.corrections import take_back

    folder = results_folder(context.obj)
    edit, _ = take_back(folder, _solver(folder))
    print(f"undone: {edit}")
    show(_tracks_table(context.obj))
    _renew_report(folder)


def _tracks_table(results: Path) -> "RenderableType":
    """Table of all people of a result, and the corrections."""
    from rich.console import Group
    from rich.padding import Padding

    from shapepose_fg.core.frame_times import rate_words
    from shapepose_fg.core.reconstruction import Reconstruction
    from shapepose_fg.io.corrections import read_corrections
    from shapepose_fg.tracking.listing import list_saved_tracks

    with Reconstruction.open(results) as opened:
        run, rows = opened.run, len(opened)
        listed = list_saved_tracks(opened, _body_of(run))

    def or_dash(value: float, text: str) -> str:
        return "-" if value != value else text.format(value)  # NaN is shown as "-"

    people = table(
        "person frames rows gaps stature seen confidence walked".split(),
        (
            (
                str(track.person),
                f"{track.first}-{track.last}",
                str(track.rows),
                str(track.gaps),
                or_dash(track.stature_m, "{:.2f} m"),
                or_dash(100 * track.seen, "{:.0f} %"),
                f"{track.confidence:.2f}",
                f"{track.walked_m:.1f} m",
            )
            for track in listed
        ),
        left=0,
    )
    lines = [f"{len(listed)} people, {rows} rows{rate_words(run)}"]
    if not run.get("configuration", {}).get("temporal", True):
        lines.append("every frame was solved separately: numbers are not identities")
    edits = read_corrections(results_folder(results))
    if len(edits) > 0:
        lines.append(f"corrected: {'; '.join(map(str, edits))}")
    return Group(
        *([people] if listed else []), Padding("\n".join(lines), (1 if listed else 0, 0, 0, 0))
    )


def _body_of(run: "Mapping[str, Any]") -> "SmplArrays | None":
    """The body model of a result; None if its file is missing."""
    from shapepose_fg.io.solved_setup import body_of

    try:
        return body_of(run)
    except InputError:
        return None


def _correct(context: typer.Context, action: str, person: int, **more: int | None) -> None:
    """Apply one correction, and print its effect."""
    from shapepose_fg.core.reconstruction import Reconstruction
    from shapepose_fg.io.corrections import correct
    from shapepose_fg.tracking.edits import Action, Edit, free_number

    folder = results_folder(context.obj)
    if action == "split" and more["other"] is None:
        with Reconstruction.open(folder) as opened:
            more["other"] = free_number(opened.person)
    edit = Edit(Action(action), person, **more)
    solve = _solver(folder)
    edited = correct(folder, edit, solve)
    words = "; joints and bodies were not solved again"
    if solve is not None:
        words = f"; solved again: {' '.join(map(str, sorted(edited.changed)))}"
    print(f"done: {edit}{words if len(edited.changed) > 0 else ''}")
    show(_tracks_table(context.obj))
    print(f"to undo it: shapepose-fg tracks {context.obj} undo")
    _renew_report(folder)


def _renew_report(folder: Path) -> None:
    """Write the report of a corrected result again, if there is one, and rename its exports, which
    are out of date.
    """
    from shapepose_fg.viz.report.writing import REPORT, report_of

    note(*set_aside(folder))
    page = folder / REPORT
    if not page.is_file():
        return
    try:
        print(f"{report_of(folder)} is up to date")
    except InputError as problem:
        page.unlink()
        print(f"{page} is removed: {problem}")


def _solver(folder: Path) -> "Solve | None":
    """Function that solves rows of the result in `folder` again; None if required files are
    missing.

    Without identities every row is solved separately.
    """
    from shapepose_fg.core.reconstruction import Reconstruction
    from shapepose_fg.io.solved_setup import CAMERAS

    if not all((folder / name).is_file() for name in ("run.json", "observations.npz", CAMERAS)):
        return None
    with Reconstruction.open(folder) as opened:
        if not opened.run.get("configuration", {}).get("temporal", False):
            return None
        if functions := opened.run.get("extra_factors"):
            names = ", ".join(map(str, functions))
            note(
                f"corrected people are solved again without the factors of {names}, which are "
                "known in Python only"
            )

    def solve(rows: "Reconstruction") -> "Reconstruction":
        from shapepose_fg.pipeline.solving import Solver, solve_rows

        return solve_rows(rows, Solver.read(folder, rows))

    return solve
