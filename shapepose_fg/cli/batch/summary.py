"""What `shapepose-fg batch` says: bars while it runs, a line for each recording that ends, a table of all."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text

from shapepose_fg.cli.batch.standing import Standing, Standings


class Bars:
    """A line for all recordings, and one for each that is under way; nothing where stderr is no terminal."""

    def __init__(self, bars: Progress, standings: Standings) -> None:
        self._bars, self._standings = bars, standings
        self._whole = bars.add_task("recordings", total=len(standings.of))
        self._tasks: dict[str, TaskID] = {}
        self._count()

    def began(self, name: str) -> None:
        """A recording is being read."""
        self._tasks[name] = self._bars.add_task(name, total=None)

    def frames(self, name: str, done: int, count: int) -> None:
        """So many of its frames are done."""
        self._bars.update(self._tasks[name], completed=done, total=count)

    def ended(self, name: str, *, failed: str | None, again: bool) -> None:
        """It is done, or has `failed` for a reason; `again` if it will be tried again."""
        self._bars.remove_task(self._tasks.pop(name))
        self._count()
        how, style = ("done", "green") if failed is None else ("failed", "bold red")
        words = [(f"{how}: ", style), name]
        if failed is None:
            words.append(f", {_what(self._standings.of[name])}")
        else:
            words.append(f": {failed}" + (" (it is tried once more, after the others)" if again else ""))
        self._bars.console.print(Text.assemble(*words), soft_wrap=True)

    def _count(self) -> None:
        ended = len(self._standings.of) - len(self._standings.names("waiting"))
        self._bars.update(self._whole, completed=ended)


@contextmanager
def bars(standings: Standings) -> Iterator[Bars]:
    """`Bars` on stderr while the block runs."""
    console = Console(stderr=True)
    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(compact=True),
    )
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as progress:
        yield Bars(progress, standings)


def table_of(standings: Standings, seconds: float) -> Table:
    """All recordings: how each ended, frames, people and time; under it what all of them took."""
    table = Table(box=None, padding=(0, 2, 0, 0), header_style="dim")
    for name in ("recording", "", "frames", "people", "rows", "time", "warnings"):
        table.add_column(name, justify="left" if name in ("recording", "") else "right", overflow="fold")
    styles = {"done": "green", "failed": "bold red", "waiting": "yellow"}
    for name, each in standings.of.items():
        numbers = [_number(number) for number in (each.frames, each.people, each.rows)]
        warnings = str(len(each.warnings)) if len(each.warnings) > 0 else ""
        status = Text(each.status, style=styles[each.status])
        table.add_row(Text(name), status, *numbers, clock(each.seconds) if each.attempts > 0 else "", warnings)
    frames = sum(each.frames or 0 for each in standings.of.values())
    counts = [f"{len(standings.names(status))} {status}" for status in styles if len(standings.names(status)) > 0]
    table.caption = f"{', '.join(counts)}; {frames} frames; this time {clock(seconds)}"
    table.caption_justify = "left"
    return table


def failures(standings: Standings) -> Sequence[str]:
    """A sentence for each recording that failed."""
    return [f"{name}: {standings.of[name].reasons[-1]}" for name in standings.names("failed")]


def clock(seconds: float) -> str:
    """A time in words: 12 s, 3 min 20 s, 5 h 10 min."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60} s"
    return f"{whole // 3600} h {whole % 3600 // 60} min"


def _number(value: int | None) -> str:
    return "" if value is None else str(value)


def _what(standing: Standing) -> str:
    """What was found in a recording that is done."""
    people = "" if standing.people is None else f"{standing.people} people, "
    return f"{standing.frames} frames, {people}{clock(standing.seconds)}"
