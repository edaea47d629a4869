"""From where a run can go on: who is followed, and the frames that are not solved, as plain arrays."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.observations import Observations
from shapepose_fg.pipeline.runs.chunks import Border
from shapepose_fg.pipeline.windows import StreamState
from shapepose_fg.tracking.following import FollowState
from shapepose_fg.tracking.hypotheses import Input
from shapepose_fg.tracking.motion_filter import JointStates
from shapepose_fg.tracking.tracker import Tracks


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
