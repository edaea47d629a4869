"""Solved windows, kept one after the other: what a run has done so far, and from where it can go on."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.detections import Input
from shapepose_fg.core.notes import Notes
from shapepose_fg.core.observation_table import ObservationTable
from shapepose_fg.core.observations import Observations
from shapepose_fg.core.reconstruction import Reconstruction, Status
from shapepose_fg.core.storage.kept_arrays import KeptArrays
from shapepose_fg.pipeline.runs.chunks import Border
from shapepose_fg.pipeline.windows import StreamState
from shapepose_fg.tracking.following import FollowState
from shapepose_fg.tracking.motion_filter import JointStates
from shapepose_fg.tracking.tracker import Tracks

_STATUS = np.array([*map(str, Status)])
"""A status is kept as its place in this list."""
OBSERVED = "observations."
"""What the names of observations' columns begin with, among those of a part."""


@dataclass(frozen=True)
class Checkpoint:
    """After a batch of frames was followed."""

    frame: int
    """The first frame that was not."""
    next_id: int = 0
    """The identity of the next new person."""
    state: StreamState | None = None
    """What is carried on; None where nothing is: before a cut, at the end of a chunk, frame by frame."""
    border: Border | None = None
    """Between chunks: who was where at the end of the last."""


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


_TRACKS = ("ids", "world", "evident_s")


def checkpoint_arrays(checkpoint: Checkpoint) -> dict[str, NDArray[Any]]:
    """A checkpoint as arrays. What the cameras gave is not among them: it is read again."""
    arrays: dict[str, NDArray[Any]] = {"at": np.array([checkpoint.frame, checkpoint.next_id])}
    if checkpoint.border is not None:
        arrays |= {f"border.{name}": getattr(checkpoint.border, name) for name in Border.ROWS}
    if checkpoint.state is None:
        return arrays
    follow, decided = checkpoint.state.follow, checkpoint.state.decided
    people = follow.people
    arrays |= {f"people.{name}": getattr(people, name) for name in _TRACKS}
    arrays |= {"people.mean": people.joints.mean, "people.covariance": people.joints.covariance}
    arrays |= {"people.time_s": np.array([people.time_s])}
    arrays |= {"numbers": np.array([follow.next_id, checkpoint.state.before])}
    arrays |= {"pending.frames": np.array([given.frame for given in follow.pending], dtype=np.int64)}
    arrays |= {"decided.frames": np.array([given.frame for given, _ in decided], dtype=np.int64)}
    arrays |= {"decided.counts": np.array([len(rows) for _, rows in decided], dtype=np.int64)}
    for name in Observations.ROWS if len(decided) > 0 else ():
        arrays[f"decided.{name}"] = np.concatenate([getattr(rows, name) for _, rows in decided])
    return arrays


def checkpoint_of(
    array: Callable[[str], NDArray[Any]], keys: Sequence[str], read: Callable[[int], Input]
) -> Checkpoint:
    """The checkpoint that `checkpoint_arrays` made the arrays of; `read` gives what the cameras saw of a frame."""
    following, next_id = array("at").tolist()
    border = Border(*(array(f"border.{name}") for name in Border.ROWS)) if "border.frame" in keys else None
    if "numbers" not in keys:
        return Checkpoint(following, next_id, border=border)
    people = Tracks(
        time_s=float(array("people.time_s")[0]),
        joints=JointStates(array("people.mean"), array("people.covariance")),
        **{name: array(f"people.{name}") for name in _TRACKS},
    )
    next_track, before = array("numbers").tolist()
    pending, frames = array("pending.frames").tolist(), array("decided.frames").tolist()
    given = {frame: read(frame) for frame in (*pending, *frames)}
    decided = []
    if len(frames) > 0:
        rows = Observations(**{name: array(f"decided.{name}") for name in Observations.ROWS})
        cuts = np.cumsum(array("decided.counts"))[:-1]
        parts = [rows.rows(index) for index in np.split(np.arange(len(rows)), cuts)]
        decided = [(given[frame], part) for frame, part in zip(frames, parts, strict=True)]
    follow = FollowState(people, next_track, tuple(given[frame] for frame in pending))
    return Checkpoint(following, next_id, StreamState(follow, tuple(decided), before), border)
