"""The command `tracks`: lists the people of a result over time, and corrects identities by hand."""

import shlex
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from shapepose_fg.cli.options import RESULT, argument, grouped, json_option, option
from shapepose_fg.cli.terminal import note, show, show_json, table
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.result_files import results_folder, set_aside
from shapepose_fg.core.run_summary import has_identities

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rich.console import RenderableType

    from shapepose_fg.body.model.smpl_file import SmplArrays
    from shapepose_fg.core.reconstruction import Reconstruction
    from shapepose_fg.results.edits import Solve

_ACTIONS = {
    "list": (),
    "merge": ("person", "other"),
    "split": ("person", "frame"),
    "rename": ("person", "other"),
    "drop": ("person",),
    "swap": ("person", "other", "frame"),
    "undo": (),
}
"""Arguments of each action."""


@grouped
def tracks(
    results: Path = argument("RESULTS", "Folder of a reconstruction."),
    action: Literal["list", "merge", "split", "rename", "drop", "swap", "undo"] = argument(
        "ACTION", "What to do; without it, all people are listed.", "list"
    ),
    numbers: list[int] | None = argument("NUMBERS", "People, and first frame that changes.", None),
    new: int | None = option(
        RESULT, "split: number of the new person; by default the next free number."
    ),
    as_json: bool = json_option(),
) -> None:
    """List the people of a result over time, or correct identities: shapepose-fg tracks RESULTS
    merge 3 9.

    - list: frames, gaps, stature, share of frames seen, distance walked of all people.

    - merge A B: B's rows become A's.

    - split A FRAME: from this frame on, A is a new person.

    - rename A B: A gets the number B, which must be free.

    - drop A: A is a false positive; its rows are removed.

    - swap A B FRAME: A and B are exchanged from this frame on.

    - undo: the last correction is taken back. The original result stays in RESULTS/uncorrected.
    """
    names, given = _ACTIONS[action], numbers or []
    if len(given) != len(names):
        raise InputError(f"{action}: needs {' '.join(names) or 'no number'}, got {len(given)}")
    if action == "list" and as_json:
        _print_as_json(results)
    elif action == "undo":
        _undo(results)
    elif action != "list":
        _correct(results, action, new, **dict(zip(names, given, strict=True)))
    if not as_json:
        show(_tracks_table(results))
    if action not in ("list", "undo"):
        print(f"to undo it: {shlex.join(['shapepose-fg', 'tracks', str(results), 'undo'])}")
    if action != "list":
        _renew_report(results_folder(results))


def _print_as_json(results: Path) -> None:
    from shapepose_fg.core.reconstruction import Reconstruction
    from shapepose_fg.results.track_summary import list_saved_tracks

    with Reconstruction.open(results) as opened:
        listed = [asdict(track) for track in list_saved_tracks(opened, _body_of(opened.run))]
    plain = [
        {name: None if value != value else value for name, value in track.items()}
        for track in listed
    ]
    show_json(plain)


def _undo(results: Path) -> None:
    """Take the last correction back."""
    from shapepose_fg.results.corrections import take_back

    folder = results_folder(results)
    edit, _ = take_back(folder, _solver(folder))
    print(f"undone: {edit}")


def _tracks_table(results: Path) -> "RenderableType":
    """Table of all people of a result, and the corrections."""
    from rich.console import Group
    from rich.padding import Padding

    from shapepose_fg.core.frame_times import rate_words
    from shapepose_fg.core.reconstruction import Reconstruction
    from shapepose_fg.results.corrections import read_corrections
    from shapepose_fg.results.track_summary import list_saved_tracks

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
    if not has_identities(run):
        lines.append("every frame was solved separately: numbers are not identities")
    edits = read_corrections(results_folder(results))
    if len(edits) > 0:
        lines.append(f"corrected: {'; '.join(map(str, edits))}")
    return Group(
        *([people] if listed else []), Padding("\n".join(lines), (1 if listed else 0, 0, 0, 0))
    )


def _body_of(run: "Mapping[str, Any]") -> "SmplArrays | None":
    """The body model of a result; None if its file is missing."""
    from shapepose_fg.body.model.result_body import body_of

    try:
        return body_of(run)
    except InputError:
        return None


def _correct(results: Path, action: str, new: int | None, **numbers: int) -> None:
    """Apply one correction, and print its effect."""
    from shapepose_fg.core.reconstruction import Reconstruction
    from shapepose_fg.results.corrections import correct
    from shapepose_fg.results.edits import Action, Edit, free_number

    folder = results_folder(results)
    if action == "split" and new is None:
        with Reconstruction.open(folder) as opened:
            new = free_number(opened.person)
    given: dict[str, Any] = numbers | ({"other": new} if action == "split" else {})
    edit = Edit(Action(action), **given)
    solve = _solver(folder)
    edited = correct(folder, edit, solve)
    words = "; joints and bodies were not solved again"
    if solve is not None:
        words = f"; solved again: {' '.join(map(str, sorted(edited.changed)))}"
    print(f"done: {edit}{words if len(edited.changed) > 0 else ''}")


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
    from shapepose_fg.core.rig_file import CAMERAS

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
        from shapepose_fg.results.solve_again import Solver, solve_rows

        return solve_rows(rows, Solver.read(folder, rows))

    return solve
