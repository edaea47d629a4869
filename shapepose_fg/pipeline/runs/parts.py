"""Solved windows, kept one after the other: what a run has done so far, and from where it can go on."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.observation_table import ObservationTable
from shapepose_fg.core.reconstruction import Reconstruction, Status
from shapepose_fg.core.storage.kept_arrays import KeptArrays
from shapepose_fg.pipeline.runs.checkpoint import Checkpoint, checkpoint_arrays, checkpoint_of
from shapepose_fg.pipeline.runs.notes import Notes
from shapepose_fg.tracking.hypotheses import Input

_STATUS = np.array([*map(str, Status)])
"""A status is kept as its place in this list."""
OBSERVED = "observations."
"""What the names of observations' columns begin with, among those of a part."""


@dataclass(frozen=True)
class Part:
    """One window, solved."""

    rows: Reconstruction
    """Its rows; a person is a track there, or frame by frame a number within the frame."""
    notes: Notes
    """What is to be said about it."""
    checkpoint: Checkpoint | None = None
    """From where following goes on after it, where that is known."""


class Parts:
    """The windows of a run, in order."""

    def __init__(self, kept: KeptArrays) -> None:
        """Those that are in `kept`, up to the last from which the run can go on."""
        self.kept = kept
        followed = kept.names("followed-")
        self._followed = followed[-1] if followed else None
        done = int(followed[-1].split("-")[1]) + 1 if followed else 0
        for name in followed[:-1]:
            kept.drop(name)
        self._counts = [len(kept.array(_name(n), "frame")) for n in range(done)]

    def __len__(self) -> int:
        return len(self._counts)

    @property
    def rows(self) -> int:
        """How many rows all of them have."""
        return sum(self._counts)

    def append(self, part: Part) -> None:
        """Keep the next window. When this returns, and it has a checkpoint, the run can go on behind it."""
        n, rows, table = len(self), part.rows, part.rows.observations
        if table is None:
            raise ValueError("the rows of a part need their observations")
        # Frame and person are those of the rows.
        arrays = {OBSERVED + name: getattr(table, name) for name in table.ROWS[2:]}
        arrays |= {name: getattr(rows, name) for name in rows.ROWS}
        arrays["status"] = np.argmax(rows.status[:, None] == _STATUS, axis=1).astype(np.uint8)
        self.kept.keep(_name(n), arrays, part.notes.as_dict())
        self._counts.append(len(rows))
        if part.checkpoint is not None and self.kept.lasting:
            before, self._followed = self._followed, f"followed-{n:06d}"
            self.kept.keep(self._followed, checkpoint_arrays(part.checkpoint))
            if before is not None:
                self.kept.drop(before)

    def column(self, n: int, name: str) -> NDArray[Any]:
        """A column of a part, by its name in people.npz, or in observations.npz with `OBSERVED` before it."""
        shared = name.removeprefix(OBSERVED)
        values = self.kept.array(_name(n), shared if shared in ObservationTable.ROWS[:2] else name)
        return _STATUS[values] if name == "status" else values

    def drop(self, n: int) -> None:
        """Forget the rows of a part."""
        self.kept.drop(_name(n))

    def notes(self) -> Notes:
        """What is to be said about all of them."""
        notes = Notes()
        for n in range(len(self)):
            notes.add(Notes.from_dict(self.kept.about(_name(n))))
        return notes

    def checkpoint(self, read: Callable[[int], Input]) -> Checkpoint | None:
        """From where following goes on; None at the beginning. `read` gives what the cameras saw of a frame."""
        name = self._followed
        if name is None:
            return None
        return checkpoint_of(lambda key: self.kept.array(name, key), self.kept.keys(name), read)


def _name(n: int) -> str:
    return f"part-{n:06d}"
