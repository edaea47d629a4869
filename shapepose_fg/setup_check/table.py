"""The check of a set-up on a terminal: sentences, a row for each camera, and how pairs of cameras agree."""

from collections.abc import Sequence

from rich.console import Group, RenderableType
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from shapepose_fg.setup_check.camera_use import short
from shapepose_fg.setup_check.report import CameraFigures, PairFigures, SetupReport


def setup_report(report: SetupReport) -> RenderableType:
    """All of a report."""
    parts: list[RenderableType] = [_sentences(report), Text(), _cameras(report.cameras)]
    if len(report.cameras) > 2:
        parts += [Text(), _pairs(report.cameras, report.pairs)]
    return Group(*parts)


def _sentences(report: SetupReport) -> RenderableType:
    """What is wrong, a paragraph each."""
    if len(report.warnings) == 0:
        return Text(f"Nothing looks wrong in the {report.frames} frames that were looked at.", style="green")
    table = Table.grid(padding=(0, 1))
    table.add_column(style="bold yellow")
    table.add_column()
    for number, words in enumerate(report.warnings, start=1):
        table.add_row(f"{number}.", f"{words}.")
    return table


def _cameras(cameras: Sequence[CameraFigures]) -> RenderableType:
    """How each camera fits."""
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0), header_style="bold")
    for name in ("camera", "people", "shared", "error px", "mm", "left out px", "mm", "fits", "late"):
        table.add_column(name, justify="left" if name == "camera" else "right")
    for each in cameras:
        table.add_row(
            short(each.camera),
            str(each.people),
            f"{100 * each.matched:.0f} %",
            f"{_number(each.median_px)} / {_number(each.high_px)}",
            f"{_number(each.median_mm)} / {_number(each.high_mm)}",
            _number(each.left_out_px),
            _number(each.left_out_mm),
            Text(f"{100 * each.left_out_matched:.0f} %", style="" if each.left_out_matched > 0.5 else "yellow"),
            f"{each.late_frames:+d}" if each.late_frames != 0 else "0",
        )
    note = (
        "people: seen in the frames that were looked at; shared: with another camera; error: median / 90 % of"
        " joints, from where all cameras together put them; left out: median, from where the others alone put"
        " them; fits: people of the others who are matched so; late: frames."
    )
    return Group(table, Padding(Text(note, style="dim"), (0, 0, 0, 0)))


def _pairs(cameras: Sequence[CameraFigures], pairs: Sequence[PairFigures]) -> RenderableType:
    """How pairs of cameras agree: the share of the people that both see who fit."""
    of = {(pair.first, pair.second): pair for pair in pairs}
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0), header_style="bold")
    table.add_column("agree")
    for each in cameras[1:]:
        table.add_column(short(each.camera), justify="right")
    for row, first in enumerate(cameras[:-1]):
        cells = [_cell(of[first.camera, second.camera]) for second in cameras[row + 1 :]]
        table.add_row(Text(short(first.camera)), *[Text()] * row, *cells)
    return Group(table, Text("people seen by both at once who are one; how far rays miss, px", style="dim"))


def _cell(pair: PairFigures) -> Text:
    if pair.matched is None:
        return Text("-", style="dim")
    words = f"{100 * pair.matched:.0f} %"
    if pair.miss_px is not None and pair.matched > 0:
        words += f" {pair.miss_px:.0f}"
    return Text(words, style="" if pair.matched > 0.5 else "yellow")


def _number(value: float | None) -> str:
    """A figure with two digits."""
    if value is None:
        return "-"
    return f"{value:.1f}" if value < 10 else f"{value:.0f}"
