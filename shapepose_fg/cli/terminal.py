"""Output of the commands on a terminal: results, notes, and progress bars."""

import logging
import os
import re
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.console import Console, RenderableType
    from rich.progress import Progress


def use_any_streams() -> None:
    """Make stdout and stderr accept any text: closed ones discard it, unsupported letters are escaped.

    A closed descriptor is opened on nothing; otherwise the next opened file would get its number, and messages of
    libraries would be written into it.
    """
    for descriptor in range(3):
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest number that is free
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: PTH123, SIM115
        elif not isinstance(stream, _Stripped):
            if hasattr(stream, "reconfigure"):
                stream.reconfigure(errors="backslashreplace")
            setattr(sys, name, _Stripped(stream))


class _Stripped:
    """A stream without control sequences, which names of files and keys may contain.

    Only plain text goes through it. Rich's consoles strip their text themselves and write colours and bars to the
    stream beneath: they ask for it by this attribute, and `console` below hands it over.
    """

    def __init__(self, stream: Any) -> None:
        self.rich_proxied_file = stream

    def write(self, text: str) -> int:
        self.rich_proxied_file.write(printable(text))
        return len(text)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.rich_proxied_file, name)


def _beneath(stream: Any) -> Any:
    """The stream beneath our own streams and those of Rich."""
    while hasattr(stream, "rich_proxied_file"):
        stream = stream.rich_proxied_file
    return stream


_OBEYED = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u200e\u200f\u202a-\u202e\u2066-\u2069]")


def printable(text: str) -> str:
    """The text without control characters, except for ends of lines and tabs, and without changes of direction."""
    return _OBEYED.sub("", text)


def console(*, stderr: bool = False) -> "Console":
    """A console on stdout or stderr that strips what is printed on it; text is no markup."""
    from rich.console import Console
    from rich.segment import Segment

    class Stripping(Console):
        def render(self, *arguments: Any, **options: Any) -> Iterator[Segment]:
            for each in super().render(*arguments, **options):
                yield each if each.control else each._replace(text=printable(each.text))

    return Stripping(file=_beneath(sys.stderr if stderr else sys.stdout), markup=False, emoji=False)


def show(content: "RenderableType") -> None:
    """Print on stdout; with colours on a terminal only. Text is no markup: names and paths are in it."""
    console().print(content)


def table(
    heads: Sequence[str], rows: Iterable[Sequence[Any]], *, left: int = 1, caption: str = ""
) -> "RenderableType":
    """Rows under headings, the first `left` columns to the left, and a caption under them."""
    from rich.console import Group
    from rich.table import Table
    from rich.text import Text

    made = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0), header_style="dim")
    for n, head in enumerate(heads):
        made.add_column(head, justify="left" if n < left else "right", overflow="fold")
    for row in rows:
        made.add_row(*row)
    return Group(made, Text(caption, style="dim")) if caption else made


def say(what: str, message: str, style: str) -> None:
    """Print on stderr, in one paragraph that begins with `what`."""
    from rich.text import Text

    on = console(stderr=True) if _shown is None else _shown.console  # above the bars
    on.print(Text.assemble((f"{what}: ", style), message), soft_wrap=True)


def note(*messages: str) -> None:
    """Print notes on stderr, each in one line."""
    for message in messages:
        say("note", message, "bold")


def warn(message: str) -> None:
    """Print a warning on stderr, in one paragraph."""
    say("warning", message, "bold yellow")


class _Noted(logging.Handler):
    """Prints log records as notes."""

    def emit(self, record: logging.LogRecord) -> None:
        note(record.getMessage())


def note_log() -> None:
    """Print what the package logs as notes: work that takes long once."""
    logger = logging.getLogger("shapepose_fg")
    if len(logger.handlers) == 0:
        logger.addHandler(_Noted(logging.INFO))
        logger.setLevel(logging.INFO)


_shown: "Progress | None" = None
"""Bars that are shown at present."""


@contextmanager
def bars(unit: str = "") -> Iterator["Progress"]:
    """Progress bars on stderr while the block runs; nothing is shown where that is not a terminal.

    Whatever ends the block, the bars are taken away and the cursor is back.
    """
    global _shown
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    on, left = console(stderr=True), TimeRemainingColumn(compact=True)
    columns = (TextColumn("{task.description}", markup=False), BarColumn(), MofNCompleteColumn(), TextColumn(unit))
    is_shown = _is_terminal(on) and _shown is None
    made = Progress(
        *columns,
        left,
        console=on,
        transient=True,
        disable=not is_shown,
        redirect_stdout=False,
        redirect_stderr=True,
    )
    if not is_shown:
        yield made
        return
    try:
        _shown = made
        with made:
            yield made
    finally:
        _shown = None
        on.show_cursor(True)


def _is_terminal(on: "Console") -> bool:
    return on.file.isatty() and not on.is_dumb_terminal


_EVERY_S = 15.0
"""Interval between lines of progress where stderr is no terminal, s."""


@contextmanager
def progress(what: str, unit: str = "frames") -> Iterator[Callable[[int, int], None]]:
    """A function that is called with the number of finished items and of all: a bar on a terminal, else lines
    of text.
    """
    begin = last = time.monotonic()

    def line(done: int, total: int) -> None:
        nonlocal last
        if total and done > 0 and (now := time.monotonic()) - last >= _EVERY_S:
            last = now
            left = (now - begin) * (total - done) / done
            say(what, f"{done} of {total} {unit}, {left / 60:.0f} min left", "bold")

    with bars(unit) as shown:
        task = shown.add_task(what, total=None)
        yield line if shown.disable else lambda done, total: shown.update(task, completed=done, total=total)
