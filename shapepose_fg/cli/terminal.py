"""Output of the commands on a terminal: results, notes, and progress bars."""

import json
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
    """Make stdout and stderr accept any text: closed streams discard it, unsupported characters are
    escaped.

    A closed file descriptor is opened on the null device; otherwise the next opened file would get
    its number, and messages of libraries would be written to that file.
    """
    for descriptor in range(3):
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest free descriptor
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: PTH123, SIM115
        elif not isinstance(stream, _Stripped):
            if hasattr(stream, "reconfigure"):
                stream.reconfigure(errors="backslashreplace")
            setattr(sys, name, _Stripped(stream))


class _Stripped:
    """A stream that removes control sequences, which file names and keys may contain.

    Only plain text is written to it. Rich's consoles strip their text themselves, and write colours
    and bars to the underlying stream, which `console` passes to them.
    """

    def __init__(self, stream: Any) -> None:
        self.rich_proxied_file = stream

    def write(self, text: str) -> int:
        self.rich_proxied_file.write(printable(text))
        return len(text)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.rich_proxied_file, name)


def _beneath(stream: Any) -> Any:
    """The underlying stream of our own streams and of those of Rich."""
    while hasattr(stream, "rich_proxied_file"):
        stream = stream.rich_proxied_file
    return stream


_OBEYED = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u200e\u200f\u202a-\u202e\u2066-\u2069]")


def printable(text: str) -> str:
    """The text without control characters (except line ends and tabs) and without bidirectional
    control characters.
    """
    return _OBEYED.sub("", text)


def console(*, stderr: bool = False) -> "Console":
    """A console on stdout or stderr that strips control characters; text is not parsed as
    markup.
    """
    from rich.console import Console
    from rich.segment import Segment

    class Stripping(Console):
        def render(self, *arguments: Any, **options: Any) -> Iterator[Segment]:
            for each in super().render(*arguments, **options):
                yield each if each.control else each._replace(text=printable(each.text))

    return Stripping(file=_beneath(sys.stderr if stderr else sys.stdout), markup=False, emoji=False)


def show(content: "RenderableType") -> None:
    """Print on stdout; colours only on a terminal, elsewhere without blanks at the ends of lines.
    Text is not parsed as markup, because it contains names and paths.
    """
    on = console()
    if on.is_terminal:
        on.print(content, crop=False, highlight=False)
        return
    with on.capture() as printed:
        on.print(content, crop=False, highlight=False)
    print("\n".join(line.rstrip() for line in printed.get().split("\n")), end="")


def show_written(lines: Iterable[str]) -> None:
    """Print the paths of written files on stdout, one line each: a path is never broken."""
    from rich.text import Text

    on = console()
    for n, line in enumerate(lines):
        head = "written  " if n == 0 else "         "
        on.print(Text.assemble((head, "bold"), line), soft_wrap=True)


def show_json(value: Any) -> None:
    """Print a plain value on stdout, as JSON."""
    print(json.dumps(value, indent=2, allow_nan=False))


def table(
    heads: Sequence[str], rows: Iterable[Sequence[Any]], *, left: int = 1, caption: str = ""
) -> "RenderableType":
    """A table: headings, rows (the first `left` columns left-aligned), and a caption below."""
    from rich.console import Group
    from rich.table import Table
    from rich.text import Text

    cells = [list(row) for row in rows]
    columns = [[str(each) for each in column] for column in zip(heads, *cells, strict=True)]
    # Without room for whole lines, heads are broken at blanks, then cells too; words stay whole.
    lines = (
        columns,
        [[*head.split(), *column] for head, *column in columns],
        [" ".join(column).split() for column in columns],
    )
    widest = [[max(map(len, each), default=0) for each in parts] for parts in lines]
    room = console().width
    fitting = ((w, gap) for w in widest for gap in (2, 1) if sum(w) + gap * len(w) <= room + gap)
    widths, gap = next(fitting, (widest[-1], 1))
    made = Table(box=None, pad_edge=False, padding=(0, gap, 0, 0), header_style="dim")
    for n, (head, width) in enumerate(zip(heads, widths, strict=True)):
        most = None if widths is widest[-1] else width
        side = "left" if n < left else "right"
        made.add_column(head, justify=side, min_width=width, max_width=most, overflow="fold")
    for row in cells:
        made.add_row(*row)
    return Group(made, Text(caption, style="dim")) if caption else made


def say(what: str, message: str, style: str) -> None:
    """Print on stderr, as one paragraph that begins with `what`."""
    from rich.text import Text

    on = console(stderr=True) if _shown is None else _shown.console  # above the progress bars
    on.print(Text.assemble((f"{what}: ", style), message), soft_wrap=True)


def note(*messages: str) -> None:
    """Print notes on stderr, one line each."""
    for message in messages:
        say("note", message, "bold")


_noted = set[str]()
"""Notes of readers that the running command has printed."""


def note_of_reading(*messages: str) -> None:
    """Print the notes of a reader that this command has not printed yet: some commands read their
    input twice.
    """
    note(*dict.fromkeys(each for each in messages if each not in _noted))
    _noted.update(messages)


def forget_notes() -> None:
    """Begin a new command, in which every note is printed again."""
    _noted.clear()


def warn(message: str) -> None:
    """Print a warning on stderr, as one paragraph."""
    say("warning", message, "bold yellow")


class _Noted(logging.Handler):
    """Prints log records as notes."""

    def emit(self, record: logging.LogRecord) -> None:
        note(record.getMessage())


def note_log() -> None:
    """Print the package's log messages as notes, such as those on compiling."""
    logger = logging.getLogger("shapepose_fg")
    if len(logger.handlers) == 0:
        logger.addHandler(_Noted(logging.INFO))
        logger.setLevel(logging.INFO)


_shown: "Progress | None" = None
"""Progress bars that are currently shown."""


@contextmanager
def bars(unit: str = "") -> Iterator["Progress"]:
    """Progress bars on stderr while the block runs; none if stderr is not a terminal.

    The bars are removed and the cursor is restored however the block ends.
    """
    global _shown
    from rich.progress import (
        BarColumn,
        Progress,
        TaskProgressColumn,
        TextColumn,
        TimeRemainingColumn,
    )

    on, left = console(stderr=True), TimeRemainingColumn(compact=True)
    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        TaskProgressColumn(f"{{task.completed:.0f}}/{{task.total:.0f}} {unit}", ""),
    )
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


def _time_words(time_s: float) -> str:
    """A duration in words, to about two digits."""
    return f"{time_s:.0f} s" if time_s < 100 else f"{time_s / 60:.0f} min"


_EVERY_S = 15.0
"""Interval between lines of progress if stderr is not a terminal, s."""


@contextmanager
def progress(what: str, unit: str = "frames") -> Iterator[Callable[[int, int], None]]:
    """A function to be called with the number of finished items and the total number; shows a bar
    on a terminal, otherwise lines of text.
    """
    begin = last = time.monotonic()

    def line(done: int, total: int) -> None:
        nonlocal last
        if total and done > 0 and (now := time.monotonic()) - last >= _EVERY_S:
            last = now
            left = (now - begin) * (total - done) / done
            say(what, f"{done} of {total} {unit}, {_time_words(left)} left", "bold")

    with bars(unit) as shown:
        task = shown.add_task(what, total=None)
        yield (
            line
            if shown.disable
            else lambda done, total: shown.update(task, completed=done, total=total)
        )
