"""Saves the state of an online reconstruction, and restores it in another process or after a
restart.

A file is the SHA-256 digest of an `.npz`, and this `.npz`: the arrays of the state, and its
structure as JSON. Only the classes listed here are made from it.
"""

import hashlib
import io
import json
from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import asdict, fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.camera import Camera, Rig
from shapepose_fg.core.detections import Detections, Input
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.observation_table import ObservationTable
from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.core.skeleton import Skeleton
from shapepose_fg.core.storage.files import read_bytes, write_content
from shapepose_fg.core.storage.npz import write_npz
from shapepose_fg.core.trajectory import Trajectory
from shapepose_fg.live.cameras import CameraWatch
from shapepose_fg.live.clock import CommonClock
from shapepose_fg.live.filtering import EndedTracks, FilterState
from shapepose_fg.live.refining import LiveState, Slot
from shapepose_fg.live.views import ViewsInStep
from shapepose_fg.pipeline.config import PipelineConfig
from shapepose_fg.tracking.motion_filter import JointStates
from shapepose_fg.tracking.tracker import Tracks

_CURE = "start without this saved state"
_CLASSES: dict[str, Any] = {
    each.__name__: each
    for each in (
        LiveState, Slot, Input, Detections, Rig, Camera, Trajectory, CameraWatch, ViewsInStep,
        CommonClock, FilterState, EndedTracks, Tracks, JointStates, Reconstruction,
        ObservationTable, list, tuple, set, deque, dict, Counter,
    )
}  # fmt: skip
"""Classes of a state, by name."""


def setup_id(rig: Rig, skeleton: Skeleton, config: PipelineConfig, lag_s: float) -> str:
    """A digest of what must be the same for a saved state to be resumed: cameras, joints, settings,
    lag, and the fields of the saved classes.
    """
    kept = [each.__dataclass_fields__.keys() for each in _CLASSES.values() if is_dataclass(each)]
    description = repr(
        (asdict(config), rig.names, skeleton.joints, skeleton.limbs, lag_s, kept)
    ).encode()
    return hashlib.sha256(description + rig.K.tobytes() + rig.cTw.tobytes()).hexdigest()


def write_state(path: Path, state: LiveState, setup: str) -> None:
    """Write the whole state of an online reconstruction of this setup."""
    arrays: dict[str, NDArray[Any]] = {}
    structure = json.dumps([setup, _plain(state, arrays)], default=lambda number: number.item())
    content = io.BytesIO()
    write_npz(content, {"state": np.array(structure), **arrays})
    digest = hashlib.sha256(content.getvalue()).digest()
    write_content(path, digest + content.getvalue())


def read_state(path: Path, setup: str) -> LiveState:
    """The state in a file of `write_state`. InputError, one sentence, if the file is damaged or
    belongs to another setup.
    """
    whole = read_bytes(path)
    if hashlib.sha256(whole[32:]).digest() != whole[:32]:
        raise InputError(
            f"{path}: cannot be read as the saved state of a live reconstruction; {_CURE}"
        )
    with np.load(io.BytesIO(whole[32:]), allow_pickle=False) as arrays:
        saved_setup, tree = json.loads(str(arrays["state"]))
        if saved_setup != setup:
            raise InputError(
                f"{path}: the state was saved with other cameras, joints, settings or lag, or by "
                f"another version of this program; give those, or {_CURE}"
            )
        return _made(tree, arrays)


def _plain(value: Any, arrays: dict[str, NDArray[Any]]) -> Any:
    """`value` as JSON, in which an array is its name in `arrays`, and an object its class's name
    and content.
    """
    if isinstance(value, np.ndarray):
        arrays[name := str(len(arrays))] = value
        return {"array": name}
    if is_dataclass(value):
        inside: Any = [(each.name, getattr(value, each.name)) for each in fields(value)]
    elif isinstance(value, Mapping):
        inside = list(value.items())
    elif isinstance(value, list | tuple | deque | set):
        inside = value
    else:
        return value
    return {type(value).__name__: [_plain(each, arrays) for each in inside]}


def _made(tree: Any, arrays: Mapping[str, NDArray[Any]]) -> Any:
    """The value that `_plain` described."""
    if not isinstance(tree, dict):
        return tree
    ((kind, content),) = tree.items()
    if kind == "array":
        return arrays[content]
    inside = [_made(each, arrays) for each in content]
    of = _CLASSES[kind]
    if hasattr(of, "__dataclass_fields__"):
        return of(**dict(inside))
    return of(dict(inside) if of is Counter else inside)
