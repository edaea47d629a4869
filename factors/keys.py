"""Keys of the variables: who, which joint, when; packed into GTSAM's 64 bits so that graphs compose.

A key is a `gtsam.Symbol`: 8 bits of character, then 56 bits that hold

    character | person or view, 16 bits | frame, 32 bits | joint, 8 bits

The joints of one person in one frame have consecutive keys. The characters are upper case ('J' joint,
'V' velocity, 'C' camera), so that they stay clear of the lower-case symbols usual in robotics
(`x` poses, `l` landmarks, `v` velocities, `c` cameras) in a graph that holds both.
"""

from typing import NamedTuple

import gtsam
import numpy as np
from numpy.typing import ArrayLike, NDArray

MAX_PERSON = MAX_VIEW = (1 << 16) - 1
"""Largest person and view number in a key."""
MAX_FRAME = (1 << 32) - 1
"""Largest frame number in a key: 2.3 years at 60 frames a second."""
MAX_JOINT = (1 << 8) - 1
"""Largest joint number in a key."""

_JOINT, _VELOCITY, _CAMERA = ord("J"), ord("V"), ord("C")


class JointKey(NamedTuple):
    """What the key of a joint, or of a joint's velocity, says."""

    person: int
    joint: int
    frame: int


class CameraKey(NamedTuple):
    """What the key of a camera says."""

    view: int
    frame: int


def joint_key(person: int, joint: int, frame: int = 0) -> int:
    """Key of the position (`Point3`, metres, world) of a joint; ValueError beyond the limits above."""
    return _pack(_JOINT, person, joint, frame)


def velocity_key(person: int, joint: int, frame: int = 0) -> int:
    """Key of the velocity (`Point3`, metres per second, world) of a joint."""
    return _pack(_VELOCITY, person, joint, frame)


def camera_key(view: int, frame: int = 0) -> int:
    """Key of the pose (`Pose3`, world from camera) of a camera; frame 0 for one that stands still."""
    return _pack(_CAMERA, view, 0, frame)


def joint_keys(person: int, joints: ArrayLike, frame: int = 0) -> NDArray[np.int64]:
    """Keys (D,) of `joints` (D,) of one person in one frame: `joint_key` for an array."""
    index = np.asarray(joints)
    if index.size and not (index.min() >= 0 and index.max() <= MAX_JOINT):
        raise ValueError(f"joint must be 0 to {MAX_JOINT}, got {index.min()} to {index.max()}")
    return joint_key(person, 0, frame) + index.astype(np.int64)


def split_key(key: int) -> JointKey:
    """Person, joint and frame of a joint's or a velocity's key; ValueError for any other key."""
    if int(key) >> 56 not in (_JOINT, _VELOCITY):
        raise ValueError(f"{gtsam.DefaultKeyFormatter(int(key))} is not the key of a joint or a velocity")
    return JointKey(*_unpack(key))


def split_camera_key(key: int) -> CameraKey:
    """View and frame of a camera's key; ValueError for any other key."""
    if int(key) >> 56 != _CAMERA:
        raise ValueError(f"{gtsam.DefaultKeyFormatter(int(key))} is not the key of a camera")
    view, _, frame = _unpack(key)
    return CameraKey(view, frame)


def format_key(key: int) -> str:
    """Readable name of any key; goes where GTSAM takes a key formatter: `graph.print("", format_key)`."""
    kind = int(key) >> 56
    if kind in (_JOINT, _VELOCITY):
        person, joint, frame = _unpack(key)
        return f"{chr(kind)}(person {person}, joint {joint}, frame {frame})"
    if kind == _CAMERA:
        view, _, frame = _unpack(key)
        return f"C(view {view}, frame {frame})"
    return gtsam.DefaultKeyFormatter(int(key))


def _pack(character: int, first: int, joint: int, frame: int) -> int:
    if not (0 <= first <= MAX_PERSON and 0 <= joint <= MAX_JOINT and 0 <= frame <= MAX_FRAME):
        raise ValueError(
            f"a key holds person or view 0 to {MAX_PERSON}, joint 0 to {MAX_JOINT}, frame 0 to {MAX_FRAME}; "
            f"got {first}, {joint}, {frame}"
        )
    return (character << 56) | (int(first) << 40) | (int(frame) << 8) | int(joint)


def _unpack(key: int) -> tuple[int, int, int]:
    bits = int(key)
    return (bits >> 40) & MAX_PERSON, bits & MAX_JOINT, (bits >> 8) & MAX_FRAME
