"""What the commands say on a terminal: results, notes, a bar while something runs."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import RenderableType


def show(content: "RenderableType") -> None:
    """Print on stdout; with colours on a terminal only."""
    from rich.console import Console

    Console().print(content)


def note(message: str) -> None:
    """Say on stderr, in one line, what was made of the input."""
    from rich.console import Console
    from rich.text import Text

    Console(stderr=True).print(Text.assemble(("note: ", "bold"), message), soft_wrap=True)


def warn(message: str) -> None:
    """Say on stderr, in one paragraph, what looks wrong."""
    from rich.console import Console
    from rich.text import Text

    Console(stderr=True).print(Text.assemble(("warning: ", "bold yellow"), message), soft_wrap=True)


@contextmanager
def progress(what: str, unit: str = "frames") -> Iterator[Callable[[int, int], None]]:
    """A progress bar on stderr while the block runs: a function of how many are done, and how many there are.

    Nothing is shown where stderr is not a terminal.
    """
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    console = Console(stderr=True)
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn(unit),
        TimeRemainingColumn(compact=True),
    )
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task(what, total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)
