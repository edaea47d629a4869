"""Shows the set-up check on a terminal of 80 columns: sentences, a row for each camera, and the
agreement of camera pairs.
"""

from collections.abc import Sequence

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from shapepose_fg.cameras.check.report import CameraFigures, CameraUse, PairFigures, SetupReport
from shapepose_fg.cli.terminal import table

_WIDE = 12
"""Maximum length of a camera's name; of longer names only the end is shown, which usually differs
between cameras."""


def setup_report(report: SetupReport) -> RenderableType:
    """The complete report."""
    parts: list[RenderableType] = [
        _sentences(report),
        *(Text(f"{each}.", style="dim") for each in report.notes),
    ]
    parts += [Text(), _cameras(report.cameras)]
    if len(report.cameras) > 2:
        parts += [Text(), _pairs(report.cameras, report.pairs)]
    return Group(*parts)


def use_table(uses: Sequence[CameraUse]) -> RenderableType:
    """A row for each camera of a reconstruction."""
    return table(
        ("camera", "detected", "used", "error px", "mm", "used px", "left out px", "mm"),
        (
            (
                _short(each.camera),
                f"{each.offered}",
                f"{100 * each.used / max(each.offered, 1):.0f} %",
                _both(each.given.median_px, each.given.high_px),
                _both(each.given.median_mm, each.given.high_mm),
                _both(each.after_gates.median_px, each.after_gates.high_px),
                _two(each.left_out.median_px),
                _two(each.left_out.median_mm),
            )
            for each in uses
        ),
        caption=(
            "error: median/90 % of all detections assigned to people; used: the same after "
            "gating; left out: median distance from where the other cameras alone place the joint"
        ),
    )


def _sentences(report: SetupReport) -> RenderableType:
    """The findings, one paragraph each."""
    if len(report.warnings) == 0:
        return Text(f"No problems were found in the {report.frames} checked frames.", style="green")
    listed = Table.grid(padding=(0, 1))
    listed.add_column(style="bold yellow")
    listed.add_column()
    for number, words in enumerate(report.warnings, start=1):
        listed.add_row(f"{number}.", f"{words}.")
    return listed


def _cameras(cameras: Sequence[CameraFigures]) -> RenderableType:
    """A row for each camera, with its agreement with the others."""
    return table(
        ("camera", "people", "shared", "error px", "mm", "left out px", "mm", "fits", "late"),
        (
            (
                _short(each.camera),
                str(each.people),
                f"{100 * each.matched:.0f} %",
                _both(each.median_px, each.high_px),
                _both(each.median_mm, each.high_mm),
                _two(each.left_out_px),
                _two(each.left_out_mm),
                _share(each.left_out_matched),
                f"{each.late_frames:+d}" if each.late_frames != 0 else "0",
            )
            for each in cameras
        ),
        caption=(
            "people: seen in the checked frames; shared: seen by another camera, too; error: "
            "median/90 % of the distance from where all cameras place the joints; left out: "
            "median distance from where the other cameras alone place them; fits: people of the "
            "others who match; late: offset in frames."
        ),
    )


def _pairs(cameras: Sequence[CameraFigures], pairs: Sequence[PairFigures]) -> RenderableType:
    """Agreement of camera pairs: of the people seen by both cameras, the share with matching
    positions.
    """
    of = {(pair.first, pair.second): pair for pair in pairs}
    return table(
        ("agree", *(_short(each.camera) for each in cameras[1:])),
        (
            (
                _short(first.camera),
                *[""] * row,
                *(_cell(of[first.camera, each.camera]) for each in cameras[row + 1 :]),
            )
            for row, first in enumerate(cameras[:-1])
        ),
        caption=(
            "share of the people seen by both cameras that match; distance by which their rays "
            "miss, px"
        ),
    )


def _cell(pair: PairFigures) -> Text:
    if pair.matched is None:
        return Text("-", style="dim")
    return _share(
        pair.matched,
        f" {pair.miss_px:.0f}" if pair.miss_px is not None and pair.matched > 0 else "",
    )


def _share(part: float, more: str = "") -> Text:
    """A share, highlighted if it is small."""
    return Text(f"{100 * part:.0f} %{more}", style="" if part > 0.5 else "yellow")


def _short(name: str) -> str:
    """A camera's name; only the end if it is long."""
    return name if len(name) <= _WIDE else f"…{name[1 - _WIDE :]}"


def _both(median: float | None, high: float | None) -> str:
    return f"{_two(median)}/{_two(high)}" if median is not None else "-"


def _two(value: float | None) -> str:
    """A value with two significant digits."""
    if value is None:
        return "-"
    return f"{value:.1f}" if value < 9.95 else f"{value:.0f}"
