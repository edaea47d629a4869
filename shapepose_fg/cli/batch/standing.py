"""How far the recordings of an archive are: batch.json, and what `shapepose-fg batch` says of them."""

import json
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from pydantic import ConfigDict, TypeAdapter, ValidationError
from rich.console import RenderableType
from rich.progress import Progress, TaskID
from rich.text import Text

from shapepose_fg.cli.terminal import table
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.provenance import versions
from shapepose_fg.core.storage.files import read_json, write_content
from shapepose_fg.io.validation import first_problem, key_text

if TYPE_CHECKING:
    from shapepose_fg.cli.reconstruct.run import Ended

_FORMAT = "shapepose-fg batch 1"
_STYLES = {"done": "green", "failed": "bold red", "waiting": "yellow"}


@dataclass(frozen=True)
class Standing:
    """How far one recording is."""

    asked: dict[str, Any]
    """What is wanted of it (`table.asked`)."""
    status: Literal["waiting", "done", "failed"] = "waiting"
    """`failed`: it failed twice, or one that it had to wait for did."""
    attempts: int = 0
    """How often it was begun."""
    anew: bool = False
    """Whether what an earlier run of it left is to be removed first; so until the first frames are done."""
    reasons: tuple[str, ...] = ()
    """Why it failed, each time."""
    seconds: float = 0.0
    """What it took by the clock, beside others, all attempts together."""
    frames: int | None = None
    """Number of frames of a recording that is done; None before, as are `rows` and `people`."""
    rows: int | None = None
    people: int | None = None
    warnings: tuple[str, ...] = ()

    def done(self, found: "Ended", seconds: float) -> "Standing":
        """After it was done, in so many seconds."""
        attempts, seconds = self.attempts + 1, self.seconds + seconds
        return replace(self, status="done", attempts=attempts, anew=False, seconds=seconds, **asdict(found))

    def failed(self, reason: str, seconds: float, most: int) -> "Standing":
        """After another attempt failed; the last of `most`?"""
        attempts, seconds = self.attempts + 1, self.seconds + seconds
        status = "failed" if attempts >= most else "waiting"
        return replace(self, status=status, attempts=attempts, seconds=seconds, reasons=(*self.reasons, reason))


@dataclass
class Standings:
    """States of all recordings by name, as they are in the file."""

    file: Path
    """batch.json."""
    table: str
    """The table that they are of."""
    of: dict[str, Standing] = field(default_factory=dict)
    """In the table's order."""

    def set(self, name: str, standing: Standing) -> None:
        """Change one, and the file."""
        self.of[name] = standing
        self.write()

    def write(self) -> None:
        """Write the file, whole or not at all."""
        content = {
            "format": _FORMAT,
            "table": self.table,
            "versions": versions(),
            **{status: len(self.names(status)) for status in ("done", "failed", "waiting")},
            "recordings": {name: asdict(each) for name, each in self.of.items()},
        }
        write_content(self.file, json.dumps(content, indent=2, allow_nan=False) + "\n")

    def names(self, status: str) -> list[str]:
        """The recordings that are that far."""
        return [name for name, each in self.of.items() if each.status == status]

    def summary(self, seconds: float) -> RenderableType:
        """How each recording ended, frames, people and time; under it what all of them took."""
        rows = []
        for name, each in self.of.items():
            row = ["" if number is None else str(number) for number in (each.frames, each.people, each.rows)]
            row += [clock(each.seconds) if each.attempts > 0 else "", str(len(each.warnings) or "")]
            rows.append((Text(name), Text(each.status, style=_STYLES[each.status]), *row))
        counts = [f"{len(self.names(each))} {each}" for each in _STYLES if len(self.names(each)) > 0]
        frames = sum(each.frames or 0 for each in self.of.values())
        caption = f"{', '.join(counts)}; {frames} frames; this time {clock(seconds)}"
        heads = ("recording", "", "frames", "people", "rows", "time", "warnings")
        return table(heads, rows, left=2, caption=caption)


def read_standings(file: Path) -> dict[str, Standing]:
    """What batch.json says of each recording; InputError where it is damaged."""
    content = read_json(file)
    cure = "begin anew with --restart"
    if not isinstance(content, dict) or content.get("format") != _FORMAT:
        raise InputError(f"{file}: not of a batch of this program; {cure}, or give another --output")
    try:
        kind = TypeAdapter(dict[str, Standing], config=ConfigDict(strict=True, allow_inf_nan=False))
        return kind.validate_json(json.dumps(content.get("recordings")))
    except ValidationError as error:
        place, problem = first_problem(error)
        raise InputError(f"{file}: recordings.{key_text(place)} {problem}; {cure}") from None


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
        """Show how many frames of a recording are done."""
        self._bars.update(self._tasks[name], completed=done, total=count)

    def ended(self, name: str, *, failed: str | None, again: bool) -> None:
        """It is done, or has `failed` for a reason; `again` if it will be tried again."""
        self._bars.remove_task(self._tasks.pop(name))
        self._count()
        each = self._standings.of[name]
        if failed is None:
            people = "" if each.people is None else f"{each.people} people, "
            words = ("done: ", "green"), f"{name}, {each.frames} frames, {people}{clock(each.seconds)}"
        else:
            more = " (it is tried once more, after the others)" if again else ""
            words = ("failed: ", "bold red"), f"{name}: {failed}{more}"
        self._bars.console.print(Text.assemble(*words), soft_wrap=True)

    def _count(self) -> None:
        ended = len(self._standings.of) - len(self._standings.names("waiting"))
        self._bars.update(self._whole, completed=ended)


def clock(seconds: float) -> str:
    """A time in words: 12 s, 3 min 20 s, 5 h 10 min."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60} s"
    return f"{whole // 3600} h {whole % 3600 // 60} min"
