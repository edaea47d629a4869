"""batch.json: which recordings of an archive are done, which failed and why."""

import json
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from pydantic import ConfigDict, TypeAdapter, ValidationError

from shapepose_fg.cli.reconstruct.request import Ended
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.provenance import versions
from shapepose_fg.core.storage.files import read_json, write_atomically
from shapepose_fg.io.validation import first_problem, key_text

BATCH = "batch.json"
_FORMAT = "shapepose-fg batch 1"


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
    """Of a recording that is done, like the next."""
    rows: int | None = None
    people: int | None = None
    warnings: tuple[str, ...] = ()

    def done(self, found: Ended, seconds: float) -> "Standing":
        """After it was done, in so many seconds."""
        attempts, seconds = self.attempts + 1, self.seconds + seconds
        return replace(self, status="done", attempts=attempts, anew=False, seconds=seconds, **asdict(found))

    def failed(self, reason: str, seconds: float, most: int) -> "Standing":
        """After another attempt failed; the last of `most`?"""
        attempts = self.attempts + 1
        status = "failed" if attempts >= most else "waiting"
        return replace(
            self,
            status=status,
            attempts=attempts,
            seconds=self.seconds + seconds,
            reasons=(*self.reasons, reason),
        )


@dataclass
class Standings:
    """Of all recordings by name, as they are in the file."""

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
        counts = {status: self.names(status) for status in ("done", "failed", "waiting")}
        content = {
            "format": _FORMAT,
            "table": self.table,
            "versions": versions(),
            **{status: len(names) for status, names in counts.items()},
            "recordings": {name: asdict(each) for name, each in self.of.items()},
        }
        text = json.dumps(content, indent=2, allow_nan=False) + "\n"
        write_atomically(self.file, lambda stream: stream.write(text.encode()))

    def names(self, status: str) -> list[str]:
        """Who is that far."""
        return [name for name, each in self.of.items() if each.status == status]


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
