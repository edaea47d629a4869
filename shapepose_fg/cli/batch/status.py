"""The status of every recording of a batch: batch.json, and the output of `shapepose-fg batch`."""

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
from shapepose_fg.core.validation import first_problem, key_text

if TYPE_CHECKING:
    from shapepose_fg.cli.reconstruct.run import Ended

_FORMAT = "shapepose-fg batch 1"
_STYLES = {"done": "green", "failed": "bold red", "waiting": "yellow"}


@dataclass(frozen=True)
class RecordingStatus:
    """The status of one recording."""

    asked: dict[str, Any]
    """The options that differ from the defaults (`table.options_of`)."""
    status: Literal["waiting", "done", "failed"] = "waiting"
    """`failed`: it failed twice, or a recording on which it depends failed."""
    attempts: int = 0
    """Number of attempts so far."""
    anew: bool = False
    """Whether the next attempt removes the files of an earlier run; false after the first frames
    have been saved."""
    reasons: tuple[str, ...] = ()
    """Reason of each failure."""
    seconds: float = 0.0
    """Wall time of all attempts together, seconds; other recordings run at the same time."""
    frames: int | None = None
    """Number of reconstructed frames; None until the recording is done, as are the fields below."""
    rows: int | None = None
    people: int | None = None
    warnings: tuple[str, ...] = ()

    def done(self, found: "Ended", seconds: float) -> "RecordingStatus":
        """The status after a successful attempt of this duration, seconds."""
        attempts, seconds = self.attempts + 1, self.seconds + seconds
        return replace(
            self, status="done", attempts=attempts, anew=False, seconds=seconds, **asdict(found)
        )

    def failed(self, reason: str, seconds: float, most: int) -> "RecordingStatus":
        """The status after a failed attempt of this duration, seconds; final after `most`
        attempts.
        """
        attempts, seconds = self.attempts + 1, self.seconds + seconds
        status = "failed" if attempts >= most else "waiting"
        return replace(
            self, status=status, attempts=attempts, seconds=seconds, reasons=(*self.reasons, reason)
        )


@dataclass
class BatchStatus:
    """The status of all recordings by name, stored in batch.json."""

    file: Path
    """Path of batch.json."""
    table: str
    """Path of the table of recordings."""
    of: dict[str, RecordingStatus] = field(default_factory=dict)
    """Status by name, in the order of the table."""

    def set(self, name: str, status: RecordingStatus) -> None:
        """Change the status of one recording, and write the file."""
        self.of[name] = status
        self.write()

    def write(self) -> None:
        """Write the file, atomically."""
        content = {
            "format": _FORMAT,
            "table": self.table,
            "versions": versions(),
            **{status: len(self.names(status)) for status in ("done", "failed", "waiting")},
            "recordings": {name: asdict(each) for name, each in self.of.items()},
        }
        write_content(self.file, json.dumps(content, indent=2, allow_nan=False) + "\n")

    def names(self, status: str) -> list[str]:
        """The names of the recordings with this status."""
        return [name for name, each in self.of.items() if each.status == status]

    def summary(self, seconds: float) -> RenderableType:
        """A table of the results of all recordings, with totals below it."""
        rows = []
        for name, each in self.of.items():
            row = [
                "" if number is None else str(number)
                for number in (each.frames, each.people, each.rows)
            ]
            row += [clock(each.seconds) if each.attempts > 0 else "", str(len(each.warnings) or "")]
            rows.append((Text(name), Text(each.status, style=_STYLES[each.status]), *row))
        counts = [
            f"{len(self.names(each))} {each}" for each in _STYLES if len(self.names(each)) > 0
        ]
        frames = sum(each.frames or 0 for each in self.of.values())
        caption = f"{', '.join(counts)}; {frames} frames; time of this run {clock(seconds)}"
        heads = ("recording", "", "frames", "people", "rows", "time", "warnings")
        return table(heads, rows, left=2, caption=caption)


def read_status(file: Path) -> dict[str, RecordingStatus]:
    """Read the status of each recording from batch.json; InputError if it is damaged."""
    content = read_json(file)
    cure = "start again with --restart"
    if not isinstance(content, dict) or content.get("format") != _FORMAT:
        raise InputError(
            f"{file}: this is not the status file of a batch; {cure}, or give another --output"
        )
    try:
        kind = TypeAdapter(
            dict[str, RecordingStatus], config=ConfigDict(strict=True, allow_inf_nan=False)
        )
        return kind.validate_json(json.dumps(content.get("recordings")))
    except ValidationError as error:
        place, problem = first_problem(error)
        raise InputError(f"{file}: recordings.{key_text(place)} {problem}; {cure}") from None


class Bars:
    """Progress bars on stderr: one for the batch, one for each running recording; none if stderr is
    not a terminal.
    """

    def __init__(self, bars: Progress, batch_status: BatchStatus) -> None:
        self._bars, self._status = bars, batch_status
        self._whole = bars.add_task("recordings", total=len(batch_status.of))
        self._tasks: dict[str, TaskID] = {}
        self._count()

    def began(self, name: str) -> None:
        """Add a bar for a recording that has started."""
        self._tasks[name] = self._bars.add_task(name, total=None)

    def frames(self, name: str, done: int, count: int) -> None:
        """Update the number of finished frames."""
        self._bars.update(self._tasks[name], completed=done, total=count)

    def ended(self, name: str, *, failed: str | None, again: bool) -> None:
        """Print that a recording is done, or the reason why it `failed` and whether it will be
        tried `again`.
        """
        self._bars.remove_task(self._tasks.pop(name))
        self._count()
        each = self._status.of[name]
        if failed is None:
            people = "" if each.people is None else f"{each.people} people, "
            words = (
                ("done: ", "green"),
                f"{name}, {each.frames} frames, {people}{clock(each.seconds)}",
            )
        else:
            more = " (tried once more after the others)" if again else ""
            words = ("failed: ", "bold red"), f"{name}: {failed}{more}"
        self._bars.console.print(Text.assemble(*words), soft_wrap=True)

    def _count(self) -> None:
        ended = len(self._status.of) - len(self._status.names("waiting"))
        self._bars.update(self._whole, completed=ended)


def clock(seconds: float) -> str:
    """A duration in words: 12 s, 3 min 20 s, 5 h 10 min."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60} s"
    return f"{whole // 3600} h {whole % 3600 // 60} min"
