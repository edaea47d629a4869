"""Solved windows, stored in order: the progress of a run, from which it can be resumed."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.arrays import Array, Index
from shapepose_fg.core.bounds import MOST_NUMBER
from shapepose_fg.core.detections import Input
from shapepose_fg.core.errors import naming
from shapepose_fg.core.notes import Notes
from shapepose_fg.core.observation_table import ObservationTable
from shapepose_fg.core.reconstruction import Reconstruction, Status
from shapepose_fg.core.skeleton import Skeleton
from shapepose_fg.core.storage.kept_arrays import ANEW, KeptArrays
from shapepose_fg.core.storage.schema import Column, columns_of
from shapepose_fg.core.trajectory import MOST_METRES
from shapepose_fg.pipeline.runs.chunks import Border
from shapepose_fg.pipeline.windows import StreamState
from shapepose_fg.tracking.identities import MOST_FRAMES, FollowState, observed, people_at
from shapepose_fg.tracking.motion_filter import JointStates
from shapepose_fg.tracking.tracker import Tracks

_STATUS = np.array([*map(str, Status)])
"""Statuses, stored as their index in this list."""
_CODE = Column("N", np.uint8, codes=Status)
OBSERVED = "observations."
"""Prefix of observations' columns among those of a part."""


@dataclass(frozen=True)
class Checkpoint:
    """State of tracking after a batch of frames."""

    frame: int
    """First frame that is not tracked yet."""
    next_id: int = 0
    """Next free identity."""
    state: StreamState | None = None
    """State of the tracker; None before a cut, at the end of a chunk, and for separate frames."""
    border: Border | None = None
    """Tracks at the end of the last chunk, between chunks."""


@dataclass(frozen=True)
class Part:
    """A solved window of a run."""

    rows: Reconstruction
    """Rows of the window; a person is a track, or in separate frames a number within the frame."""
    notes: Notes
    """Notes about the window."""
    checkpoint: Checkpoint | None = None
    """State for continuing tracking after the window, if known."""


class Parts:
    """The windows of a run, in order."""

    def __init__(self, kept: KeptArrays) -> None:
        """Open the stored windows of `kept`, up to the last one from which the run can
        be resumed.
        """
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
        """Number of rows of all windows."""
        return sum(self._counts)

    def append(self, part: Part) -> None:
        """Store the next window. If it has a checkpoint, the run can then be resumed after it."""
        n, rows, table = len(self), part.rows, part.rows.observations
        if table is None:
            raise ValueError("the rows of a part need their observations")
        # Frame and person are columns of the rows.
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
        """A column of a part, by its name in people.npz, or with the prefix `OBSERVED` in
        observations.npz.
        """
        shared = name.removeprefix(OBSERVED)
        values = self.kept.array(_name(n), shared if shared in ObservationTable.ROWS[:2] else name)
        return _STATUS[_CODE.checked(name, values, {})] if name == "status" else values

    def check(
        self, joint_names: Sequence[str], view_names: Sequence[str], frames: range, frame_s: Array
    ) -> None:
        """Raise InputError if a part is not of a run with these joints, views and frames; `frame_s`
        (T,) are the times of all frames of the recording.
        """
        done = frames.start
        for n in range(len(self)):
            with naming(self.kept.place(_name(n)), ANEW):
                own = {name: self.column(n, OBSERVED + name) for name in ObservationTable.ROWS}
                table = ObservationTable(**own, joint_names=joint_names, view_names=view_names)  # type: ignore[arg-type]
                own = {name: self.column(n, name) for name in Reconstruction.ROWS}
                rows = Reconstruction(**own, joint_names=table.joint_names, observations=table)  # type: ignore[arg-type]
                rows.check_ranges()
                table.check_ranges()
                notes = Notes.from_dict(self.kept.about(_name(n)))
                expected = range(done, min(done + notes.frames, frames.stop))
                known = all(each.joint < len(joint_names) for each in notes.problems)
                if not (known and _are_of(rows, expected, frame_s)):
                    raise ValueError("its rows are not of this run")
                done = expected.stop

    def drop(self, n: int) -> None:
        """Remove the rows of a part."""
        self.kept.drop(_name(n))

    def notes(self) -> Notes:
        """Notes about all windows."""
        notes = Notes()
        for n in range(len(self)):
            with naming(self.kept.place(_name(n)), ANEW):
                notes.add(Notes.from_dict(self.kept.about(_name(n))))
        return notes

    def checkpoint(
        self, read: Callable[[int], Input], frames: range, nobody: Tracks, skeleton: Skeleton
    ) -> Checkpoint | None:
        """The tracker's state from which an interrupted run continues; None at the beginning.

        `read` returns the input of a frame; `nobody` has the tracker's joints and state size, but
        no tracks. Raises InputError if the state belongs to other `frames` or other joints.
        """
        name = self._followed
        if name is None:
            return None
        names = {"at", *(key.partition(".")[0] for key in self.kept.keys(name))}
        columns = {
            key: column for key, column in _FOLLOWED.items() if key.partition(".")[0] in names
        }
        joints, size = nobody.joints.mean.shape[1:]
        found = self.kept.columns(name, columns, {"J": joints, "S": size})
        with naming(self.kept.place(name), ANEW):
            solved = frames.start + self.notes().frames
            return checkpoint_of(found, read, solved, frames, nobody, skeleton)


def _are_of(rows: Reconstruction, frames: range, frame_s: Array) -> bool:
    """Whether rows are in these frames, at their times, with each person at most once per frame."""
    if np.any((rows.frame < frames.start) | (rows.frame >= frames.stop)):
        return False
    each = np.unique(np.stack([rows.frame, rows.person], axis=1), axis=0)
    return len(each) == len(rows) and bool((np.abs(rows.time_s - frame_s[rows.frame]) < 1e-6).all())


def _name(n: int) -> str:
    return f"part-{n:06d}"


def checkpoint_arrays(checkpoint: Checkpoint) -> dict[str, NDArray[Any]]:
    """A checkpoint as arrays, without the cameras' input, which is read again."""
    arrays: dict[str, NDArray[Any]] = {"at": np.array([checkpoint.frame, checkpoint.next_id])}
    if checkpoint.border is not None:
        arrays |= {f"border.{name}": getattr(checkpoint.border, name) for name in Border.ROWS}
    if checkpoint.state is None:
        return arrays
    follow, decided = checkpoint.state.follow, checkpoint.state.decided
    arrays |= {"state.numbers": np.array([follow.next_id, checkpoint.state.before])}
    arrays |= {"state.rows": np.array([len(rows) for _, rows in decided], dtype=np.int64)}
    people = follow.people
    arrays |= {"state.ids": people.ids, "state.time_s": np.full(len(people), people.time_s)}
    arrays |= {"state.mean": people.joints.mean, "state.covariance": people.joints.covariance}
    for name in _ROWS if len(decided) > 0 else ():
        arrays[f"rows.{name}"] = np.concatenate([getattr(rows, name) for _, rows in decided])
    for name in _SIDES if len(decided) > 0 else ():
        every = [getattr(given.detections, name) for given, _ in decided]
        arrays[f"detections.{name}"] = np.concatenate(every)
    return arrays


_NUMBERS = partial(Column, dtype=np.int64, most=MOST_NUMBER)
_ROWS = {
    "track": _NUMBERS("N"),
    "candidate": Column("N J V", np.intp),
    "initial": Column("N J 3", most=MOST_METRES),
    "evidence": Column("N", most=1e6),
}
"""Columns of a row that is not solved yet; the rest comes from the cameras."""
_SIDES = {"joint": _NUMBERS("D"), "mirrored": Column("D", least=0.0, most=1.0, finite=True)}
"""Columns of the detections of decided frames, whose sides may be exchanged; the rest comes from
the cameras."""
_FOLLOWED = {"at": _NUMBERS("2"), "state.numbers": _NUMBERS("2"), "state.rows": _NUMBERS("F")}
_FOLLOWED |= {
    "state.ids": _NUMBERS("A"),
    "state.time_s": Column("A", finite=True),
    "state.mean": Column("A J S", most=MOST_METRES, finite=True),
}
_FOLLOWED |= {"state.covariance": Column("A J S S", most=1e12, finite=True)}
_FOLLOWED |= {f"rows.{name}": column for name, column in _ROWS.items()}
_FOLLOWED |= {f"detections.{name}": column for name, column in _SIDES.items()}
_FOLLOWED |= {f"border.{name}": column for name, column in columns_of(Border).items()}
"""Columns of `checkpoint_arrays`."""


def checkpoint_of(
    arrays: Mapping[str, NDArray[Any]],
    read: Callable[[int], Input],
    solved: int,
    frames: range,
    nobody: Tracks,
    skeleton: Skeleton,
) -> Checkpoint:
    """Inverse of `checkpoint_arrays`.

    `read` returns the input of a frame; frames before `solved` are in parts, and `frames` are all
    of the run. Raises ValueError if the arrays do not fit such a run.
    """
    following, next_id = arrays["at"].tolist()
    next_track, before = arrays["state.numbers"].tolist() if "state.numbers" in arrays else (0, 0)
    counts = arrays["state.rows"].tolist() if "state.rows" in arrays else []
    decided = range(solved - before, solved - before + len(counts))
    possible = frames.start <= decided.start <= solved <= decided.stop <= following <= frames.stop
    if not possible or following - decided.stop > (MOST_FRAMES if "state.numbers" in arrays else 0):
        raise ValueError(f"it continues at frame {following}, but the parts end at {solved}")
    if "state.numbers" not in arrays:
        border = (
            Border(*(arrays[f"border.{name}"] for name in Border.ROWS))
            if "border.frame" in arrays
            else None
        )
        return Checkpoint(following, next_id, border=border)
    given = {frame: read(frame) for frame in range(decided.start, following)}
    ends = np.cumsum([0, *(len(given[frame].detections) for frame in decided)])
    sides = [arrays.get(f"detections.{name}", np.zeros(0)) for name in _SIDES]
    if any(len(column) != ends[-1] for column in sides):
        raise ValueError("its detections are not those of its frames")
    for frame, start, stop in zip(decided, ends, ends[1:], strict=False):
        joint, mirrored = (column[start:stop] for column in sides)
        seen = given[frame].detections.with_sides(joint, mirrored, np.array(skeleton.mirror))
        given[frame] = replace(given[frame], detections=seen)
    rows = {name: arrays.get(f"rows.{name}", np.zeros(0)) for name in _ROWS}
    if sum(counts) != len(rows["track"]):
        raise ValueError("its rows are not of its frames")
    found = []
    for frame, stop, count in zip(decided, np.cumsum(counts).tolist(), counts, strict=True):
        own = {name: column[stop - count : stop] for name, column in rows.items()}
        _check_tracks(own["track"], next_track)
        _check_candidates(own["candidate"], given[frame])
        seen = observed(given[frame], own["candidate"], own["initial"], own["track"])
        found.append((given[frame], replace(seen, evidence=own["evidence"])))
    people, ids, joints = (
        nobody,
        arrays["state.ids"],
        (arrays["state.mean"], arrays["state.covariance"]),
    )
    if len(ids) > 0:
        _check_tracks(ids, next_track)
        people = people_at(float(arrays["state.time_s"][0]), ids, JointStates(*joints))
    follow = FollowState(
        people, next_track, tuple(given[frame] for frame in range(decided.stop, following))
    )
    return Checkpoint(following, next_id, StreamState(follow, tuple(found), before))


def _check_tracks(track: Index, next_id: int) -> None:
    """Raise ValueError for duplicate tracks, and for numbers not assigned yet."""
    if len(np.unique(track)) < len(track) or np.any(track >= next_id):
        raise ValueError(f"its tracks must be different numbers below {next_id}")


def _check_candidates(candidate: Index, given: Input) -> None:
    """Raise ValueError unless `candidate` (N, J, V) are detections of these joints in these views,
    or -1.
    """
    seen, joint, view = given.detections, *np.nonzero(candidate != -1)[1:]
    chosen = candidate[candidate != -1]
    wrong = candidate.shape[2:] != (len(given.rig),) or np.any((chosen < 0) | (chosen >= len(seen)))
    if wrong or np.any((seen.joint[chosen] != joint) | (seen.view[chosen] != view)):
        raise ValueError("its rows are of other detections")
