"""From where a run can go on: who is followed, and the frames that are not solved, as plain arrays."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.observations import Observations
from shapepose_fg.core.storage.kept_arrays import split
from shapepose_fg.pipeline.runs.borders import Border
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
    """What is carried on; None where nothing is: after the last frame before a cut or of a chunk, without time."""
    border: Border | None = None
    """Between chunks: who was where at the end of the last."""


_TRACKS = ("ids", "world", "evident_s")
_BORDER = tuple(field.name for field in fields(Border))
_OBSERVED = tuple(field.name for field in fields(Observations))


def checkpoint_arrays(checkpoint: Checkpoint) -> dict[str, NDArray[Any]]:
    """A checkpoint as arrays. What the cameras gave is not among them: it is read again."""
    arrays: dict[str, NDArray[Any]] = {"at": np.array([checkpoint.frame, checkpoint.next_id])}
    if checkpoint.border is not None:
        arrays |= {f"border.{name}": getattr(checkpoint.border, name) for name in _BORDER}
    if checkpoint.state is None:
        return arrays
    follow, decided = checkpoint.state.follow, checkpoint.state.decided
    people = follow.people
    arrays |= {f"people.{name}": getattr(people, name) for name in _TRACKS}
    arrays |= {"people.mean": people.joints.mean, "people.covariance": people.joints.covariance}
    arrays |= {"people.time_s": np.array([people.time_s]), "people.next_id": np.array([follow.next_id])}
    arrays |= {"pending.frames": np.array([given.frame for given in follow.pending], dtype=np.int64)}
    arrays["before"] = np.array([checkpoint.state.before])
    arrays |= _frames("decided", [given for given, _ in decided], [len(rows) for _, rows in decided])
    return arrays | _joined("decided", _OBSERVED, [rows for _, rows in decided])


def checkpoint_of(
    array: Callable[[str], NDArray[Any]], keys: Sequence[str], read: Callable[[int], Input]
) -> Checkpoint:
    """The checkpoint that `checkpoint_arrays` made the arrays of; `read` gives what the cameras saw of a frame."""
    following, next_id = array("at").tolist()
    if "before" not in keys:
        known = "border.frame" in keys
        border = Border(**{name: array(f"border.{name}") for name in _BORDER}) if known else None
        return Checkpoint(following, next_id, border=border)
    joints = JointStates(array("people.mean"), array("people.covariance"))
    people = Tracks(
        time_s=float(array("people.time_s")[0]),
        joints=joints,
        **{name: array(f"people.{name}") for name in _TRACKS},
    )
    given = {frame: read(frame) for name in ("pending", "decided") for frame in array(f"{name}.frames").tolist()}
    pending = tuple(given[frame] for frame in array("pending.frames").tolist())
    decided = [(given[frame], Observations(**parts)) for frame, parts in _parted("decided", _OBSERVED, array)]
    follow = FollowState(people, int(array("people.next_id")[0]), pending)
    return Checkpoint(following, next_id, StreamState(follow, tuple(decided), int(array("before")[0])))


def _frames(name: str, given: Sequence[Input], counts: Sequence[int]) -> dict[str, NDArray[Any]]:
    """Numbers of some frames, and how many rows each has."""
    numbers = np.array([each.frame for each in given], dtype=np.int64)
    return {f"{name}.frames": numbers, f"{name}.counts": np.array(counts, dtype=np.int64)}


def _joined(name: str, keys: Sequence[str], parts: Sequence[Any]) -> dict[str, NDArray[Any]]:
    """Arrays of several frames, one after the other; none where there are no frames."""
    if len(parts) == 0:
        return {}
    return {f"{name}.{key}": np.concatenate([getattr(part, key) for part in parts]) for key in keys}


def _parted(
    name: str, keys: Sequence[str], array: Callable[[str], NDArray[Any]]
) -> list[tuple[int, dict[str, NDArray[Any]]]]:
    """Frames with their arrays, as `_joined` put them together."""
    frames, counts = array(f"{name}.frames"), array(f"{name}.counts")
    if len(frames) == 0:
        return []
    columns = [split(array(f"{name}.{key}"), counts) for key in keys]
    return [
        (frame, dict(zip(keys, parts, strict=True)))
        for frame, *parts in zip(frames.tolist(), *columns, strict=True)
    ]
