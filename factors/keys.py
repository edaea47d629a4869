"""Keys of the variables: decimal numbers of person, joint and frame, which GTSAM's own messages
show in full.

A key is a 17-digit number, read from left to right:

    kind, 1 digit | person or view, 5 digits | joint, 3 digits | frame, 8 digits

so 1 00003 004 00000012 is the position of joint 4 of person 3 in frame 12. GTSAM cuts what it
prints of a `gtsam.Symbol` to eight digits behind the character, which is too little for three
numbers; a key without a character is printed whole, in messages, drawings and `Values.print`.
`format_key` spells it out. Symbols (`x5`, `l3`) have a character in their upper bits and are
larger, plain numbers of your own are smaller: all three fit into one graph. Keys of one joint over
time are consecutive, sorted by kind, person, joint, frame.
"""

from typing import NamedTuple

import gtsam
import numpy as np
from numpy.typing import ArrayLike, NDArray

MAX_PERSON = MAX_VIEW = 99_999
"""Largest person and view number in a key."""
MAX_JOINT = 999
"""Largest joint number in a key."""
MAX_FRAME = 99_999_999
"""Largest frame number in a key: 19 days at 60 frames a second."""

_JOINT, _VELOCITY, _CAMERA, _OFFSET, _REPORTED, _ACCELERATION, _BODY = 1, 2, 3, 4, 7, 8, 9
_STATE = (_JOINT, _VELOCITY, _ACCELERATION)
_SOURCES = 3
_NAMES = {_JOINT: "position", _VELOCITY: "velocity", _ACCELERATION: "acceleration"}
_NAMES |= {_CAMERA: "camera", _REPORTED: "reported position", _BODY: "body"}
_NAMES |= {_OFFSET + source: f"offset {source}" for source in range(_SOURCES)}
_PER_JOINT = MAX_FRAME + 1
_PER_PERSON = (MAX_JOINT + 1) * _PER_JOINT
_PER_KIND = (MAX_PERSON + 1) * _PER_PERSON


class JointKey(NamedTuple):
    """Fields decoded from the key of a joint's position, velocity or offset."""

    person: int
    joint: int
    frame: int


class CameraKey(NamedTuple):
    """Fields decoded from a camera key."""

    view: int
    frame: int


def joint_key(person: int, joint: int, frame: int = 0) -> int:
    """Key of the position (`Point3`, metres, world) of a joint. ValueError if a number is not an
    integer or has more digits than the key has for it.
    """
    return int(_pack(_JOINT, person, joint, frame))


def velocity_key(person: int, joint: int, frame: int = 0) -> int:
    """Key of the velocity (`Point3`, metres per second, world) of a joint."""
    return int(_pack(_VELOCITY, person, joint, frame))


def offset_key(person: int, joint: int, frame: int = 0, source: int = 0) -> int:
    """Key of the slowly varying error (`Point3`, in standard deviations) of the measurements of a
    joint by a `source` (0 to 2).
    """
    return int(_pack(_offset(source), person, joint, frame))


def camera_key(view: int, frame: int = 0) -> int:
    """Key of the pose (`Pose3`, world from camera) of a camera, or of a carrier of several cameras;
    frame 0 if it is fixed.
    """
    return int(_pack(_CAMERA, view, 0, frame))


def camera_keys(view: int, frames: ArrayLike) -> NDArray[np.int64]:
    """`camera_key` for an array of `frames`."""
    return _pack(_CAMERA, view, 0, frames)


def joint_keys(person: int, joints: ArrayLike, frames: ArrayLike = 0) -> NDArray[np.int64]:
    """`joint_key` for arrays: `joints` and `frames` broadcast against each other."""
    return _pack(_JOINT, person, joints, frames)


def velocity_keys(person: int, joints: ArrayLike, frames: ArrayLike = 0) -> NDArray[np.int64]:
    """`velocity_key` for arrays: `joints` and `frames` broadcast against each other."""
    return _pack(_VELOCITY, person, joints, frames)


def state_keys(person: int, joints: ArrayLike, frames: ArrayLike, order: int) -> NDArray[np.int64]:
    """Keys (..., order) of a joint's position, velocity and, where `order` is 3, acceleration
    (m/s²); `joints` and `frames` broadcast against each other.
    """
    return np.stack([_pack(kind, person, joints, frames) for kind in _STATE[:order]], axis=-1)


def offset_keys(
    person: int, joints: ArrayLike, frames: ArrayLike = 0, source: int = 0
) -> NDArray[np.int64]:
    """`offset_key` for arrays: `joints` and `frames` broadcast against each other."""
    return _pack(_offset(source), person, joints, frames)


def reported_keys(person: int, joints: ArrayLike, frames: ArrayLike = 0) -> NDArray[np.int64]:
    """Keys of reported positions (`Point3`, metres, world), which contain all errors. `joint_keys`
    are the positions of the optimised graph of detections, body priors and motion. `joints` and
    `frames` broadcast against each other.
    """
    return _pack(_REPORTED, person, joints, frames)


def body_keys(person: int, frames: ArrayLike) -> NDArray[np.int64]:
    """Keys of a person's body pose in each of some `frames`: a vector of root, angles, place."""
    return _pack(_BODY, person, 0, frames)


def shape_key(person: int) -> int:
    """Key of a person's body shape: a vector (10,), the betas."""
    return int(_pack(_BODY, person, 1, 0))


def split_key(key: int) -> JointKey:
    """Person, joint and frame of a joint's key; ValueError for a camera's key or any other key."""
    kind, person, joint, frame = _unpack(key)
    if kind not in _NAMES or kind == _CAMERA:
        raise ValueError(f"{format_key(key)} is not the key of a joint, a velocity or an offset")
    return JointKey(person, joint, frame)


def split_camera_key(key: int) -> CameraKey:
    """View and frame of a camera's key; ValueError for any other key."""
    kind, view, _, frame = _unpack(key)
    if kind != _CAMERA:
        raise ValueError(f"{format_key(key)} is not the key of a camera")
    return CameraKey(view, frame)


def format_key(key: int) -> str:
    """Readable name of any key, for GTSAM's `keyFormatter` arguments: `graph.print("",
    format_key)`.
    """
    kind, first, joint, frame = _unpack(key)
    if kind == _CAMERA:
        return f"camera(view {first}, frame {frame})"
    if kind in _NAMES:
        return f"{_NAMES[kind]}(person {first}, joint {joint}, frame {frame})"
    return gtsam.DefaultKeyFormatter(int(key))


def _offset(source: int) -> int:
    if source not in range(_SOURCES):
        raise ValueError(
            f"source in a key must be a whole number, 0 to {_SOURCES - 1}, got {source}"
        )
    return _OFFSET + int(source)


def _pack(kind: int, first: int, joint: ArrayLike, frame: ArrayLike) -> NDArray[np.int64]:
    joints, frames = np.asarray(joint), np.asarray(frame)
    for name, value, limit in (
        ("person or view", np.asarray(first), MAX_PERSON),
        ("joint", joints, MAX_JOINT),
        ("frame", frames, MAX_FRAME),
    ):
        if value.size and not (value.min() >= 0 and value.max() <= limit):
            raise ValueError(
                f"{name} in a key must be 0 to {limit}, got {value.min()} to {value.max()}"
            )
        if np.any(value % 1 != 0):
            raise ValueError(
                f"{name} in a key must be a whole number, got {value[value % 1 != 0].flat[0]}"
            )
    base = kind * _PER_KIND + int(first) * _PER_PERSON
    return base + joints.astype(np.int64) * _PER_JOINT + frames.astype(np.int64)


def _unpack(key: int) -> tuple[int, int, int, int]:
    kind, rest = divmod(int(key), _PER_KIND)
    person, rest = divmod(rest, _PER_PERSON)
    return (kind, person, *divmod(rest, _PER_JOINT))
